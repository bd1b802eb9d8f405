"""The type checker is part of the surface: what it must accept, and what it must flag."""

import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent


def mypy(file):
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "mypy",
            "--strict",
            "--no-error-summary",
            "--hide-error-context",
            str(file),
        ],
        capture_output=True,
        text=True,
        cwd=HERE.parents[1],
        check=False,
    )
    return "".join(line for line in done.stdout.splitlines(keepends=True) if file.name in line)


def test_good_use_has_no_type_error():
    """Nothing in good.py is flagged under mypy --strict."""
    assert mypy(HERE / "good.py") == ""


def test_every_misuse_is_flagged_by_the_type_checker():
    """Each line of misuse.py marked wrong is an error, and no other line is."""
    lines = (HERE / "misuse.py").read_text("utf-8").splitlines()
    wrong = {number for number, line in enumerate(lines, 1) if "# wrong: " in line}

    output = mypy(HERE / "misuse.py")

    flagged = {int(n) for n in re.findall(r"misuse\.py:(\d+): error", output)}
    assert len(wrong) >= 17
    assert flagged == wrong, output
