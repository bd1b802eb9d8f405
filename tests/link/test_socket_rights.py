"""Rights at a real shard: over its socket by user and name, and none over Zenoh."""

from __future__ import annotations

import os
import threading
from contextlib import ExitStack, contextmanager

import pytest
from ports import free_endpoint

from enact_dist import Aspect, Durability, Entities, Entity, Lock, View, ViewEach, Write, connect
from enact_dist.config.read import load_config
from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol.datum import LockId
from enact_dist.core.rights.rules import Rights
from enact_dist.errors import LinkError, PermissionDeniedError
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.link.notices import NoticeQueue
from enact_dist.link.socket import service
from enact_dist.link.socket.peers import PeerCredentials, peer_of
from enact_dist.verify.floods.raw import RawZenoh
from enact_dist.wire.limits import INTEGER_MAX

pytestmark = pytest.mark.carrier("auto")

COUNT = Aspect("count", int, Durability.VOLATILE)
CELL = """\
name = "guarded"
worlds = ["online"]
carrier = "socket"
[shards.s]
listen = "{endpoint}"
[security]
operators = ["ada"]
[rights]
programs = ["camera", "logger"]
uids = {{ 1001 = "camera", 1002 = "@cams" }}
[rights.groups]
cams = ["camera"]
[[rights.allow]]
who = "camera"
read = "online:view/*/count"
write = "online:view/*/count"
[[rights.allow]]
who = ["logger"]
read = "online:**"
"""


@contextmanager
def guarded(tmp_path, *others):
    """Yield a running shard with rights, beside it other ones, and their cell.toml."""
    file = tmp_path / "cell.toml"
    more = (f'[shards.{name}]\nlisten = "{free_endpoint()}"\n' for name in others)
    file.write_text(CELL.format(endpoint=free_endpoint()) + "".join(more), "utf-8")
    config = load_config(file, environment={})
    with ExitStack() as stack:
        for one in reversed(config.shards):
            settings = config.name, config.shard_settings(one.name), one.listen
            shard = start_shard(DaemonSettings(*settings, carrier="socket"))
            stack.callback(shard.stop, drain_s=0.0)
        yield shard, file


def put(cell, entity, value):
    request = Write(cell.world("online"), Entity(entity), COUNT)
    with Lock(request) as lock:
        lock[request] = value


def test_names_of_one_user_have_their_rights_over_the_socket(tmp_path):
    """Four names of this user differ in what they may; the error carries slot and rule."""
    with guarded(tmp_path) as (shard, file):
        with connect(file, actor="camera") as camera:
            put(camera, "view/1", 1)
            with pytest.raises(PermissionDeniedError) as caught:
                put(camera, "plan/1", 1)
            error = caught.value
            assert (error.identity, error.right) == ("camera", "write")
            assert (error.world, error.entity, error.aspect) == ("online", "plan/1", "count")
            assert error.rule == "[rights] of cell.toml"
        with connect(file, actor="logger") as logger:
            seen = View(logger.world("online"), Entity("view/1"), COUNT)
            with Lock(seen) as lock:
                assert lock[seen] == 1
            with pytest.raises(PermissionDeniedError, match="logger may not write"):
                put(logger, "view/1", 2)
        with connect(file, actor="ada") as ada:
            put(ada, "plan/1", 1)
        with connect(file, actor="joe") as joe:
            seen = View(joe.world("online"), Entity("view/1"), COUNT)
            with pytest.raises(PermissionDeniedError, match="joe may not read"), Lock(seen):
                pass
        assert shard.host.figures()["permission_denied"] >= 3


def test_a_reader_sees_data_whose_aspect_one_shard_does_not_know(tmp_path):
    """A pattern lies on all shards, and what it has to register there needs no right to write."""
    with (
        guarded(tmp_path, "t", "u") as (_, file),
        connect(file, actor="camera") as camera,
        connect(file, actor="logger") as logger,
    ):
        put(camera, "view/1", 1)
        seen = ViewEach(logger.world("online"), Entities("view/*"), COUNT)
        with Lock(seen) as lock:
            assert list(lock[seen].values()) == [1]


def test_a_name_over_zenoh_is_no_proof(tmp_path, monkeypatch):
    """It is refused by an error after which an actor tries again."""
    with guarded(tmp_path) as (_, file):
        plain = file.with_name("plain.toml")
        text = file.read_text("utf-8").partition("[security]")[0]
        plain.write_text(text.replace('"socket"', '"zenoh"'), "utf-8")
        with (
            connect(plain, actor="ada") as ada,
            pytest.raises(LinkError, match="over Zenoh, where its name is only its own word"),
        ):
            put(ada, "view/1", 1)


def test_a_name_over_zenoh_ends_nothing_of_that_name(tmp_path):
    """A process that takes a client's name and session id from a listing."""
    with guarded(tmp_path) as (shard, file), connect(file, actor="camera") as camera:
        request = Write(camera.world("online"), Entity("view/1"), COUNT)
        with RawZenoh(load_config(file, environment={})) as raw, Lock(request) as lock:
            (session,), (identity,) = zip(*shard.host.owners().items(), strict=True)
            epoch, held = shard.host.epoch, LockId(session, 0, 1)
            views = tuple(m.LaneView(lane, INTEGER_MAX) for lane in range(4))
            for message in (m.Release(held), m.Goodbye(session)):
                answer = raw.ask("s", message, actor=identity)
                assert answer.code == "unproven"
                assert "asked to end sessions and locks over Zenoh" in answer.text
            renewed = raw.ask("s", m.KeepAlive(session, epoch, 1, views, b""), actor=identity)
            assert isinstance(renewed, m.Alive)
            assert [one.lock.session for one in renewed.grants] == [session]
            lock[request] = 1
        assert shard.host.figures().get("orphans_freed", 0) == 0


def test_a_watch_over_the_socket_leaves_out_what_is_not_readable(tmp_path):
    """Also where a commit changes both; the numbers of its notices have no gap."""
    with (
        guarded(tmp_path) as (_, file),
        connect(file, actor="camera") as camera,
        connect(file, actor="ada") as ada,
        camera.world("online").watch(Entities("**"), COUNT) as watch,
    ):
        put(ada, "secret", 1)
        both = [Write(ada.world("online"), Entity(name), COUNT) for name in ("secret", "view/1")]
        with Lock(*both) as lock:
            for request in both:
                lock[request] = 2
        put(ada, "view/1", 3)
        changes = [watch.next(5.0) for _ in range(2)]
        assert {change.entity.name for change in changes} == {"view/1"}
        assert watch.next(0.2) is None


def test_a_notice_carries_only_data_that_its_watcher_may_read(tmp_path, monkeypatch):
    """Of a commit of several, to an observer, too; what is not readable never reaches its process."""
    came, take = [], NoticeQueue.take

    def noted(queue, found):
        found = list(found)
        came.extend((queue, change) for one in found for change in getattr(one, "changes", ()))
        take(queue, found)

    monkeypatch.setattr(NoticeQueue, "take", noted)
    with ExitStack() as stack:
        _, file = stack.enter_context(guarded(tmp_path))
        ada = stack.enter_context(connect(file, actor="ada"))
        watchers = [
            stack.enter_context(connect(file, actor=name, observer=observer))
            for name, observer in (("camera", False), ("camera", True), ("ada", False))
        ]
        watches = [
            stack.enter_context(one.world("online").watch("**", COUNT, data=True))
            for one in watchers
        ]
        both = [Write(ada.world("online"), Entity(name), COUNT) for name in ("secret", "view/1")]
        with Lock(*both) as lock:
            for request in both:
                lock[request] = 41
        assert all(watch.next(5.0) is not None for watch in watches)
        each = [
            [(change.slot.entity, change.datum is not None) for queue, change in came if queue is w]
            for w in (watch._feed for watch in watches)
        ]
    view, secret = ("view/1", True), ("secret", True)
    assert each == [[view], [view], [secret, view]]


def test_a_reload_changes_whose_rights_a_connection_uses(tmp_path, monkeypatch):
    """At once; one whose user has none any more ends, one that is just admitted is no exception."""
    with guarded(tmp_path) as (shard, file), connect(file, actor="camera") as camera:
        put(camera, "view/1", 1)
        sockets = shard._sockets
        (present,) = [one for mine in sockets._connections.values() for one in mine][:1]
        monkeypatch.setattr(sockets, "_users", frozenset())  # as if of another user
        monkeypatch.setattr(service, "check_peer", lambda connected, **_: peer_of(connected))
        taking = []
        real = sockets._subject_of

        def found_slowly(identity, peer):
            subject = real(identity, peer)
            if not taking:  # a reload begins while a connection is admitted
                taking.append(threading.Thread(target=take, args=("@cams",)))
                taking[0].start()
                taking[0].join(0.2)
            return subject

        def take(name):
            shard.host.take_rights(Rights([], users={} if name is None else {os.geteuid(): name}))
            sockets.take_rights()

        take("camera")
        assert present.subject == "camera"
        monkeypatch.setattr(sockets, "_subject_of", found_slowly)
        with connect(file, actor="camera"):
            taking[0].join()
            subjects = {one.subject for mine in sockets._connections.values() for one in mine}
        assert subjects == {"@cams"}
        take(None)
        assert present.ended.wait(5.0)
        assert shard.host.figures()["sessions_barred"] == 1
        with pytest.raises(LinkError, match="has no rights at shard s"):
            connect(file, actor="camera", timeout_s=0.2)


def test_a_user_without_an_entry_is_refused_by_number(tmp_path):
    """One with an entry has its name or group, and may use none of the others."""
    with guarded(tmp_path) as (shard, _):
        subject_of = shard._sockets._subject_of
        assert subject_of("joe@h:1", PeerCredentials(7, 1001, 1)) == "camera"
        assert subject_of("joe@h:1", PeerCredentials(7, 1002, 1)) == "@cams"
        assert subject_of("camera@h:1", PeerCredentials(7, 1002, 1)) == "@cams"
        with pytest.raises(LinkError, match="called itself logger, which is another name"):
            subject_of("logger@h:1", PeerCredentials(7, 1001, 1))
        for name in ("logger:tool", "ada:probe", "logger%3Atool"):
            with pytest.raises(LinkError, match="which is another name of the cell"):
                subject_of(f"{name}@h:1", PeerCredentials(7, 1001, 1))
        assert subject_of("camera:tool@h:1", PeerCredentials(7, 1001, 1)) == "camera"
        assert subject_of("a%20b@h:1", PeerCredentials(7, 0, 0)) == "a b"
        with pytest.raises(LinkError, match="user 0 of process 7 has no rights"):
            subject_of("@h:1", PeerCredentials(7, 0, 0))
        with pytest.raises(LinkError, match="user 1003 of process 7 has no rights at shard s"):
            subject_of("camera@h:1", PeerCredentials(7, 1003, 1))
