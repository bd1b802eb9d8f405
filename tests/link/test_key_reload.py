"""A shard takes new keys while it runs: asked, by a signal, and by itself near their end."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")

import key_cells
from polling import until

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.cli.main import main
from enact_dist.cli.shard.reload import catches_hangup, listening_process
from enact_dist.link.daemon import reload
from enact_dist.link.daemon.reload import Reload
from enact_dist.link.zenoh.tls import look, own_certificate
from enact_dist.operate.keys import Authority, make_authority

pytestmark = pytest.mark.carrier("zenoh")

COUNT = Aspect("count", int)


@pytest.fixture
def cell(tmp_path):
    return key_cells.KeyCell(tmp_path)


def shown_end_s(cell):
    """Return when the certificate ends that the shard shows; 0 while it shows none."""
    found = look(cell.shards["left"], cell.files("ada")).certificate
    return found.ends_s if found is not None else 0.0


def test_reload_under_updates_loses_none_and_takes_a_moment(cell):
    """Sessions, held locks and waiters stay; the longest pause of an update is short."""
    pauses, stop = [], threading.Event()
    with (
        cell.running() as shard,
        connect(cell.file, actor="ada") as here,
        connect(cell.file, actor="ben") as there,
    ):
        count = Write(here.world("online"), Entity("bench"), COUNT)
        held = Write(there.world("online"), Entity("held"), COUNT)
        with Lock(count) as lock:
            lock[count] = 0

        def update():
            last_s = time.monotonic()
            while not stop.is_set():
                with Lock(count) as lock:
                    lock[count] += 1
                pauses.append(time.monotonic() - last_s)
                last_s = time.monotonic()

        def go_on():
            enough = len(pauses) + 20
            until(lambda: len(pauses) >= enough)

        before = shown_end_s(cell)
        with Lock(held) as holding:
            updating = threading.Thread(target=update)
            updating.start()
            for _ in range(3):
                go_on()
                cell.make("shard.left", seconds=5000)
                assert shard.reload()
            go_on()
            stop.set()
            updating.join()
            holding[held] = 7
        assert shown_end_s(cell) < before
        seen = Write(here.world("online"), Entity("held"), COUNT)
        with Lock(count, seen) as lock:
            assert lock[count] == len(pauses)
            assert lock[seen] == 7
        print(f"{len(pauses)} updates, the longest took {max(pauses):.3f} s")
        assert len(here.actors()) == 2
    assert max(pauses) < 2.0  # 0.2 s on an idle machine


def test_client_that_ends_during_a_reload_loses_its_locks(cell):
    """Its token does not come back, and no event reports that."""
    code = f"""
import signal
from enact_dist import Aspect, Entity, Lock, Write, connect
cell = connect({str(cell.file)!r}, actor="ben")
lock = Lock(Write(cell.world("online"), Entity("bench"), Aspect("count", int)))
lock.__enter__()
print("held", flush=True)
signal.pause()
"""
    with cell.running() as shard:
        holder = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert holder.stdout.readline() == "held\n"
        real = shard._open_session

        def open_later():
            holder.kill()
            holder.wait()
            return real()

        shard._open_session = open_later
        assert shard.reload()
        holder.stdout.close()
        with (
            connect(cell.file, actor="ada") as here,
            Lock(Write(here.world("online"), Entity("bench"), COUNT), wait_s=20) as lock,
        ):
            assert lock.position is None


def test_files_that_cannot_be_used_leave_the_old_ones(cell, caplog, tmp_path):
    """With the reason in the log; clients notice nothing."""
    make_authority("stranger", tmp_path / "stranger")
    stranger = Authority.load(tmp_path / "stranger")
    with cell.running() as shard, connect(cell.file, actor="ada") as here:
        before = shown_end_s(cell)
        for change, said in (
            (lambda: cell.make("shard.left", seconds=100, starts_s=-1000), "ended on"),
            (lambda: cell.make("shard.left", authority=stranger), "issuer certificate"),
            (cell.files("shard.left").private_key.unlink, "cannot read"),
        ):
            change()
            caplog.clear()
            assert not shard.reload()
            assert "not reloaded, so the old keys, names and rights stay: " in caplog.text
            assert said in caplog.text
        assert shown_end_s(cell) == before
        count = Write(here.world("online"), Entity("bench"), COUNT)
        with Lock(count) as lock:
            lock[count] = 1


def test_shard_takes_a_new_certificate_by_itself_near_the_end(tmp_path, monkeypatch):
    """Not before: a key that was copied half is no reason to drop one that is good."""
    looks, is_due = [], Reload._is_due
    monkeypatch.setattr(Reload, "_is_due", lambda now: looks.append(is_due(now)) or looks[-1])
    monkeypatch.setattr(reload, "LOOK_S_MAX", 0.2)  # else 60 s for the certificate of two years

    def look_on():
        enough = len(looks) + 3  # of the first the file may be older, of the last the end missing
        until(lambda: len(looks) >= enough)

    cell = key_cells.KeyCell(tmp_path)
    cell.make("shard.left", seconds=60, starts_s=-54.0)  # a tenth is 6 s (and what it starts early)
    with cell.running():
        before = shown_end_s(cell)
        look_on()
        assert shown_end_s(cell) == before  # there is no newer file
        cell.make("shard.left")
        until(lambda: shown_end_s(cell) > before)
        long = shown_end_s(cell)
        cell.make("shard.left", seconds=100)
        look_on()
        assert shown_end_s(cell) == long  # its own is good for two years


def test_command_and_signal_let_a_daemon_read_its_keys(cell, capsys):
    """In another process; a process that SIGHUP would end is not told."""
    words = [sys.executable, "-m", "enact_dist.cli.main", "shard", "run", "left"]
    words += ["--cell", str(cell.file)]
    reload = ["shard", "reload", "left", "--cell", str(cell.file)]
    assert main(reload) == 3
    assert "no process of this user listens" in capsys.readouterr().out
    daemon = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert "ready" in daemon.stdout.readline()
        port = int(cell.shards["left"].rpartition(":")[2])
        assert listening_process(port) == daemon.pid
        until(lambda: catches_hangup(daemon.pid))

        cell.make("shard.left", seconds=5000)
        assert main(reload) == 0
        assert "reloaded" in capsys.readouterr().out
        assert shown_end_s(cell) == own_certificate(cell.files("shard.left")).ends_s
        assert main(["shard", "reload", "--all", "--cell", str(cell.file)]) == 0
        assert "reloaded" in capsys.readouterr().out

        cell.make("shard.left")
        os.kill(daemon.pid, signal.SIGHUP)
        until(lambda: shown_end_s(cell) == own_certificate(cell.files("shard.left")).ends_s)
        cell.make("shard.left", seconds=100, starts_s=-1000)
        assert main(reload) == 1
        assert "which it would refuse" in capsys.readouterr().out
    finally:
        daemon.terminate()
        assert daemon.wait(20) == 0
        assert "reloaded in" in daemon.stdout.read()
        daemon.stdout.close()
    assert not catches_hangup(os.getpid())


def test_what_is_asked_between_two_daemons_is_done_by_the_next():
    """A takeover has nothing that takes keys: a signal that comes then is not lost."""
    reload, taken = Reload(None), []
    reload.turn_to(lambda: taken.append("standby"), taken.append, None)
    assert reload()
    reload.pause()
    assert not reload()
    reload.turn_to(lambda: taken.append("shard"), taken.append, None)
    reload.turn_to(lambda: taken.append("next"), taken.append, None)
    reload.close()

    assert taken == ["standby", "reloads", "shard", "reloads"]
