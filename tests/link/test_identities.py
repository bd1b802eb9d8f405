"""In a cell with keys a client has the name that its certificate proves, whatever it says."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")

import key_cells
from polling import until

from enact_dist import Aspect, Entity, Lock, Read, Write, connect
from enact_dist.cli.main import main
from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol.datum import LockId, Position, Slot, Token
from enact_dist.errors import EnactError, PermissionDeniedError
from enact_dist.link.client import locks as link_client
from enact_dist.link.host import ShardHost
from enact_dist.link.zenoh.access import (
    common_name,
    new_session_id,
    read_revoked,
    split_common_name,
)
from enact_dist.terms import Access
from enact_dist.verify.floods.raw import RawZenoh, hello
from enact_dist.wire.keys import identity_of, token_key
from enact_dist.wire.limits import INTEGER_MAX

pytestmark = pytest.mark.carrier("zenoh")

COUNT = Aspect("count", int)
BEN = identity_of("ben", "host", 1)
OTHER = new_session_id("ben")
PIN = '[[pins]]\nentities = "bench"\nshard = "left"\n'
RIGHTS = """
[rights]
default = "none"
programs = ["reader", "writer"]
[[rights.allow]]
who = "reader"
read = "online:**"
[[rights.allow]]
who = "writer"
read = "online:**"
write = "online:bench/count"
"""


@pytest.fixture
def cell(tmp_path):
    return key_cells.KeyCell(
        tmp_path, {"left": key_cells.endpoint(), "right": key_cells.endpoint()}, more=PIN
    )


def counters(shard):
    """Return the counters of a shard of this process."""
    return shard.host._shard.counters


@pytest.fixture
def submitted(monkeypatch):
    """All messages that reached a shard of this process, with their identities."""
    found = []
    real = ShardHost.submit

    def submit(host, message, reply, identity="", subject=None, lends=False):
        found.append((type(message), identity, subject))
        return real(host, message, reply, identity, subject, lends)

    monkeypatch.setattr(ShardHost, "submit", submit)
    return found


def forged(welcome, session, holders):
    """Return what would take a session, its lock or its datum away (H2)."""
    epoch, slot = welcome.epoch, Slot("online", "bench", "count")
    item = m.Item(int(Access.WRITE), "online", "bench", "count")
    held = [(one.lock, one.number) for one in holders if one.lock.session == session]
    for lock, number in [*held, (LockId(session, 0, 1), 1)]:
        later = LockId(session, lock.lane, lock.seq + 1)
        yield m.Commit(lock, Token(epoch, number), (m.WriteItem(slot, None),), 0)
        yield m.Release(lock)
        yield m.Acquire(later, epoch, welcome.placement.version, 0, (item,), 0, 0, 0)
    yield m.KeepAlive(session, epoch, INTEGER_MAX, (m.LaneView(0, INTEGER_MAX),), b"")
    yield hello(session, actor="ben")
    yield m.Goodbye(session)


def decisions(lock):
    """Return what only another shard may send (H4)."""
    for stamp_ns in (INTEGER_MAX, time.time_ns() + 3_600_000_000_000, 1):
        for name in ("left", "right"):
            yield m.Finish(lock, Position(stamp_ns, name))
    yield m.Resolve(lock, Token(1, 1), "right")


def test_messages_in_the_name_of_others_reach_no_session(cell, submitted):
    """A valid key of another name takes nothing: 30 of 30 commits of the victim stand."""
    with (
        cell.running() as left,
        cell.running("right"),
        connect(cell.file, actor="ada") as victim,
        RawZenoh(cell.config, keys=cell.files("ben")) as raw,
    ):
        welcome = raw.welcome("left", new_session_id("ben"), identity=BEN, actor="ben")
        count = Write(victim.world("online"), Entity("bench"), COUNT)
        with Lock(count) as lock:
            lock[count] = 0
        session = next(one.session for one in victim.actors() if one.actor == "ada")
        ada = left.host.owner_of(session)
        assert ada.startswith("ada@")
        silent = refused = 0
        for number in range(30):
            with Lock(count) as lock:
                holders = raw.ask("left", m.ListLocks(), actor=BEN).holders
                for message in forged(welcome, session, holders):
                    before = len(submitted)
                    assert raw.ask("left", message, actor=ada, timeout_s=1) is None
                    kinds = {kind for kind, identity, _ in submitted[before:] if identity == ada}
                    assert type(message) not in kinds - {m.KeepAlive}
                    silent += 1
                    answer = raw.ask("left", message, actor=BEN)
                    assert isinstance(answer, m.Refused), answer
                    assert answer.code == "permission"
                    assert "belongs to ada@" in answer.text or "is none of ben" in answer.text
                    refused += 1
                lock[count] = number + 1
        assert (silent, refused) == (30 * 9, 30 * 9)
        for message in decisions(LockId(session, 0, 1)):
            for who, expected in ((BEN, "permission"), ("shard.right", None), (ada, None)):
                answer = raw.ask("left", message, actor=who, timeout_s=1)
                assert (answer and answer.code) == expected
        for pattern in ("*", "**", "ada@$*"):
            key = raw.key("left", "list_locks", BEN).replace(BEN, pattern)
            answers = [one.ok for one in raw.session.get(key, timeout=1.0)]
            assert not any(answers), pattern
        with Lock(count) as lock:
            assert lock[count] == 30
        assert {subject for _, identity, subject in submitted if identity == ada} == {"ada"}


def test_stranger_hears_and_says_nothing_with_a_key_of_its_own(cell):
    """No queryable, notice or token of another name counts (H1)."""
    heard = []
    with (
        cell.running() as shard,
        cell.running("right"),
        connect(cell.file, actor="ada") as victim,
        RawZenoh(cell.config, mode="client", keys=cell.files("ben")) as raw,
    ):
        raw.welcome("left", new_session_id("ben"), identity=BEN, actor="ben")
        session = next(one.session for one in victim.actors() if one.actor == "ada")
        declared = [
            raw.session.declare_queryable(
                "enact/locked/left/**", lambda query: heard.append(str(query.key_expr))
            ),
            raw.session.declare_subscriber("**", lambda one: heard.append(str(one.key_expr))),
            raw.session.liveliness().declare_token(token_key("locked", "ada@vm:1", session)),
        ]
        count = Write(victim.world("online"), Entity("bench"), COUNT)
        for number in range(20):
            raw.session.put("enact/locked/@notices/left", b"", attachment=b"\x90")
            with Lock(count) as lock:
                lock[count] = number
        for one in declared:
            one.undeclare()
        later = raw.session.liveliness().declare_token(token_key("locked", BEN, OTHER))
        until(lambda: (OTHER, BEN) in shard._service.present)  # so it has heard of the ends, too
        with Lock(count) as lock:
            assert lock[count] == 19
        assert [one.session for one in victim.actors() if one.actor == "ada"] == [session]
        assert not [key for key in heard if "@notices" not in key]
        later.undeclare()


def test_client_has_the_name_of_its_key(cell):
    """Its own word stands behind it: in listings, holders and causes."""
    with cell.running(), cell.running("right"):
        with connect(cell.file, actor="probe") as probe:
            count = Write(probe.world("online"), Entity("bench"), COUNT)
            with Lock(count) as lock:
                lock[count] = 1
                assert [one.actor for one in probe.actors()] == ["ada:probe"]
            probe_session = probe.actors()[0].session
            assert probe.why("online", "bench", "count").actor == "ada:probe"
        with RawZenoh(cell.config, keys=cell.files("ben")) as raw:
            raw.welcome("left", new_session_id("ben"), identity=BEN, actor="ben")
            for name in ("ada", "benn", "ada:ben", "client"):
                answer = raw.ask("left", hello(OTHER, actor=name), actor=BEN)
                assert answer.code == "permission"
                assert f"called itself '{name}'" in answer.text
            assert raw.ask("left", hello(OTHER, actor="ben:x"), actor=BEN).shard == "left"
            answer = raw.ask("right", hello(probe_session, actor="ben"), actor=BEN)
            assert answer.code == "permission"  # nor may it greet first where the owner has not
            assert "is none of ben" in answer.text
            ping = raw.key("left", "ping", "ada@vm:1")
            assert not [one for one in raw.session.get(ping, timeout=1.0) if one.ok is not None]


def test_revoked_key_ends_its_sessions_and_lets_nobody_in(cell, capsys, monkeypatch):
    """At the reload its locks are free; the next key of that name is as good as ever."""
    monkeypatch.setattr(link_client, "FINISH_S", 1.0)  # its commit is never answered

    def write_as_ada():
        with connect(cell.file, actor="ada") as ada:
            free = Write(ada.world("online"), Entity("bench"), COUNT)
            with Lock(free, wait_s=1.0) as lock_of_ada:
                lock_of_ada[free] = 2

    with cell.running() as shard, cell.running("right") as other:
        with connect(cell.file, actor="ben", request_timeout_s=2.0) as ben:
            held = Write(ben.world("online"), Entity("bench"), COUNT)
            lock = Lock(held)
            lock.__enter__()
            lock[held] = 1
            assert main(["cell", "keys", "revoke", "ben", "--cell", str(cell.file)]) == 0
            assert "enact shard reload --all" in capsys.readouterr().out
            assert main(["cell", "keys", "ls", "--cell", str(cell.file)]) == 1
            assert "revoked: renew it" in capsys.readouterr().out
            assert shard.reload()
            assert other.reload()
            assert counters(shard)["sessions_barred"] == 1
            with ThreadPoolExecutor() as another_thread:
                another_thread.submit(write_as_ada).result()
            began_s = time.monotonic()
            with pytest.raises(PermissionDeniedError, match="this key of ben") as caught:
                connect(cell.file, actor="ben")
            assert caught.value.identity == "ben"
            assert time.monotonic() - began_s < 3.0
            with pytest.raises(EnactError):
                lock.__exit__(None, None, None)
        assert main(["cell", "keys", "renew", "ben", "--cell", str(cell.file)]) == 0
        capsys.readouterr()
        with connect(cell.file, actor="ben") as again:
            now = Read(again.world("online"), Entity("bench"), COUNT)
            with Lock(now) as lock:
                assert lock[now] == 2
    assert main(["cell", "keys", "revoke", "shard.left", "--cell", str(cell.file)]) == 2
    assert "replace the authority" in capsys.readouterr().err
    assert read_revoked(cell.keys) == {"ben": 1}
    assert split_common_name(common_name("ben", 1)) == ("ben", 1)


def test_bar_ends_the_sessions_of_a_name_whatever_tokens_it_declares(cell, capsys):
    """One for another's session does not end that one, and none at all keeps no session."""
    with (
        cell.running() as shard,
        cell.running("right"),
        connect(cell.file, actor="ada") as victim,
        RawZenoh(cell.config, keys=cell.files("ben")) as raw,
    ):
        raw.welcome("left", new_session_id("ben"), identity=BEN, actor="ben")
        count = Write(victim.world("online"), Entity("bench"), COUNT)
        with Lock(count) as lock:
            session = next(one.session for one in victim.actors() if one.actor == "ada")
            token = raw.session.liveliness().declare_token(token_key("locked", BEN, session))
            until(lambda: (session, BEN) in shard._service.present)
            assert {identity for one, identity in shard._service.present if one == session} == {
                BEN,
                shard.host.owner_of(session),
            }
            assert main(["cell", "keys", "revoke", "ben", "--cell", str(cell.file)]) == 0
            assert shard.reload()
            assert counters(shard)["sessions_barred"] == 1
            assert not shard.host.knows(BEN)
            lock[count] = 1
        token.undeclare()
        assert raw.ask("left", hello(OTHER, actor="ben"), actor=BEN, timeout_s=1) is None
        assert [one.session for one in victim.actors() if one.actor == "ada"] == [session]


def test_rights_follow_the_key_and_a_reload(tmp_path):
    """Over the network as over a socket; a file that cannot be used leaves the old rights."""
    cell = key_cells.KeyCell(tmp_path, more=RIGHTS)
    with (
        cell.running() as shard,
        connect(cell.file, actor="reader") as reader,
        connect(cell.file, actor="writer") as writer,
    ):
        count = Write(writer.world("online"), Entity("bench"), COUNT)
        with Lock(count) as lock:
            lock[count] = 1
        seen = Read(reader.world("online"), Entity("bench"), COUNT)
        with Lock(seen) as lock:
            assert lock[seen] == 1
        wanted = Write(reader.world("online"), Entity("bench"), COUNT)
        with (
            pytest.raises(PermissionDeniedError, match="reader may not write") as caught,
            Lock(wanted),
        ):
            pass
        assert caught.value.identity == "reader"

        text = cell.file.read_text()
        cell.file.write_text(text.replace('read = "online:**"\nwrite', "broken = 1\nwrite"))
        assert not shard.reload()
        with Lock(count) as lock:
            lock[count] = 2
        cell.file.write_text(text.replace('write = "online:bench/count"', ""))
        assert shard.reload()
        with pytest.raises(PermissionDeniedError, match="writer may not write"), Lock(count):
            pass
        cell.file.write_text(text.replace("[rights", "[rights").partition("[rights]")[0])
        assert not shard.reload()
        assert counters(shard)["reloads_refused"] == 2


def test_updates_go_on_while_others_are_barred(cell):
    """A reload that removes one name takes nothing from another one."""
    stop, done = threading.Event(), []
    with cell.running() as shard, cell.running("right"), connect(cell.file, actor="ada") as ada:
        count = Write(ada.world("online"), Entity("bench"), COUNT)
        with Lock(count) as lock:
            lock[count] = 0

        def update():
            while not stop.is_set():
                with Lock(count) as lock:
                    lock[count] += 1
                done.append(1)

        updating = threading.Thread(target=update)
        updating.start()
        assert main(["cell", "keys", "revoke", "ben", "--cell", str(cell.file)]) == 0
        assert shard.reload()
        stop.set()
        updating.join()
        with Lock(count) as lock:
            assert lock[count] == len(done)
