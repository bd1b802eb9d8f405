"""What images need and no registry gives: made or fetched once, kept outside the clone.

Used by `deploy/images`, and by the tests that start an engine of their own; standard library only.
Everything lies in `${XDG_CACHE_HOME:-~/.cache}/enact-dist`, in folders named by the hash of their
recipe.  A folder appears whole or not at all, so an interrupted run leaves nothing half-made.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import platform
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from environment import PYTHON, ROOT, give_up, say

REQUIREMENTS = ROOT / "deploy" / "requirements"
WHEELS = ROOT / "deploy" / "wheels"
LOCKS = (
    *("build.txt", "core.txt", "record.txt", "keys.txt"),
    *("perception.txt", "workcell.txt", "database.txt"),
)
PACKAGES = ("libraries.txt", "database_packages.txt")
"""Packages of Debian that images unpack, as installing them would bring several times as much."""
SUITE = "bookworm"
BASE_TAG = f"enact-ci-base:{SUITE}"
BASE_PACKAGES = "python3,python3-pip,python3-venv,ca-certificates,usr-is-merged"
COMPOSE_SUITE = "trixie"
"""The first release of Debian with Compose v2; its one binary asks for no library but libc."""

BASE_HOOKS = (
    # As the image that it stands in for: python and pip under /usr/local/bin, pip may install.
    'rm -f "$1"/usr/lib/python3.*/EXTERNALLY-MANAGED',
    'for n in python python3; do ln -sf /usr/bin/python3 "$1"/usr/local/bin/$n; done',
    'ln -sf /usr/bin/pip3 "$1"/usr/local/bin/pip',
)
RETRIES = 3
"""So often a download is tried again that fails for the moment."""
LEFT_OUT = ("/usr/share/man/*", "/usr/share/locale/*", "/usr/share/doc/*")


def cache() -> Path:
    """Return the folder of all that is kept."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "enact-dist"


def kept(name: str, recipe: str, make: Callable[[Path], None]) -> Path:
    """Return the folder that `make` filled, now or in an earlier run.

    Args:
        name: What it is.
        recipe: What decides its content; another recipe is another folder.
        make: Fills the folder that it is given; what it raises leaves nothing behind.
    """
    place = cache() / f"{name}-{hashlib.sha256(recipe.encode()).hexdigest()[:16]}"
    with alone(name):
        if not place.is_dir():
            part = Path(tempfile.mkdtemp(prefix=f"{name}.part-", dir=place.parent))
            try:
                make(part)
                part.chmod(0o755)
                part.rename(place)
            finally:
                shutil.rmtree(part, ignore_errors=True)
    return place


@contextlib.contextmanager
def alone(name: str) -> Iterator[None]:
    """Let one process at a time work on something; others wait, and find it done."""
    cache().mkdir(parents=True, exist_ok=True)
    with (cache() / f"{name}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def run(*words: str, cwd: Path | None = None) -> None:
    """Run a command that prints nothing when it works; leave with its words when it does not."""
    try:
        done = subprocess.run(words, cwd=cwd, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        give_up(f"{words[0]}: command not found; install the Debian package of that name")
    if done.returncode:
        give_up(f"'{' '.join(words)}' failed:\n{(done.stderr or done.stdout).strip()}")


def base() -> Path:
    """Return a folder with base.tar, a Debian with Python, and the packages that images unpack."""
    packages = {
        name for file in PACKAGES for name in (REQUIREMENTS / file).read_text("utf-8").split()
    }
    fetch = f"cd /packages && apt-get download -qq {' '.join(sorted(packages))}"
    words = [
        "mmdebstrap",
        "--quiet",
        "--variant=minbase",
        f"--include={BASE_PACKAGES}",
        # With usr-is-merged: else a package that merges /usr brings all of Perl, 50 MB.
        "--hook-dir=/usr/share/mmdebstrap/hooks/merged-usr",
        *(f"--dpkgopt=path-exclude={pattern}" for pattern in LEFT_OUT),
        *(f"--customize-hook={hook}" for hook in BASE_HOOKS),
        '--customize-hook=mkdir -m 777 "$1"/packages',
        f"--customize-hook=chroot \"$1\" sh -c '{fetch}'",
    ]

    def make(folder: Path) -> None:
        say(f"making a base image of Debian {SUITE} (a minute, once)")
        out = (
            f'--aptopt=Acquire::Retries "{RETRIES}"',
            f"--customize-hook=sync-out /packages {folder}",
            '--customize-hook=rm -r "$1"/packages',
        )
        run(*words, *out, SUITE, str(folder / "base.tar"))

    return kept("base", "\n".join([*words, SUITE, platform.machine()]), make)


def pip() -> list[str]:
    """Return how pip is called here."""
    for python in (shutil.which("python3"), shutil.which(PYTHON)):
        words = [str(python), "-m", "pip", "--disable-pip-version-check"]
        if (
            python
            and not subprocess.run(
                [*words, "--version"], capture_output=True, check=False
            ).returncode
        ):
            return words
    give_up("no pip: apt-get install python3-pip")
    return []


def wheels() -> Path:
    """Return a folder with the wheels of all locks, for the image's Python and this processor."""
    recipe = "".join((REQUIREMENTS / lock).read_text("utf-8") for lock in LOCKS)
    machine = platform.machine()
    platforms = [f"manylinux_2_{minor}_{machine}" for minor in range(36, 4, -1)]
    platforms += [f"manylinux2014_{machine}", f"linux_{machine}"]

    def make(folder: Path) -> None:
        say("fetching wheels (380 MB, once)")
        run(
            *pip(), "download", "--quiet", "--only-binary=:all:", "--no-deps", "--require-hashes",
            "--python-version=3.11", "--implementation=cp",
            *(f"--abi={abi}" for abi in ("cp311", "abi3", "none")),
            *(f"--platform={name}" for name in platforms),
            *(word for lock in LOCKS for word in ("-r", str(REQUIREMENTS / lock))),
            f"--dest={folder}",
        )  # fmt: skip

    return kept("wheels", recipe + machine, make)


def fill_wheels() -> None:
    """Make deploy/wheels hold exactly what a build without network needs."""
    files = [*wheels().glob("*.whl"), *base().glob("*.deb")]
    with alone("filling"):
        shutil.rmtree(WHEELS, ignore_errors=True)
        WHEELS.mkdir()
        for file in files:
            try:
                os.link(file, WHEELS / file.name)
            except OSError:  # another file system
                shutil.copy2(file, WHEELS)


def compose_plugin() -> Path:
    """Return the program docker-compose of Debian's first release that has version 2."""
    found = Path("/etc/apt/sources.list.d/debian.sources")
    if not found.is_file():
        give_up("no compose plugin: install docker-compose-v2 or docker-compose-plugin")

    def make(folder: Path) -> None:
        say("fetching the compose plugin (13 MB, once)")
        with tempfile.TemporaryDirectory() as name:
            own = Path(name)
            for part in ("sources", "lists/partial", "cache/archives/partial"):
                (own / part).mkdir(parents=True)
            first = found.read_text("utf-8").split("\n\n")[0]
            text = re.sub(r"^Suites:.*", f"Suites: {COMPOSE_SUITE}", first, flags=re.MULTILINE)
            (own / "sources" / "next.sources").write_text(text + "\n", "utf-8")
            apt = [
                "apt-get", "-qq",
                "-o", f"Dir::State::lists={own}/lists",
                "-o", f"Dir::Cache={own}/cache",
                "-o", "Dir::Etc::sourcelist=/dev/null",
                "-o", f"Dir::Etc::sourceparts={own}/sources",
                "-o", "APT::Sandbox::User=root",
                "-o", f"Acquire::Retries={RETRIES}",
            ]  # fmt: skip
            run(*apt, "update")
            run(*apt, "download", "docker-compose", cwd=own)
            run("dpkg-deb", "-x", str(next(own.glob("docker-compose_*.deb"))), str(own / "x"))
            plugin = own / "x/usr/libexec/docker/cli-plugins/docker-compose"
            shutil.copy2(plugin, folder)

    return kept("compose", COMPOSE_SUITE + platform.machine(), make) / "docker-compose"


def docker_command() -> str:
    """Return a Docker command line with BuildKit, or nothing: the first in PATH may lack it."""
    surroundings = {**os.environ, "DOCKER_BUILDKIT": "1"}
    for command in (shutil.which("docker"), shutil.which("/usr/bin/docker")):
        words = [command or "", "build", "--help"]
        if (
            command
            and not subprocess.run(
                words, env=surroundings, capture_output=True, check=False
            ).returncode
        ):
            return command
    return ""


def found_compose_plugin() -> Path | None:
    """Return the compose plugin that is installed, or was kept by `deploy/images --fetch`."""
    homes = [os.environ.get("DOCKER_CONFIG") or str(Path.home() / ".docker")]
    homes += ["/usr/local/lib/docker", "/usr/local/libexec/docker"]
    homes += ["/usr/lib/docker", "/usr/libexec/docker"]
    places = [Path(home) / "cli-plugins" / "docker-compose" for home in homes]
    places += sorted(cache().glob("compose-*/docker-compose"))
    return next((place for place in places if os.access(place, os.X_OK)), None)
