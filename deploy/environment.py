"""Sets up what the demo and the tests need, once: the virtual environment and Debian's libraries.

Used by `deploy/demo` and `deploy/test`; standard library only, as nothing else is there yet.  A
stamp file in `.venv` makes a second run start at once.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
STAMP = VENV / "enact-setup"
PYTHON_MIN = (3, 11)

LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libudev.so.1": "libudev1",
    "libidn2.so.0": "libidn2-0",
    "libgomp.so.1": "libgomp1",
}
"""Shared libraries that Open3D loads, and the Debian packages that hold them."""


def say(text: str) -> None:
    """Print one line of progress."""
    print(f"[setup] {text}", flush=True)


def give_up(text: str) -> None:
    """Print what is to be done and leave with status 1."""
    print(f"[setup] {text}", file=sys.stderr, flush=True)
    raise SystemExit(1)


def missing_packages() -> list[str]:
    """Return the Debian packages whose libraries cannot be loaded."""
    missing = []
    for library, package in LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(package)
    return missing


def install_packages(packages: list[str]) -> None:
    """Install Debian packages if this user may, else say the exact line and leave."""
    line = f"apt-get install -y {' '.join(packages)}"
    if os.geteuid() != 0 or shutil.which("apt-get") is None:
        give_up(
            f"Open3D needs Debian packages that are not installed: run\n\n    sudo {line}\n\n"
            "and start this again."
        )
    say(line)
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for command in (["apt-get", "update", "-qq"], line.split()):
        done = subprocess.run(command, env=environment, check=False, capture_output=True, text=True)
        if done.returncode and command[1] != "update":
            give_up(f"'{line}' failed:\n{done.stderr.strip()}")
    still = missing_packages()
    if still:
        give_up(f"installed, but still not loadable: {' '.join(still)}; run 'ldconfig' as root")


def dev_tools() -> list[str]:
    """Return the development tools that pyproject.toml lists."""
    table = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    return list(table["dependency-groups"]["dev"])


def fingerprint(*, tests: bool) -> str:
    """Return what an installed environment must match."""
    text = (ROOT / "pyproject.toml").read_bytes() + sys.version.encode() + str(ROOT).encode()
    return hashlib.sha256(text).hexdigest() + ("+tests" if tests else "")


def make_venv() -> None:
    """Make `.venv`; on Debian that needs python3-venv."""
    say(f"making {VENV.name} with Python {platform.python_version()}")
    done = subprocess.run(
        [sys.executable, "-m", "venv", "--clear", str(VENV)],
        check=False,
        capture_output=True,
        text=True,
    )
    if done.returncode == 0:
        return
    if os.geteuid() == 0 and shutil.which("apt-get"):
        install_packages([f"python{sys.version_info[0]}.{sys.version_info[1]}-venv"])
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(VENV)], check=True)
        return
    give_up(
        "cannot make a virtual environment: run\n\n    sudo apt-get install -y python3-venv\n\n"
        f"and start this again.\n{done.stdout.strip()} {done.stderr.strip()}"
    )


def prepare(*, tests: bool) -> Path:
    """Return the Python of a complete environment, set up if it is not there yet.

    Args:
        tests: Also install the development tools.
    """
    if sys.version_info < PYTHON_MIN:
        give_up(f"Python {platform.python_version()} is too old; 3.11 or newer is needed")
    packages = missing_packages()
    if packages:
        install_packages(packages)
    found = STAMP.read_text("utf-8") if STAMP.exists() else ""
    if found in (fingerprint(tests=True), fingerprint(tests=tests)):
        return PYTHON
    if not PYTHON.exists():
        make_venv()
    wanted = [
        "-e",
        f"{ROOT}[actors,workcell,record,keys,view,postgres]",
        *(dev_tools() if tests else []),
    ]
    say("installing packages (some 700 MB, once)")
    pip = [str(PYTHON), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    done = subprocess.run([*pip, *wanted], check=False, cwd=ROOT)
    if done.returncode:
        give_up("pip could not install the packages; its words stand above")
    STAMP.write_text(fingerprint(tests=tests), "utf-8")
    return PYTHON
