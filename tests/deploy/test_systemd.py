"""The systemd units: what systemd itself finds in them, and that they fit what they start."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from enact_dist.cli.main import build_parser

UNITS = Path(__file__).parents[2] / "deploy" / "systemd"
KINDS = ("shard", "actor")
EXPOSURE_MAX = 2.5
OFFLINE_SINCE = 250
"""The release of systemd whose `security` reads files instead of asking a running one."""


def ask(*words):
    return subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)


@pytest.fixture(scope="module")
def analyze():
    """Call `systemd-analyze`, where there is one that can read files."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze: command not found (Debian package systemd)")
    version = ask("systemd-analyze", "--version").stdout.partition("\n")[0]
    if int(re.search(r"\d+", version)[0]) < OFFLINE_SINCE:
        pytest.skip(
            f"{version}: `systemd-analyze security` has no --offline before {OFFLINE_SINCE}"
        )
    return lambda *words: ask("systemd-analyze", *words)


def unit(kind):
    return UNITS / f"enact-{kind}@.service"


def value_of(kind, key):
    """Return what a unit says for a key that it has once."""
    (found,) = re.findall(rf"^{key}=(.*)$", unit(kind).read_text("utf-8"), re.MULTILINE)
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_systemd_finds_nothing_wrong_with_a_unit(analyze, kind, tmp_path):
    """It says nothing at all: for an unknown key it complains and ends with 0."""
    copy = tmp_path / unit(kind).name
    copy.write_text(unit(kind).read_text("utf-8").replace("/opt/enact/bin/enact", "/bin/true"))
    done = analyze("verify", str(tmp_path / f"enact-{kind}@left.service"))

    assert (done.returncode, done.stderr) == (0, "")


def test_an_actor_may_have_a_user_and_keys_of_its_own(analyze, tmp_path):
    """The drop-in replaces the shared user, and each folder has the name of its actor."""
    copy = tmp_path / unit("actor").name
    copy.write_text(unit("actor").read_text("utf-8").replace("/opt/enact/bin/enact", "/bin/true"))
    text = (UNITS / "own_user.conf").read_text("utf-8")
    for name, said in (("own_user", text), ("wrong", text.replace("RuntimeDirectory=", "Runs="))):
        folder = tmp_path / "enact-actor@.service.d"
        folder.mkdir(exist_ok=True)
        (folder / "own_user.conf").write_text(said)
        done = analyze("verify", str(tmp_path / "enact-actor@fusion.service"))
        assert ("Runs" in done.stderr) == (name == "wrong"), done.stderr
        if name == "own_user":
            assert (done.returncode, done.stderr) == (0, "")
    settings = re.findall(r"^(User|Environment|RuntimeDirectory)=(.*)$", text, re.MULTILINE)
    assert len(settings) == 4
    assert all(value.endswith("%i") for _, value in settings)


def test_a_misspelt_key_of_a_unit_is_found(analyze, tmp_path):
    """The check above bites."""
    text = unit("shard").read_text("utf-8").replace("/opt/enact/bin/enact", "/bin/true")
    (tmp_path / "enact-shard@.service").write_text(text.replace("ProtectHome=", "ProtectHouse="))
    done = analyze("verify", str(tmp_path / "enact-shard@left.service"))

    assert "ProtectHouse" in done.stderr


@pytest.mark.parametrize("kind", KINDS)
def test_a_unit_exposes_little(analyze, kind):
    """At most 2.5 of 10 by systemd's own count."""
    limit = f"--threshold={EXPOSURE_MAX * 10:.0f}"
    done = analyze("security", "--offline=true", limit, str(unit(kind)))
    exposure = float(re.search(r"exposure level for .*: ([0-9.]+)", done.stdout)[1])

    assert done.returncode == 0, done.stdout + done.stderr
    assert exposure <= EXPOSURE_MAX


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_unit_starts_is_a_command_of_ours(kind):
    """Its options exist, and systemd waits longer than the drain that they ask for."""
    program, *words = shlex.split(value_of(kind, "ExecStart").replace("%i", "left"))
    arguments = build_parser().parse_args(words)

    assert program == "/opt/enact/bin/enact"
    assert (arguments.noun, arguments.log) == (kind, "json")
    drain_s = getattr(arguments, "drain_s", 0.0)
    assert float(value_of(kind, "TimeoutStopSec").removesuffix("s")) > drain_s + 2.0


def test_both_units_share_a_user_and_a_folder_that_are_made_for_them():
    """Else large data would travel between processes of one host."""
    user = (UNITS / "sysusers.d" / "enact.conf").read_text("utf-8")
    folder = (UNITS / "tmpfiles.d" / "enact.conf").read_text("utf-8")

    for kind in KINDS:
        assert f"u {value_of(kind, 'User')} " in user
        assert f"ENACT_SHARED_FOLDER={value_of(kind, 'ReadWritePaths')}" in unit(kind).read_text()
        assert f"d {value_of(kind, 'ReadWritePaths')} 2770 enact enact" in folder


def test_user_and_folder_are_made_as_the_files_say(tmp_path):
    """Systemd's own tools read both files, in a root of the test's own."""
    for tool in ("systemd-sysusers", "systemd-tmpfiles"):
        if shutil.which(tool) is None:
            pytest.skip(f"{tool}: command not found (Debian package systemd)")
    (tmp_path / "etc").mkdir()
    root = f"--root={tmp_path}"
    user = ask("systemd-sysusers", root, str(UNITS / "sysusers.d" / "enact.conf"))
    if "Permission denied" in user.stderr or "not permitted" in user.stderr:
        pytest.skip(user.stderr.strip())
    folder = ask("systemd-tmpfiles", "--create", root, str(UNITS / "tmpfiles.d" / "enact.conf"))
    if "not permitted" in folder.stderr:
        pytest.skip(folder.stderr.strip())

    assert (user.returncode, folder.returncode, folder.stderr) == (0, 0, "")
    assert (tmp_path / "etc" / "passwd").read_text().startswith("enact:")
    made = (tmp_path / "dev" / "shm" / "enact").stat()
    assert made.st_mode & 0o7777 == 0o2770
