"""What images install is what pyproject.toml asks for, pinned to files that cannot change."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "deploy" / "requirements"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
IN_THE_IMAGE = {"sys_platform": "linux", "platform_machine": "x86_64", "python_version": "3.11"}
LOCKS = ("build.txt", "core.txt", "record.txt", "perception.txt", "workcell.txt", "database.txt")
REMEDY = "run ./deploy/images --lock"


def pins(lock):
    """Return the version of each package in a lock file."""
    text = (FOLDER / lock).read_text("utf-8")
    return dict(re.findall(r"^([\w.-]+)==(\S+)", text, re.MULTILINE))


def asked(lock):
    """Return what pyproject.toml asks for in the place that a lock file serves."""
    project = PROJECT["project"]
    extras = project["optional-dependencies"]
    patroni = (ROOT / "deploy" / "survive" / "patroni.txt").read_text("utf-8")
    texts = {
        "database.txt": re.findall(r"^\w.*", patroni, re.MULTILINE),
        "build.txt": PROJECT["build-system"]["requires"],
        "core.txt": project["dependencies"],
        "record.txt": project["dependencies"] + extras["record"] + extras["postgres"],
        "perception.txt": project["dependencies"] + extras["actors"],
        "workcell.txt": project["dependencies"] + extras["workcell"] + extras["record"],
    }[lock]
    left_out = left_out_of(lock)
    found = [one for text in texts if (one := Requirement(text)).name not in left_out]
    return [one for one in found if one.marker is None or one.marker.evaluate(IN_THE_IMAGE)]


def left_out_of(lock):
    """Return the packages that the image of a lock does without."""
    file = "left_out_workcell.txt" if lock == "workcell.txt" else "left_out.txt"
    return set(re.findall(r"^[\w-]+", (FOLDER / file).read_text("utf-8"), re.MULTILINE))


@pytest.mark.parametrize("lock", LOCKS)
def test_a_lock_holds_what_the_project_asks_for(lock):
    """A bound that was raised in pyproject.toml alone is noticed."""
    pinned = pins(lock)
    for requirement in asked(lock):
        version = pinned.get(canonicalize_name(requirement.name))
        assert version in requirement.specifier, f"{requirement}: {version} in {lock}; {REMEDY}"


@pytest.mark.parametrize("lock", LOCKS)
def test_every_pin_names_the_hashes_of_its_files(lock):
    """A registry cannot replace a file under its version."""
    entries = re.split(r"^(?=[\w.-]+==)", (FOLDER / lock).read_text("utf-8"), flags=re.MULTILINE)

    assert len(entries) > 1
    assert [entry for entry in entries[1:] if "--hash=sha256:" not in entry] == []


@pytest.mark.parametrize("lock", ["record.txt", "perception.txt", "workcell.txt"])
def test_all_images_have_the_same_core(lock):
    """A cell mixes them."""
    pinned = pins(lock)

    assert {name: pinned.get(name) for name in pins("core.txt")} == pins("core.txt")


@pytest.mark.parametrize("lock", ["perception.txt", "workcell.txt"])
def test_what_is_left_out_is_in_no_lock(lock):
    """It does not return through what another package needs."""
    left_out = left_out_of(lock)

    assert left_out
    assert left_out & set(pins(lock)) == set(), REMEDY


def test_build_tools_are_asked_for_in_one_way():
    """The lock is made from a file of its own, as no tool reads the table `build-system`."""
    text = (FOLDER / "build.in").read_text("utf-8")

    assert text.split() == PROJECT["build-system"]["requires"]


def pip_lines():
    """Yield where a document or a message tells people to install this project, and what."""
    folders = [ROOT / name for name in ("deploy", "enact_dist", "actors")]
    files = [
        file for folder in folders for kind in ("md", "py") for file in folder.rglob(f"*.{kind}")
    ]
    for file in (ROOT / "README.md", *files):
        text, place = file.read_text("utf-8"), str(file.relative_to(ROOT))
        for what in re.findall(r"""pip install (?:-e )?['"]?([^\s'"`)]*)""", text):
            named = what.startswith(("enact", ".", "/")) or "[" in what
            if named and "{extra}" not in what:  # `enact_dist.extras` fills in what a call names
                yield place, what
        for extra in re.findall(r"""\b(?:require|needing)\("[^"]+", "([^"]+)\"""", text):
            yield place, f".[{extra}]"


def test_every_pip_line_works_from_a_clone():
    """Nothing is on an index yet: each line names the clone, and only extras that there are."""
    extras = PROJECT["project"]["optional-dependencies"].keys()
    found = list(pip_lines())

    asking = {"README.md", "enact_dist/operate/doctor.py", "enact_dist/cli/demo/workcell.py"}
    assert asking <= {place for place, _ in found}
    for place, what in found:
        path, _, wanted = what.rstrip("]").partition("[")
        assert path in {".", "/path/to/enact-dist"}, (place, what)
        assert {*filter(None, wanted.split(","))} <= extras, (place, what)
