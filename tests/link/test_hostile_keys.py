"""Clients with a valid key, or one that looks like it: what no name gives, over either carrier."""

from __future__ import annotations

import contextlib
import datetime as dt
import threading

import pytest

pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")

import key_cells
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from enact_dist import Aspect, Entities, Entity, Lock, View, ViewEach, Write, connect
from enact_dist.core.protocol import messages as m
from enact_dist.errors import ConfigError, EnactError, PermissionDeniedError
from enact_dist.link.client import locks as link_client
from enact_dist.link.host import ShardHost
from enact_dist.link.zenoh.access import new_session_id, opens
from enact_dist.link.zenoh.tls import KeyFiles, own_certificate, why_refused
from enact_dist.verify.floods.raw import RawZenoh
from enact_dist.wire.frames import encode_frame
from enact_dist.wire.keys import identity_of, quoted_identity, request_key

pytestmark = pytest.mark.carrier("auto")

COUNT = Aspect("count", int)
BEN = identity_of("ben", "host", 1)
ODD_NAMES = ["ada/x", "ada@vm:1", "@vision", "*", "**", "ada~", "ada\nben", "x" * 201]
both = pytest.mark.parametrize("way", ["zenoh", "socket"])


def certificate_of(cell, name, use=ExtendedKeyUsageOID.CLIENT_AUTH):
    """Return files with a certificate of the cell's authority that the commands do not make."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name, _validate=False)])
    now, day = dt.datetime.now(dt.UTC), dt.timedelta(days=1)
    draft = x509.CertificateBuilder(cell.authority.certificate.subject, subject, key.public_key())
    draft = draft.serial_number(x509.random_serial_number())
    draft = draft.not_valid_before(now - day).not_valid_after(now + day)
    draft = draft.add_extension(x509.ExtendedKeyUsage([use]), critical=False)
    signed = draft.sign(cell.authority.key, hashes.SHA256())
    files = KeyFiles(cell.keys, "odd")
    files.certificate.write_bytes(signed.public_bytes(serialization.Encoding.PEM))
    files.private_key.touch(0o600)
    files.private_key.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )
    return files


@pytest.fixture
def submitted(monkeypatch):
    """The kinds of all messages that reached a shard of this process."""
    found, real = [], ShardHost.submit

    def submit(host, message, *others):
        found.append(type(message))
        real(host, message, *others)

    monkeypatch.setattr(ShardHost, "submit", submit)
    return found


@pytest.mark.filterwarnings("ignore:Attribute's length")
@pytest.mark.parametrize("name", ODD_NAMES)
def test_certificate_of_an_odd_name_lets_ask_who_is_there_and_no_more(tmp_path, name, submitted):
    """One made with another tool: it stands for no name of the cell, under none is it heard."""
    cell = key_cells.KeyCell(tmp_path)
    files = certificate_of(cell, name)
    hello = m.Hello(new_session_id("ada"), 0, 2_000_000_000, "ada", "vm", 1, False)
    with cell.running(), RawZenoh(cell.config, keys=files) as raw:
        ping = encode_frame(m.Ping())[0]
        pongs = []
        while not pongs:  # it connects
            asked = raw.session.get("enact/*/*/ping/client", attachment=ping, timeout=1.0)
            pongs = [one for one in asked if one.ok is not None]
        submitted.clear()
        for identity in ("client", "ada@vm:1", quoted_identity(name), identity_of(name, "vm", 1)):
            assert raw.ask("left", hello, actor=identity, timeout_s=0.3) is None, identity
        assert submitted == []
        with pytest.raises(ConfigError, match="proves the name"):
            own_certificate(files)


def test_certificate_of_a_server_opens_no_connection_of_a_client(tmp_path):
    """Of the right name and authority, but for another use; the look says why in half a second."""
    cell = key_cells.KeyCell(tmp_path)
    files = certificate_of(cell, "odd", ExtendedKeyUsageOID.SERVER_AUTH)
    with cell.running():
        assert why_refused([cell.shards["left"]], cell.files("ada"), "left") == ""
        refused_here = why_refused([cell.shards["left"]], files, "left")
        assert "unsuitable certificate purpose" in refused_here
        with (
            RawZenoh(cell.config, keys=files) as raw,
            RawZenoh(cell.config, keys=cell.files("ben")) as ben,
        ):
            ben.welcome("left", new_session_id("ben"), identity=BEN, actor="ben")
            assert not raw.session.info.peers_zid()


@pytest.mark.parametrize("name", ["a/b", "ada@host", "x" * 61, "x" * 201, "@vision", "*"])
def test_no_file_of_a_cell_has_such_a_name(tmp_path, name):
    """It is refused where it is written, so none of its certificates is ever made."""
    cell = key_cells.KeyCell(tmp_path)
    cell.file.write_text(cell.file.read_text().replace('"ben"', f'"{name}"'))
    with pytest.raises(ConfigError, match=r"operator|cannot have a key"):
        cell.config  # noqa: B018 - reading it is the act


PATTERNS = [
    ("*", BEN), ("**", BEN), ("l$*", BEN), ("list_$*", BEN),
    ("list_locks", "*"), ("list_locks", "**"), ("list_locks", "ben@$*"), ("list_locks", "ada@vm:1"),
    ("list_locks", "shard.left"), ("finish", "shard.left"), ("survey", BEN),
]  # fmt: skip


@pytest.mark.parametrize(("verb", "who"), PATTERNS)
def test_key_of_several_verbs_or_names_or_of_another_one_reaches_no_shard(
    tmp_path, verb, who, submitted
):
    """Zenoh drops it, or the shard refuses it before its core."""
    cell = key_cells.KeyCell(tmp_path)
    with cell.running(), RawZenoh(cell.config, keys=cell.files("ben")) as raw:
        raw.welcome("left", new_session_id("ben"), identity=BEN, actor="ben")
        submitted.clear()
        key = request_key("locked", "left", "ping", "client").rsplit("/", 2)[0]
        asked = raw.session.get(
            f"{key}/{verb}/{who}", attachment=encode_frame(m.ListLocks())[0], timeout=0.5
        )
        answers = [one for one in asked if one.ok is not None]
        assert len(answers) == (1 if (verb, who) == ("survey", BEN) else 0)
        assert m.ListLocks not in submitted


@both
def test_name_that_is_removed_loses_its_lock_at_the_reload(tmp_path, way, monkeypatch):
    """The next one that waits for it has it; what the removed one writes is not there."""
    monkeypatch.setattr(link_client, "FINISH_S", 1.0)  # its commit is never answered
    cell = key_cells.KeyCell(tmp_path, carrier=way)
    with (
        cell.running() as shard,
        connect(cell.file, actor="ada") as ada,
        connect(cell.file, actor="ben", request_timeout_s=2.0) as ben,
    ):
        held = Write(ben.world("online"), Entity("cup"), COUNT)
        wanted, got = Write(ada.world("online"), Entity("cup"), COUNT), []

        def wait():
            with Lock(wanted, wait_s=30.0) as lock:
                got.append(lock.get(wanted, 0))
                lock[wanted] = 1

        waiting = threading.Thread(target=wait)
        with contextlib.suppress(EnactError), Lock(held, hold_s=60.0) as lock:
            waiting.start()
            cell.file.write_text(cell.file.read_text().replace('"ada", "ben"', '"ada"'))
            assert shard.reload()
            waiting.join()
            lock[held] = 7
        assert got == [0]
        assert shard.host.figures()["sessions_barred"] == 1
        with Lock(wanted) as lock:
            assert lock[wanted] == 1


RIGHTS = """
[[pins]]
entities = "left/*"
shard = "left"
[[pins]]
entities = "right/*"
shard = "right"
[rights]
default = "none"
programs = ["arm"]
[[rights.allow]]
who = "arm"
change = "online:left/*/count"
read = "online:left/*/count"
"""
LEFT, RIGHT, NEW = Entity("left/cup"), Entity("right/cup"), Entity("left/new")


def locked(*writes, data=(1,)):
    """Lock, and write each."""
    with Lock(*writes) as lock:
        for write, datum in zip(writes, data, strict=False):
            if datum is None:
                del lock[write]
            else:
                lock[write] = datum


ACTS = {
    "write online:right/cup/count": lambda c: locked(write(c, RIGHT)),
    "write online:right/cup/count over two shards": lambda c: locked(write(c, LEFT), write(c, RIGHT)),
    "write online:right/cup/count in another order": lambda c: locked(write(c, RIGHT), write(c, LEFT)),
    "read online:right/cup/count beside a lock": lambda c: locked(write(c, LEFT), view(c, RIGHT), data=()),
    "init online:left/new/count": lambda c: locked(write(c, NEW)),
    "delete online:left/cup/count": lambda c: locked(write(c, LEFT), data=(None,)),
    "read online:right/cup/count": lambda c: c.world("online").view(view(c, RIGHT)),
    "read online:**/count": lambda c: c.world("online").view(
        ViewEach(c.world("online"), Entities("**"), COUNT)
    ),
    "fork online -> spare": lambda c: c.world("online").fork("spare"),
    "drop online": lambda c: c.drop_world("online"),
    "register what_if": lambda c: c.create_world("what_if"),
    "keep day": lambda c: c.pin("day", c.world("online").history(LEFT, COUNT)),
    "break locks": lambda c: c.break_lock(1, shard="left", reason="x"),
    "resolve locks": lambda c: c.force_abort(1, shard="left", reason="x"),
    "resolve locks and alarms": lambda c: c.acknowledge_alarms(shard="left", how="x"),
}  # fmt: skip


def write(cell, entity):
    return Write(cell.world("online"), entity, COUNT)


def view(cell, entity):
    return View(cell.world("online"), entity, COUNT)


def refused(ada, arm, what):
    """Whether an act is refused by name, and has left nothing at either shard."""
    with pytest.raises(PermissionDeniedError) as caught:
        ACTS[what](arm)
    error = caught.value
    assert (error.identity, error.right) == ("arm", what.partition(" ")[0])
    assert str(error).startswith(f"arm may not {' '.join(what.split()[:2])}"), what
    assert error.rule == "[rights] of cell.toml"
    if what.startswith(("write", "init", "delete")):
        assert f"{error.world}:{error.entity}/{error.aspect}" == what.split()[1]
    assert [lock for lock in ada.locks() if lock.actor == "arm"] == [], what
    locked(write(arm, LEFT), data=(0,))  # what it may it still does
    with Lock(write(ada, LEFT), write(ada, RIGHT)) as lock:
        assert [lock[write(ada, one)] for one in (LEFT, RIGHT)] == [0, 0], what
    return ada.worlds() == ("online",)


@both
def test_act_without_its_right_names_it_and_leaves_nothing(tmp_path, way):
    """Of a lock over two shards nothing waits, is held or prepared at the other one either."""
    ends = {name: key_cells.endpoint() for name in ("left", "right")}
    cell = key_cells.KeyCell(tmp_path, ends, carrier=way, more=RIGHTS)
    with cell.running("left"), cell.running("right"), connect(cell.file, actor="ada") as ada:
        locked(write(ada, LEFT), write(ada, RIGHT), data=(0, 0))
        with connect(cell.file, actor="arm") as arm:
            assert [what for what in ACTS if not refused(ada, arm, what)] == []


def test_secret_of_any_characters_is_compared():
    """One that is not ASCII, or empty, is wrong and no error."""
    session = new_session_id("ben")

    assert not opens("\N{SNOWMAN}" * 40, session)
    assert not opens("", session)
