"""Style as a test: imports point down, the core is pure, files and functions stay small."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "enact_dist"
LAYERS = (
    "errors",
    "comparing",
    "retention",
    "patterns",
    "terms",
    "core",
    "wire",
    "link",
    "api",
)  # low to high
PURE = {
    "core": {
        "__future__", "array", "bisect", "collections", "dataclasses", "enum", "hashlib", "heapq",
        "itertools", "operator", "typing",
    },
    "wire": {
        "__future__", "collections", "dataclasses", "enum", "functools", "hashlib", "itertools",
        "math", "msgpack", "numpy", "operator", "re", "reprlib", "types", "typing", "urllib",
    },
}  # fmt: skip
ACTORS_MAY_IMPORT = {
    "enact_dist", "enact_dist.testing", "enact_dist.errors", "enact_dist.outcome",
}  # fmt: skip
TOP_LEVEL = {"LICENSE", "README.md", "actors", "deploy", "enact_dist", "pyproject.toml", "tests"}
LINES_MAX = 500
EXCUSED: dict[str, int] = {}
FUNCTION_LINES_MAX = 70


def python_files(folder):
    return sorted(folder.rglob("*.py"))


def imports(file):
    """Return the dotted names that a file imports; relative imports are refused."""
    nodes = list(ast.walk(ast.parse(file.read_text("utf-8"))))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{file}: use absolute imports, so that a layer can be read off"
            names.add(node.module)
    return names


def layer_of(dotted):
    """`enact_dist.core.slots` is in core; any other module of the package is api."""
    part = dotted.split(".")[1] if "." in dotted else "api"
    return part if part in LAYERS else "api"


def violations(file, package):
    """Return what a file imports from above its layer or from outside a pure one."""
    here = layer_of(".".join(file.relative_to(package.parent).with_suffix("").parts))
    found = []
    for name in imports(file):
        if name.split(".")[0] == "enact_dist":
            if LAYERS.index(layer_of(name)) > LAYERS.index(here):
                found.append(f"{file.name}: {here} must not import {name}")
        elif here in PURE and name.split(".")[0] not in PURE[here]:
            found.append(f"{file.name}: {here} is pure, {name} is not allowed")
    return found


def test_imports_point_down():
    """Every import of the package leads to its own layer or a lower one."""
    assert [v for file in python_files(PACKAGE) for v in violations(file, PACKAGE)] == []


def test_planted_violation_is_found(tmp_path):
    """The check bites: `import time` in core and `link` in wire are both reported."""
    for layer, line in (("core", "import time"), ("wire", "import enact_dist.link.host")):
        file = tmp_path / "enact_dist" / layer / "planted.py"
        file.parent.mkdir(parents=True)
        file.write_text(line)
        assert violations(file, tmp_path / "enact_dist")


def test_only_link_imports_zenoh():
    """Zenoh, sockets' own carrier, stands behind one layer; who looks at it alone says so."""
    looks = {
        "enact_dist/doctor.py",
        "enact_dist/bench/raw_zenoh.py",
        "enact_dist/verify/floods/raw.py",
    }
    users = [f for f in python_files(PACKAGE) if "zenoh" in {n.split(".")[0] for n in imports(f)}]
    above = [file for file in users if file.parent.name != "link"]
    assert {str(file.relative_to(ROOT)) for file in above} <= looks


def test_only_their_verbs_load_benches_and_judges():
    """What measures or breaks a cell is no part of a running one: its verb loads it, at use."""
    for part, others in (("bench", ()), ("verify", ("bench",))):
        for file in python_files(PACKAGE):
            if file.parent.name in {part, *others} or f"/{part}/" in str(file):
                continue
            loads = any(name.startswith(f"enact_dist.{part}") for name in imports(file))
            assert not loads or file == PACKAGE / "cli" / f"{part}.py", file
        tree = ast.parse((PACKAGE / "cli" / f"{part}.py").read_text("utf-8"))
        top = [node.module for node in tree.body if isinstance(node, ast.ImportFrom)]
        assert not any(name.startswith(f"enact_dist.{part}") for name in top)


def test_geometry_knows_nothing_of_enact_dist():
    """Pure functions on arrays stay usable without this project."""
    for file in python_files(ROOT / "actors" / "geometry"):
        assert not any(name.startswith("enact_dist") for name in imports(file)), file


def test_importing_the_package_loads_neither_zenoh_nor_open3d():
    """`import enact_dist` is light: transports and geometry load on use."""
    code = "import sys, enact_dist; print({'zenoh', 'open3d', 'rich'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.parametrize("folder", ["enact_dist", "actors"])
def test_files_and_functions_stay_small(folder):
    """Files of at most 500 lines and functions of at most 70 fit in a head."""
    long_files, long_functions = [], []
    for file in python_files(ROOT / folder):
        name = str(file.relative_to(ROOT))
        text = file.read_text("utf-8")
        if text.count("\n") > EXCUSED.get(name, LINES_MAX):
            long_files.append(name)
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and (
                node.end_lineno - node.lineno + 1 > FUNCTION_LINES_MAX
            ):
                long_functions.append(f"{name}:{node.name}")
    assert (long_files, long_functions) == ([], [])


@pytest.mark.parametrize("folder", ["enact_dist", "actors"])
def test_every_public_name_has_a_docstring(folder):
    """Modules, public classes and public functions say what they are."""
    silent = []
    for file in python_files(ROOT / folder):
        tree = ast.parse(file.read_text("utf-8"))
        if not ast.get_docstring(tree) and file.read_text("utf-8").strip():
            silent.append(str(file.relative_to(ROOT)))
        for node in tree.body:
            public = isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name[0] != "_"
            if public and not ast.get_docstring(node):
                silent.append(f"{file.relative_to(ROOT)}:{node.name}")
    assert silent == []


def test_no_pickle_and_no_unfinished_marks():
    """Nothing is unpickled, and nothing is left to do in a comment."""
    marks = ("TO" + "DO", "FIX" + "ME", "XX" + "X")
    for file in python_files(PACKAGE) + python_files(ROOT / "actors"):
        text = file.read_text("utf-8")
        assert "pickle" not in {name.split(".")[0] for name in imports(file)}, file
        assert not any(mark in text for mark in marks), file


def test_the_top_level_holds_the_agreed_names_alone():
    """A package that a tool downloaded was committed once."""
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip(f"{ROOT} is no clone, or git is missing: what belongs to it is not known")
    command = ["git", "-c", f"safe.directory={ROOT}", "ls-tree", "--name-only", "HEAD"]
    listed = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    assert {name for name in listed if not name.startswith(".")} == TOP_LEVEL
