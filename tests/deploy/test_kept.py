"""What images need is kept whole or not at all, and made once."""

import subprocess
import sys
import threading
from pathlib import Path

import pytest

DEPLOY = Path(__file__).parents[2] / "deploy"
sys.path.insert(0, str(DEPLOY))

import kept  # noqa: E402


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def fill(folder):
    (folder / "one").write_text("whole", "utf-8")


def test_a_second_call_finds_what_the_first_made():
    """Its own recipe is not followed again."""
    first = kept.kept("thing", "recipe", fill)
    second = kept.kept("thing", "recipe", pytest.fail)

    assert first == second
    assert (second / "one").read_text("utf-8") == "whole"


def test_another_recipe_is_made_anew():
    """In a folder of its own, so neither takes the place of the other."""
    assert kept.kept("thing", "one", fill) != kept.kept("thing", "other", fill)


def test_what_could_not_be_made_leaves_nothing():
    """The next run begins anew, and does not take half of it for the whole."""

    def fail(folder):
        fill(folder)
        raise SystemExit(1)

    with pytest.raises(SystemExit):
        kept.kept("thing", "recipe", fail)

    assert [path for path in kept.cache().iterdir() if path.is_dir()] == []
    assert (kept.kept("thing", "recipe", fill) / "one").exists()


def test_who_comes_while_it_is_made_waits_and_has_it(monkeypatch):
    """The second asks for the lock before the first has filled the folder."""
    making, asked, go_on = threading.Event(), threading.Event(), threading.Event()
    found, flock = [], kept.fcntl.flock

    def asks(file, operation):
        if threading.current_thread() is second:
            asked.set()
        flock(file, operation)

    def slowly(folder):
        making.set()
        assert go_on.wait(30)
        fill(folder)

    first = threading.Thread(target=kept.kept, args=("thing", "recipe", slowly))
    first.start()
    assert making.wait(30)
    second = threading.Thread(
        target=lambda: found.append(kept.kept("thing", "recipe", pytest.fail))
    )
    monkeypatch.setattr(kept.fcntl, "flock", asks)
    second.start()
    assert asked.wait(30)
    go_on.set()
    first.join(30)
    second.join(30)

    assert (found[0] / "one").read_text("utf-8") == "whole"


def test_a_missing_program_is_named(capfd):
    """With the package that brings it, and without a traceback."""
    with pytest.raises(SystemExit):
        kept.run("no-such-program-of-ours")

    assert "no-such-program-of-ours: command not found" in capfd.readouterr().err


def test_images_shows_its_help():
    """It starts as a program of its own and lists its options."""
    done = subprocess.run(
        [sys.executable, str(DEPLOY / "images"), "--help"],
        capture_output=True,
        text=True,
        check=True,
    )

    assert "./deploy/images --local-base" in done.stdout
