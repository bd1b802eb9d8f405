"""The README is true: its commands exist, its example runs, its tree is the tree."""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")


def blocks(language):
    found = re.findall(r"^```(\w*)\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
    return [code for kind, code in found if kind == language]


def test_first_block_is_exactly_two_commands_that_exist():
    """A newcomer types two lines, and both are executable files of the clone."""
    commands = blocks("sh")[0].split()
    assert commands == ["./deploy/demo", "./deploy/test"]
    for command in commands:
        assert os.access(ROOT / command, os.X_OK)


def test_ci_runs_the_command_that_the_readme_names():
    """What is checked on a fresh machine is what a newcomer runs."""
    assert "\n./deploy/test\n" in (ROOT / ".ci" / "run").read_text("utf-8")


def test_example_runs_as_pasted():
    """The lock example is a program that works."""
    code = blocks("python")[0] + "\nprint('ran to the end')\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "ran to the end"), done.stderr


def test_named_paths_exist():
    """Each file and folder of the tree in the README is there."""
    tree = next(block for block in blocks("text") if block.startswith("enact_dist/"))
    folder = ROOT
    for line in tree.splitlines():
        names = line.split("  ")[0] if not line.startswith(" ") else line.strip().split("   ")[0]
        folder = ROOT if not line.startswith(" ") else folder
        for name in names.split():
            base = folder if line.startswith("  ") else ROOT
            assert list(base.glob(name.rstrip("/"))), name
        if not line.startswith(" "):
            folder = ROOT / line.split()[0]


def test_verbs_of_the_command_line_exist():
    """Every noun and verb that the README lists answers to --help."""
    listed = next(block for block in blocks("text") if block.startswith("enact up"))
    for noun, verbs in re.findall(r"enact (\w+) ([\w|-]+\|[\w|-]+)", listed):
        for verb in verbs.split("|"):
            done = subprocess.run(
                [sys.executable, "-m", "enact_dist.cli.main", noun, verb, "--help"],
                capture_output=True,
                text=True,
                check=False,
            )
            assert done.returncode == 0, (noun, verb, done.stderr)
            assert "example" in done.stdout.lower(), (noun, verb)
