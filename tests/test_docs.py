"""The pages are true: their programs run, their commands exist, their links lead somewhere.

What a block of code needs but a reader does not stands before it in a comment, `<!-- preamble`.
A block that no test runs says why, `<!-- not run: reason -->`, and is counted here.  Blocks of
the language `console`, and files that they need, are followed in `tests/e2e/test_pages.py`.
"""

import ast
import importlib
import pkgutil
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest

import enact_dist
from enact_dist.cli.main import build_parser
from enact_dist.config.environment import variable_of, variables_of
from enact_dist.config.read import load_config
from enact_dist.config.rights import AllowTable, RightsConfig, SecurityConfig
from enact_dist.config.table import keys_of
from enact_dist.config.types import (
    ActorConfig,
    AspectConfig,
    CellConfig,
    PinTable,
    RetentionTable,
    ShardConfig,
)

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = sorted((ROOT / "enact_dist" / "docs").glob("*.md"))
DEPLOY = sorted((ROOT / "deploy").rglob("*.md"))
ALL = [README, *PAGES, *DEPLOY]
FOLLOWED = {
    "own_cell.md",
    "cell.md",
    "kept_grants.md",
    "operations.md",
    "own_actors.md",
    "protocol.md",
    "securing.md",
    "surviving.md",
    "drills.md",
}
"""Pages whose consoles are followed in `tests/e2e`."""
KINDS = {"python", "console", "toml", "sh", "text"}
_BLOCK = re.compile(
    r"^(?:<!-- (not run: (?P<reason>[^\n]*?) |preamble\n(?P<preamble>.*?))-->\n)?"
    r" *```(?P<kind>\w*)(?: (?P<file>\S+))?\n(?P<text>.*?)^ *```$",
    re.DOTALL | re.MULTILINE,
)
_NAMED = re.compile(r"`(?:\.\./)*(\w+(?:[./]\w+)+)`")
PUBLIC = set(re.findall(r"^    (enact_dist[.\w]*)  ", enact_dist.__doc__, re.MULTILINE))
"""The modules that the package lists as its public ones."""
INSIDE = {"protocol.md": {"enact_dist.wire.payload"}}
"""What else a page imports: to show what travels."""
OBJECTS = {"actor", "actors", "cell", "rights", "shard", "world", "zenoh"}
"""Folders whose names stand for an object, event or file, too: `world.view`, `shard.ready`."""


def endings_of(path):
    """Return the ends of a module's or a folder's path by which a text may name it."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ["/".join(parts[start:]) for start in range(len(parts))]


MODULES = {
    ending: file
    for folder in ("enact_dist", "actors", "tests")
    for file in (ROOT / folder).rglob("*.py")
    for path in ((file.parent, file) if file.name == "__init__.py" else (file,))
    for ending in endings_of(path)
}
"""The files of all modules, and the `__init__` of their folders, by the ends of their paths."""
FOLDERS = {"enact_dist", "actors"} | {
    path.name for path in (ROOT / "enact_dist").rglob("*") if path.is_dir()
}


class Block(NamedTuple):
    """A block of code: why it is not run, what precedes it unseen, its language, file and text."""

    page: Path
    number: int
    reason: str
    preamble: str
    kind: str
    file: str
    text: str

    def __str__(self):
        return f"{self.page.relative_to(ROOT)}-{self.number}"


def blocks_of(page):
    """Return all blocks of a page in order."""
    return [
        Block(page, number, *(found[part] or "" for part in Block._fields[2:]))
        for number, found in enumerate(_BLOCK.finditer(page.read_text("utf-8")), 1)
    ]


BLOCKS = [block for page in ALL for block in blocks_of(page)]
PROGRAMS = [
    block
    for block in BLOCKS
    if block.kind == "python" and not block.file
    if block.preamble or re.match(r"(from|import) ", block.text)
]


def imports_of(block):
    """Yield the module and the names of each import from the package; one stands on one line."""
    text = block.preamble + block.text
    for line in re.findall(r"^ *((?:from|import) enact_dist.*)$", text, re.MULTILINE):
        (node,) = ast.parse(line).body
        assert isinstance(node, ast.ImportFrom), f"{block}: {line}"
        yield node.module, {alias.name for alias in node.names}


@pytest.mark.parametrize("page", ALL, ids=lambda page: str(page.relative_to(ROOT)))
def test_programs_of_a_page_import_public_names(page):
    """A reader may rely on what a page shows."""
    for block in (block for block in blocks_of(page) if block.kind == "python"):
        for module, names in imports_of(block):
            assert module in PUBLIC | INSIDE.get(page.name, set()), f"{block} imports {module}"
            inside = {name for name in names if f"{module}.{name}" in PUBLIC}
            there = importlib.import_module(module)
            assert names - inside <= set(getattr(there, "__all__", vars(there))), block


@pytest.mark.parametrize("block", PROGRAMS, ids=str)
def test_program_of_a_page_runs_as_pasted(block):
    """What it prints stands beside it."""
    done = subprocess.run(
        [sys.executable, "-c", block.preamble + block.text],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    told = re.findall(r"^ *print\(.*#\s(.*)$", block.text, re.MULTILINE)
    assert done.returncode == 0, done.stderr
    assert block.preamble or done.stdout.splitlines() == told


def test_each_block_is_run_or_says_why_not():
    """A fragment runs with its preamble, or word for word on another page."""
    run = {block.text for block in PROGRAMS}
    left = [
        str(block)
        for block in BLOCKS
        if not block.reason
        if block.kind not in KINDS
        or (block.kind == "python" and not block.file and block.text not in run)
        or (block.kind == "console" and block.page.name not in FOLLOWED)
        or (block.kind == "sh" and block.page != README)
        or (block.file and block.page.name not in FOLLOWED)
    ]
    assert left == [], "blocks that no test runs, and that do not say why"
    for block in BLOCKS:
        if block.reason:
            print(f"not run: {block}: {block.reason}")
    assert {block.kind for block in BLOCKS if block.reason} <= {"sh", "console"}


def commands_of(block):
    """Yield the `enact` commands of a block, each as words up to a pipe or an end."""
    for line in block.text.splitlines():
        if block.kind == "console" and not line.startswith("$ "):
            continue
        for part in re.split(
            r"&&|[;|&]|\$\(|\b(?:until|time|on_a|on_b|do)\b", line.removeprefix("$ ")
        ):
            command = re.sub(r"\d?> ?\S+|\)$", "", part).strip()
            if command.startswith("enact "):
                words = shlex.split(command.partition(" -- ")[0], comments=True)
                yield words[1:]


@pytest.mark.parametrize("page", ALL, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_of_a_page_have_the_words_and_options_that_there_are(page, capsys):
    """Also those of blocks that are not run."""
    wrong = []
    for block in blocks_of(page):
        for words in commands_of(block) if block.kind in ("sh", "console") else ():
            try:
                build_parser().parse_args(words)
            except SystemExit:
                wrong.append((str(block), words, capsys.readouterr().err[-300:]))
    assert wrong == []


@pytest.mark.parametrize("block", [block for block in BLOCKS if block.kind == "toml"], ids=str)
def test_toml_of_a_page_can_be_read(block, tmp_path):
    """What has shards is a cell, unless the page shows what is wrong with it."""
    there = tomllib.loads(re.sub("^  ", "", block.text, flags=re.MULTILINE))
    if "shards" in there and block.file != "misspelt.toml":
        (tmp_path / "cell.toml").write_text(block.text, "utf-8")
        load_config(tmp_path / "cell.toml", environment={})
    for name in re.findall(r'^\s*class = "(actors\.[\w.]+:\w+)"', block.text, re.MULTILINE):
        assert pkgutil.resolve_name(name)


@pytest.mark.parametrize("page", ALL, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_of_a_page_lead_to_files_and_headings(page):
    """Links to other sites are not followed."""
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        assert file.exists(), target
        if anchor:
            heads = re.findall(r"^#+ (.*)$", file.read_text("utf-8"), re.MULTILINE)
            names = {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}
            assert anchor in names, target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_opens_with_whom_it_is_for(page):
    """One sentence below the heading says for whom it is, and what it has."""
    heading, empty, opening, *_ = page.read_text("utf-8").splitlines()
    assert heading.startswith("# ")
    assert empty == ""
    assert opening.startswith("For those who "), opening


def test_help_and_errors_name_pages_that_there_are():
    """Wherever the program points to a page."""
    for file in (ROOT / "enact_dist").rglob("*.py"):
        for named in re.findall(r"\b(?:docs|deploy)/\w+\.md", file.read_text("utf-8")):
            there = ROOT / ("enact_dist" if named.startswith("docs") else "") / named
            assert there.exists(), f"{file}: {named}"


def docstrings_of(file):
    """Yield the docstrings of a module, its classes and its functions."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, kinds):
            yield ast.get_docstring(node) or ""


def names_a_module(named, text):
    """Say whether a text means a module by this: not data, an object, or a file of its reader."""
    first, *others = re.split(r"[./]", named)
    if named.endswith(".py"):
        return f" {named}\n" not in text
    mixed = "/" in named and "." in named
    return first in FOLDERS - (OBJECTS if named.count(".") == 1 else set()) and not (
        mixed or "docs" in others
    )


def lost_modules(text):
    """Return what a text names by a path, such as `state/slots` or `link.host`, and is not there."""
    lost = []
    for named in _NAMED.findall(text):
        path = named.removesuffix(".py").replace(".", "/")
        module, _, name = path.rpartition("/")
        found = path in MODULES or (module in MODULES and has(MODULES[module], name))
        if names_a_module(named, text) and not found:
            lost.append(named)
    return lost


def has(file, name):
    """Say whether a module, or the `__init__` of a folder, has this name."""
    return re.search(rf"\b{name}\b", file.read_text("utf-8")) is not None


def test_modules_that_a_text_names_are_there():
    """Docstrings and pages name modules by paths that lead to a file, wherever it has moved."""
    pages = [*ALL, *sorted((ROOT / "tests").rglob("*.md"))]
    texts = [(page, page.read_text("utf-8")) for page in pages]
    for folder in ("enact_dist", "actors"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            texts += [(file, text) for text in docstrings_of(file)]
    lost = [(str(file.relative_to(ROOT)), lost_modules(text)) for file, text in texts]
    assert [(file, names) for file, names in lost if names] == []


def lost_tests(text):
    """Return the tests that the rows of a table name behind a file and that it does not have."""
    lost, file = [], ""
    for row in (line for line in text.splitlines() if line.startswith("| ")):
        for named in re.findall(r"`([\w/]*\btest_\w+(?:\.py)?)`", row):
            if named.endswith(".py"):
                file = named
            elif not (ROOT / "tests" / file).is_file() or not has_test(file, named):
                lost.append(f"{file}::{named}")
    return lost


def has_test(file, name):
    """Say whether a test module has a test of this name."""
    return f"\ndef {name}(" in (ROOT / "tests" / file).read_text("utf-8")


def test_tests_that_the_page_on_the_proof_names_are_there():
    """Each attack with what shows its end: a test that is renamed or gone is found."""
    text = (ROOT / "enact_dist" / "docs" / "proof.md").read_text("utf-8")
    assert lost_tests(text) == []
    assert len(re.findall(r"`test_\w+`", text)) >= 50
    gone = "| x | y | `core/test_rights.py`: `test_gone`; `core/test_none.py`: `test_x` |"
    assert lost_tests(gone) == ["core/test_rights.py::test_gone", "core/test_none.py::test_x"]


def test_tests_that_the_page_on_faults_names_are_there():
    """Each fault that was found names the test that shows its cure, in whatever file that lies."""
    named = re.findall(r"`(test_\w+)`", (ROOT / "tests/sim/README.md").read_text("utf-8"))
    files = [file.read_text("utf-8") for file in sorted((ROOT / "tests").rglob("*.py"))]
    there = {name for text in files for name in re.findall(r"def (test_\w+)\(", text)}
    assert len(named) >= 100
    assert [name for name in named if name not in there] == []


def test_a_module_that_has_gone_is_found():
    """By its path, by its dotted name and by its file; data, methods and blocks are left alone."""
    text = "`core/multilock`, `core.state.causes.Cause`, `lock_judge.py`, `cell.toml`, `lock.end`"
    assert lost_modules(text) == ["core/multilock", "core.state.causes.Cause", "lock_judge.py"]
    there = "`core/state/slots`, `state.slots.Slots`, `enact_dist.Cell`, `slots.py`, `tests/sim`"
    assert lost_modules(there) == []


def test_readme_is_short():
    """One reads it whole; what serves one purpose only has its own page."""
    assert len(README.read_text("utf-8").splitlines()) <= 200


def test_readme_leads_to_each_page():
    """No reader finds a page that nothing leads to."""
    readme = README.read_text("utf-8")
    assert [page.name for page in PAGES if f"enact_dist/docs/{page.name}" not in readme] == []


def test_page_of_cell_toml_has_every_key_and_no_other():
    """Its tables name what the reader accepts, table by table and in any order."""
    page = (ROOT / "enact_dist" / "docs" / "cell.md").read_text("utf-8")
    tables = re.findall(r"^\| key .*\n\|---.*\n((?:\|.*\n)+)", page, re.MULTILINE)
    explained = [set(re.findall(r"^\| `(\w+)` \|", rows, re.MULTILINE)) for rows in tables]
    kinds = (
        CellConfig, ShardConfig, PinTable, AspectConfig, RetentionTable, ActorConfig,
        SecurityConfig, RightsConfig, AllowTable,
    )  # fmt: skip
    accepted = [set(keys_of(kind)) for kind in kinds]
    headings = {"shards", "pins", "aspects", "actors", "security", "rights", "allow"}
    assert sorted(map(sorted, explained)) == sorted(sorted(keys - headings) for keys in accepted)

    variables = set(re.findall(r"^\| `(ENACT_\w+)` \|", page, re.MULTILINE))
    of_shards = {variable_of("name", key) for key in variables_of(ShardConfig)}
    of_cell = {f"ENACT_{k}" for kind in (CellConfig, SecurityConfig) for k in variables_of(kind)}
    assert variables == of_cell | of_shards


def test_example_of_cell_toml_is_read(tmp_path):
    """What the page shows is a cell."""
    page = (ROOT / "enact_dist" / "docs" / "cell.md").read_text("utf-8")
    [text] = re.findall(r"^```toml\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    (tmp_path / "cell.toml").write_text(text, "utf-8")
    config = load_config(tmp_path / "cell.toml", environment={})
    assert [shard.name for shard in config.shards] == ["vision", "robot"]
    assert [actor.name for actor in config.actors] == ["camera", "detector"]
