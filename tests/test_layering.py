"""Style as a test: imports point down, the core is pure, files and functions stay small."""

import ast
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import enact_dist

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "enact_dist"
LAYERS = (
    ("errors",),
    ("comparing", "extras", "patterns", "retention"),
    ("terms",),
    ("outcome",),
    ("core.protocol",),
    ("core.failover", "core.rights"),
    ("core.state",),
    ("core.client", "core.offline", "core.shard"),
    ("wire",),
    ("config",),
    ("link",),
    ("access",),
    ("compare",),
    ("world",),
    ("operate",),
    ("actor",),
    ("", "testing", "types"),  # "": what `from enact_dist import …` gives
    ("recording",),
    ("cli",),
    ("view",),
    ("verify",),
    ("bench",),
)
"""Low to high; parts of one row do not import each other."""
UPWARD = {
    "cli/bench.py -> bench",  # a verb loads what measures at use
    "cli/verify.py -> verify",
    "cli/view.py -> view",
}
"""Imports that lead up.  This list, and those below, can only shrink: the tests compare exactly."""
DEMONSTRATED = {
    "bench/cases/palletizing.py", "bench/cases/workcell.py", "cli/demo/palletizing.py",
    "cli/demo/workcell.py", "cli/workcell.py",
}  # fmt: skip
"""The files of the package that show or measure the applications of `actors`, and import them."""
CIRCLES: dict[str, int] = {}
"""Circles of imports that are left: the first file of each, and how many files it has."""
MODULES_MAX = 12
MODULES_MAX_OF = {
    "enact_dist/cli": 16,
    "enact_dist/wire": 16,
    "actors/palletizing": 16,
    "actors/workcell": 16,
}
"""Of the folders of verbs, of data types, and of the actors that a cell file names."""
FULL_FOLDERS: dict[str, int] = {}
"""Folders with more modules, and with how many."""
DEFINED_AGAIN: dict[str, int] = {"Outcome": 2}
"""Public classes of one name, and how many there are.  `Outcome` is a message and a public datum type."""
PURE = {
    "core": {
        "__future__", "array", "bisect", "collections", "dataclasses", "enum", "functools", "hashlib",
        "heapq", "itertools", "operator", "typing",
    },
    "wire": {
        "__future__", "collections", "dataclasses", "enum", "functools", "hashlib", "itertools",
        "math", "msgpack", "numpy", "operator", "re", "reprlib", "types", "typing", "urllib",
    },
}  # fmt: skip
PUBLIC = set(re.findall(r"^    (enact_dist[.\w]*)  ", enact_dist.__doc__, re.MULTILINE))
"""The modules that the package lists as its public ones."""
ACTORS_STILL_IMPORT = {
    "actor.binding", "actor.check", "actor.graph", "actor.running.commands", "actor.running.load",
    "config.read", "core.protocol.datum", "link.signals", "wire.payload", "world.trees",
}  # fmt: skip
"""Modules inside the package that applications use beside its public parts."""
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


def part_of(dotted):
    """`enact_dist.core.state.slots` is in core.state, `enact_dist.link.host` in link."""
    names = dotted.split(".")[1:]
    return ".".join(names[: 2 if names[:1] == ["core"] else 1])


def modules(*folders):
    """Return the files of these packages by the dotted name that imports them."""
    return {dotted_of(file, each.parent): file for each in folders for file in python_files(each)}


def dotted_of(file, root):
    """Return the name that imports a file; a package's own is that of its folder."""
    return ".".join(file.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def imported(file, known):
    """Return the modules that a file imports, in annotations and inside functions, too."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom):
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in known else node.module for name in names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


def upward(package):
    """Return the imports that lead to a part of the same row or of a higher one."""
    rank = {part: number for number, row in enumerate(LAYERS) for part in row}
    known, found = modules(package), set()
    for file in known.values():
        here = part_of(dotted_of(file, package.parent))
        for name in imported(file, known):
            part = part_of(name)
            if name.split(".")[0] == package.name and part != here and rank[part] >= rank[here]:
                found.add(f"{file.relative_to(package)} -> {part}")
    return found


def circles(*folders):
    """Return the circles of imports: the files of each, sorted."""
    known = modules(*folders)
    arrows = {name: imported(file, known) & set(known) - {name} for name, file in known.items()}
    reached = {name: _reached(name, arrows) for name in arrows}
    found = {
        frozenset(other for other in reached[name] if name in reached[other]) for name in arrows
    }
    root = folders[0].parent
    return [sorted(str(known[name].relative_to(root)) for name in one) for one in found if one]


def _reached(name, arrows):
    left, found = [name], set()
    while left:
        new = arrows[left.pop()] - found
        found |= new
        left += new
    return found


def violations(file, package):
    """Return what a file of a pure part imports from outside the package."""
    part = part_of(dotted_of(file, package.parent)).split(".")[0]
    outside = {name for name in imports(file) if name.split(".")[0] != package.name}
    if part not in PURE:
        return []
    return [
        f"{file.name}: {part} is pure, {name} is not allowed"
        for name in outside
        if name.split(".")[0] not in PURE[part]
    ]


def test_imports_point_down():
    """Every import of the package leads to its own part or to a lower one."""
    assert upward(PACKAGE) == UPWARD


def test_only_demonstrations_import_the_applications():
    """The package works without them."""
    loads = {
        str(file.relative_to(PACKAGE))
        for file in python_files(PACKAGE)
        if any(name.split(".")[0] == "actors" for name in imports(file))
    }
    assert loads == DEMONSTRATED


def test_core_and_wire_are_pure():
    """Neither a clock nor a thread, file or socket: time and ids come in as arguments."""
    assert [v for file in python_files(PACKAGE) for v in violations(file, PACKAGE)] == []


def test_no_circle_of_imports():
    """Whoever reads a file need not have read one that needs it."""
    found = circles(PACKAGE, ROOT / "actors")
    assert {one[0]: len(one) for one in found} == CIRCLES, found


def test_folders_stay_small():
    """A folder is read at one glance; one that grows is split by a noun of the field."""
    full = {}
    files = python_files(PACKAGE) + python_files(ROOT / "actors")
    for folder in {file.parent for file in files}:
        name = str(folder.relative_to(ROOT))
        count = sum(file.name != "__init__.py" for file in folder.glob("*.py"))
        if count > MODULES_MAX_OF.get(name, MODULES_MAX):
            full[name] = count
    assert full == FULL_FOLDERS


def test_public_classes_are_defined_once():
    """One word, one thing: a class that is met in a message or a trace is found by its name."""
    nodes = [node for f in python_files(PACKAGE) for node in ast.parse(f.read_text("utf-8")).body]
    names = Counter(node.name for node in nodes if isinstance(node, ast.ClassDef))
    again = {name: n for name, n in names.items() if n > 1 and not name.startswith("_")}
    assert again == DEFINED_AGAIN


def test_planted_violation_is_found(tmp_path):
    """The checks bite: a clock in core, an import that leads up, and a circle are reported."""
    for name, text in {
        "core/state/clocked.py": "import time",
        "wire/upward.py": "def f():\n    import enact_dist.link.host",
        "link/host.py": "if TYPE_CHECKING:\n    from enact_dist.link.other import Other",
        "link/other.py": "from enact_dist.link import host",
    }.items():
        file = tmp_path / "enact_dist" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    package = tmp_path / "enact_dist"

    assert violations(package / "core" / "state" / "clocked.py", package)
    assert upward(package) == {"wire/upward.py -> link"}
    assert circles(package) == [["enact_dist/link/host.py", "enact_dist/link/other.py"]]


def test_only_link_imports_zenoh():
    """Zenoh, sockets' own carrier, stands behind one layer; who looks at it alone says so."""
    looks = {
        "enact_dist/bench/echoes/zenoh_echo.py",
        "enact_dist/verify/floods/raw.py",
    }
    users = [f for f in python_files(PACKAGE) if "zenoh" in {n.split(".")[0] for n in imports(f)}]
    above = [file for file in users if PACKAGE / "link" not in file.parents]
    assert {str(file.relative_to(ROOT)) for file in above} == looks


def test_only_their_verbs_load_benches_and_judges():
    """What measures or breaks a cell is no part of a running one: its verb loads it, at use."""
    for part, others in (("bench", ()), ("verify", ("bench",))):
        for file in python_files(PACKAGE):
            if file.relative_to(PACKAGE).parts[0] in {part, *others}:
                continue
            loads = any(name.startswith(f"enact_dist.{part}") for name in imports(file))
            assert not loads or file == PACKAGE / "cli" / f"{part}.py", file
        tree = ast.parse((PACKAGE / "cli" / f"{part}.py").read_text("utf-8"))
        top = [node.module for node in tree.body if isinstance(node, ast.ImportFrom)]
        assert not any(name.startswith(f"enact_dist.{part}") for name in top)


def test_actors_import_the_public_parts():
    """What the applications need beside them is listed, and the list can only shrink."""
    known = modules(PACKAGE)
    names = {n for file in python_files(ROOT / "actors") for n in imported(file, known)}
    inside = {n for n in names if n.split(".")[0] == "enact_dist"} - PUBLIC
    assert {name.removeprefix("enact_dist.") for name in inside} == ACTORS_STILL_IMPORT


def test_geometry_knows_nothing_of_enact_dist():
    """Pure functions on arrays stay usable without this project."""
    for file in python_files(ROOT / "actors" / "geometry"):
        assert not any(name.startswith("enact_dist") for name in imports(file)), file


def test_importing_the_package_loads_neither_zenoh_nor_open3d():
    """`import enact_dist` is light: transports and geometry load on use."""
    code = "import sys, enact_dist; print({'zenoh', 'open3d', 'rich'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.parametrize("folder", ["enact_dist", "actors", "tests"])
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


def test_every_test_says_what_it_shows():
    """The docstring adds to the name: one that repeats it would be none."""
    silent, tests = [], 0
    for file in python_files(ROOT / "tests"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                tests += 1
                said = (ast.get_docstring(node) or "").lower().rstrip(".")
                if said in {"", node.name.removeprefix("test_").replace("_", " ")}:
                    silent.append(f"{file.relative_to(ROOT)}:{node.name}")
    assert tests > 4000
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
