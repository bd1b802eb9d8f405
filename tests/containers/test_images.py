"""The images: built without a network, small, without rights, and able to do their work."""

import json
import re

import pytest
from engine import ROOT

pytestmark = pytest.mark.containers

MEGABYTES_MAX = {"core": 300, "keys": 300, "perception": 870, "workcell": 820}
DATABASE_MEGABYTES_MAX = 290
BARE = ("run", "--rm", "--network", "none", "--read-only", "--cap-drop", "ALL", "--tmpfs", "/tmp")
"""A container without network, rights, or a place to write but /tmp."""


@pytest.fixture(scope="module")
def inspect(engine, images):
    """Return what the engine knows of an image."""

    def ask(target):
        return json.loads(engine.docker("image", "inspect", f"enact-{target}").stdout)[0]

    return ask


@pytest.mark.parametrize("target", MEGABYTES_MAX)
def test_an_image_is_small(inspect, target):
    """Each stays below its own limit, so a heavy dependency is noticed."""
    size = inspect(target)["Size"] / 1e6

    assert size <= MEGABYTES_MAX[target], f"enact-{target}: {size:.0f} MB"


@pytest.mark.parametrize("target", MEGABYTES_MAX)
def test_an_image_says_what_it_is_and_starts_enact_without_a_shell(inspect, target):
    """Its user is no root, and its label is its name."""
    config = inspect(target)["Config"]

    assert config["User"] == "10001:10001"
    assert config["Entrypoint"] == ["enact"]
    assert config["Labels"]["org.opencontainers.image.title"] == f"enact-{target}"


@pytest.mark.parametrize("target", MEGABYTES_MAX)
def test_enact_runs_without_rights_on_a_read_only_root(engine, images, target):
    """No network, no capability, and no folder to write but /tmp."""
    said = engine.docker(*BARE, f"enact-{target}", "--version").stdout

    assert said.startswith("enact-dist ")


def test_the_database_is_small_and_misses_no_library(engine, images, inspect):
    """Its packages were unpacked by a list, without what they depend on."""
    found = inspect("database")
    asked = (
        "ldd /usr/lib/postgresql/15/bin/* /usr/bin/etcd | grep 'not found';"
        "postgres --version; etcd --version; patroni --version;"
        "patronictl --help; python -c 'import patroni.dcs.etcd3, psycopg'"
    )
    done = engine.docker(*BARE, "--entrypoint", "sh", "enact-database", "-c", asked, check=False)

    assert found["Size"] / 1e6 <= DATABASE_MEGABYTES_MAX
    assert found["Config"]["User"] == "10001:10001"
    assert done.returncode == 0, done.stderr
    assert "not found" not in done.stdout
    for said in ("postgres (PostgreSQL) 15.", "etcd Version: 3.", "patroni 4.", "switchover"):
        assert said in done.stdout, done.stdout


def python(engine, target, text, *options):
    """Run Python in a container; return the process."""
    return engine.docker(
        *BARE, *options, "--entrypoint", "python", f"enact-{target}", "-c", text, check=False
    )


def test_perception_loads_open3d_and_computes_with_it(engine, images):
    """Its shared libraries are there, and what was left out of the image is not missed."""
    done = python(
        engine,
        "perception",
        "import os, open3d as o3d, cv2, scipy.ndimage;"
        "cloud = o3d.geometry.TriangleMesh.create_sphere().sample_points_uniformly(500);"
        "cloud.estimate_normals();"
        "print(os.getuid(), len(cloud.normals))",
    )

    assert (done.returncode, done.stdout) == (0, "10001 500\n"), done.stderr


def test_workcell_loads_what_its_actors_load_late(engine, images):
    """OMPL, ruckig and the compiler of the simulated cameras."""
    done = python(
        engine,
        "workcell",
        "import cv2, numba, scipy.optimize, ruckig, mcap; from ompl import base, geometric, util;"
        "print(hasattr(cv2, 'aruco'))",
    )

    assert (done.returncode, done.stdout) == (0, "True\n"), done.stderr


@pytest.mark.parametrize("target", MEGABYTES_MAX)
def test_an_image_misses_nothing_but_what_was_left_out(engine, images, target):
    """The locks were made for another machine: here the packages themselves are asked."""
    done = engine.docker(
        *(*BARE, "--entrypoint", "pip", f"enact-{target}"),
        *("--python", "/opt/venv/bin/python", "check"),
        check=False,
    )
    missing = set(re.findall(r"requires (\S+), which is not installed", done.stdout))
    left_out = (ROOT / "deploy" / "requirements" / "left_out.txt").read_text("utf-8")

    assert missing == (
        set(re.findall(r"^[\w-]+", left_out, re.MULTILINE)) if target == "perception" else set()
    )
    assert missing or done.returncode == 0, done.stdout + done.stderr


def test_only_the_image_that_makes_keys_has_what_makes_them(engine, images):
    """A shard's image could not forge a certificate."""
    loads = "import cryptography; print('loaded')"

    assert python(engine, "keys", loads).stdout == "loaded\n"
    assert "No module named 'cryptography'" in python(engine, "core", loads).stderr


def test_core_has_no_open3d(engine, images):
    """The small image comes without the large library."""
    done = python(engine, "core", "import open3d")

    assert "No module named 'open3d'" in done.stderr


def test_a_write_outside_of_the_volumes_is_refused(engine, images):
    """The folder of data is read-only, too, unless it is a volume."""
    done = python(engine, "core", "open('/var/lib/enact/note', 'w')")

    assert "Read-only file system" in done.stderr


def test_a_fresh_volume_belongs_to_the_user_of_the_image(engine, images):
    """No one has to change its owner first."""
    done = python(engine, "core", "open('/var/lib/enact/note', 'w')", "--volume", "/var/lib/enact")

    assert done.returncode == 0, done.stderr


COMPILED = """
import os, sys
import numpy, zenoh, rich.table, open3d, enact_dist.cli.main

def is_compiled(module):
    with open(module.__cached__, "rb") as file:
        written_s = int.from_bytes(file.read(16)[8:12], "little")
    return written_s == int(os.stat(module.__file__).st_mtime)

ours = [
    module
    for module in list(sys.modules.values())
    if getattr(module, "__cached__", None) and module.__file__.startswith("/opt/venv/")
]
print(len(ours) > 100, [module.__name__ for module in ours if not is_compiled(module)])
"""


def test_everything_is_compiled(engine, images):
    """On a read-only root a module without a fitting .pyc is compiled at every start."""
    done = python(engine, "perception", COMPILED)

    assert done.stdout == "True []\n", done.stdout + done.stderr


def test_a_shard_in_a_container_answers_its_check(engine, images):
    """With nothing to write to but its volume."""
    cell = 'name = "one"\nworlds = ["online"]\n[shards.left]\nlisten = "tcp/127.0.0.1:7447"\n'
    file = engine.folder / "cell.toml"
    file.write_text(cell + 'folder = "/var/lib/enact/left"\n', "utf-8")
    engine.docker(
        *("run", "--detach", "--name", "left", "--network", "none", "--read-only", "--init"),
        *("--cap-drop", "ALL", "--tmpfs", "/tmp", "--volume", "/var/lib/enact"),
        *("--volume", f"{file}:/etc/enact/cell.toml:ro"),
        *("enact-core", "shard", "run", "left", "--cell", "/etc/enact/cell.toml"),
    )
    try:
        asked = engine.docker(
            *("exec", "left", "enact", "shard", "check", "left"),
            *("--cell", "/etc/enact/cell.toml", "--ready", "--timeout", "30"),
            check=False,
        )
        log = engine.docker("logs", "left").stderr
        assert asked.returncode == 0, asked.stdout + asked.stderr + log
    finally:
        engine.docker("rm", "--force", "--volumes", "left")
