"""A cell with keys: who may connect, and what the others learn."""

import socket
import threading
import time

import pytest

pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")

import key_cells
from polling import until

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.config.rights import SecurityConfig
from enact_dist.errors import ConfigError, ShardUnreachableError
from enact_dist.link.daemon import health
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.zenoh.tls import client_keys, look, own_certificate, why_refused
from enact_dist.operate.keys import Authority, make_authority

pytestmark = pytest.mark.carrier("zenoh")

COUNT = Aspect("count", int)


@pytest.fixture
def cell(tmp_path):
    return key_cells.KeyCell(tmp_path)


@pytest.fixture
def stranger(tmp_path):
    """Another authority, of which no shard knows."""
    make_authority("stranger", tmp_path / "stranger")
    return Authority.load(tmp_path / "stranger")


@pytest.fixture
def away(tmp_path):
    """A key folder of another host."""
    return tmp_path / "away"


def refusal(cell, files, shard="left"):
    """Return why a shard cannot be reached with these files, and check that it takes no longer."""
    began_s = time.monotonic()
    reason = why_refused([cell.shards[shard]], files, shard)
    assert time.monotonic() - began_s < 1.5  # 0.5 s on an idle machine
    return reason


@pytest.mark.carrier("zenoh", "socket")
def test_updates_and_commits_over_two_shards_work_with_keys(tmp_path, carrier):
    """Locks, commits and shards that call each other."""
    shards = {"left": key_cells.endpoint(), "right": key_cells.endpoint("localhost")}
    cell = key_cells.KeyCell(tmp_path, shards, carrier=carrier)
    with cell.running("left"), cell.running("right"), connect(cell.file, actor="ada") as here:
        online = here.world("online")
        counts = [Write(online, Entity(f"bench/{n}"), COUNT) for n in range(8)]
        with Lock(*counts) as lock:
            for one in counts:
                lock[one] = 1
        with Lock(*counts) as lock:
            assert [lock[one] for one in counts] == [1] * 8
        assert [one.reachable and one.slots > 0 for one in here.shards()] == [True, True]
    with cell.running("left"):
        found = health.of_shards(
            "locked", {n: [e] for n, e in shards.items()}, timeout_s=1.0, keys=cell.files("ada")
        )
    assert [(one.name, one.alive) for one in found] == [("left", True), ("right", False)]


def test_client_without_a_key_cannot_connect(cell, monkeypatch):
    """Neither by the file, nor by the endpoint, nor over plain TCP."""
    place = cell.shards["left"]
    with cell.running():
        for name in ("ada", "ben"):
            cell.files(name).certificate.unlink()
        cell.files("shard.left").certificate.rename(cell.folder / "aside")
        with pytest.raises(ConfigError, match="no certificate for 'ada'"):
            connect(cell.file, actor="ada")
        with pytest.raises(ConfigError, match=f"{place} needs a key.*ENACT_KEYS"):
            connect(place)
        with pytest.raises(ShardUnreachableError):
            connect(place.replace("tls", "tcp"), timeout_s=0.3)


def test_endpoint_alone_takes_the_keys_of_the_environment(cell, monkeypatch):
    """Where there is no file of the cell."""
    monkeypatch.setenv("ENACT_KEYS", str(cell.keys))
    monkeypatch.setenv("ENACT_IDENTITY", "ben")
    with cell.running(), connect(cell.shards["left"], actor="enact") as here:
        assert here.name == "locked"


def test_refused_certificate_of_a_client_is_explained(cell, stranger, away):
    """By what is wrong with it, as a shard sees it."""
    with cell.running():
        expired = cell.make("ben", seconds=100, starts_s=-1000)
        assert "alert certificate expired; it ended on" in refusal(cell, expired)
        began_s = time.monotonic()
        with pytest.raises(ShardUnreachableError, match=r"ben\.crt: alert certificate expired"):
            connect(cell.file, actor="ben", timeout_s=60.0)
        assert time.monotonic() - began_s < 10.0  # 0.5 s on an idle machine: nothing to wait for
        young = cell.make("ben", seconds=5000, starts_s=1000)
        assert "valid only from" in refusal(cell, young)
        assert "correct the clock" in refusal(cell, young)

        other = cell.make("ben", folder=away, authority=stranger)
        assert "unable to get local issuer certificate; another authority" in refusal(cell, other)
        other.authority.write_bytes(cell.files("ada").authority.read_bytes())
        assert "ben.crt cannot be used with" in refusal(cell, other)  # seen before a shard does
        assert refusal(cell, cell.files("ada")) == ""


def test_refused_certificate_of_a_shard_is_explained(tmp_path, stranger):
    """Wrong host, wrong shard, nothing there."""
    cell = key_cells.KeyCell(
        tmp_path, {"left": key_cells.endpoint(), "right": key_cells.endpoint()}
    )
    cell.make("shard.left", hosts=["10.9.9.9"])
    with cell.running():
        reason = refusal(cell, cell.files("ada"))
        assert "IP address mismatch".lower() in reason
        assert "name 127.0.0.1 in `listen` or `advertise`" in reason
        with pytest.raises(ShardUnreachableError, match="ip address mismatch"):
            connect(cell.file, actor="ada", timeout_s=0.5)
    cell.make("shard.left")
    assert refusal(cell, cell.files("ada")) == ""  # nothing listens: no matter of keys
    assert not look(cell.shards["left"], cell.files("ada")).listens
    moved = cell.settings("right", listen=(cell.shards["left"],))
    shard = start_shard(moved)
    try:
        reason = refusal(cell, cell.files("ada"))
        assert reason.endswith("the certificate there is that of shard.right, not of shard.left")
    finally:
        shard.stop(drain_s=0.0)


def test_shard_that_answers_with_the_key_of_another_is_not_believed(tmp_path, monkeypatch):
    """Every key of the cell may connect; an answer counts from the shard that was asked."""
    cell = key_cells.KeyCell(
        tmp_path, {"left": key_cells.endpoint(), "right": key_cells.endpoint()}
    )
    impostor = cell.settings("left", keys=cell.files("shard.right"))
    shard = start_shard(impostor)
    try:
        with pytest.raises(ShardUnreachableError, match=r"of shard\.right, not of shard\.left"):
            connect(cell.file, actor="ada", timeout_s=1.0)
    finally:
        shard.stop(drain_s=0.0)


def test_link_ends_with_its_certificate_and_comes_back_with_a_new_one(tmp_path):
    """At the second; new files in the same place are enough for a client."""
    cell = key_cells.KeyCell(tmp_path, ttl_s=1.0)
    cell.make("ben", seconds=3)
    with cell.running(), connect(cell.file, actor="ben", request_timeout_s=1.0) as here:
        count = Write(here.world("online"), Entity("bench"), COUNT)
        with Lock(count) as lock:
            lock[count] = 1

        def refusal():
            try:
                with Lock(count, wait_s=1.0):
                    return ""
            except ShardUnreachableError as error:
                return str(error)

        until(lambda: "alert certificate expired; it ended on" in refusal(), pause_s=0.1)
        cell.make("ben")
        until(lambda: not refusal())
        with Lock(count) as lock:
            lock[count] += 1


def test_shard_refuses_to_start_with_keys_that_do_not_fit(cell, stranger):
    """With the file and the reason, before anything is opened."""
    files = cell.files("shard.left")
    for kwargs, said in (
        ({"seconds": 100, "starts_s": -1000}, "ended on"),
        ({"seconds": 5000, "starts_s": 1000}, "valid only from"),
        ({"authority": stranger}, "unable to get local issuer certificate"),
    ):
        cell.make("shard.left", **kwargs)
        with pytest.raises(ConfigError, match=said):
            start_shard(cell.settings())
    cell.make("shard.left")
    files.private_key.write_bytes(cell.files("ada").private_key.read_bytes())
    with pytest.raises(ConfigError, match="do not belong together"):
        start_shard(cell.settings())
    for name in ("certificate", "private_key"):
        getattr(files, name).write_bytes(getattr(cell.files("ada"), name).read_bytes())
    with pytest.raises(ConfigError, match=r"unsuitable certificate purpose|proves the name 'ada'"):
        start_shard(cell.settings())
    files.certificate.write_text("nothing")
    with pytest.raises(ConfigError, match="is no file of the kind"):
        start_shard(cell.settings())
    files.certificate.unlink()
    with pytest.raises(ConfigError, match=r"cannot read .*shard\.left\.crt: No such file"):
        start_shard(cell.settings())


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o610])
def test_private_key_that_others_can_read_is_refused(cell, mode):
    """By a client and by a shard, with what to do."""
    for name in ("ada", "shard.left"):
        cell.files(name).private_key.chmod(mode)
    with pytest.raises(ConfigError, match=rf"mode 0{mode:o}\); run chmod 600"):
        start_shard(cell.settings())
    with pytest.raises(ConfigError, match=r"ada\.key"):
        connect(cell.file, actor="ada")


def test_program_takes_the_key_that_suits_it(cell, monkeypatch, away):
    """Its own, that of the environment, an operator's, the only one, a shard's."""
    security = cell.config.security
    assert client_keys(security, "ben").name == "ben"
    assert client_keys(security, "enact").name == "ada"
    monkeypatch.setenv("ENACT_IDENTITY", "ben")
    assert client_keys(security, "enact").name == "ben"
    monkeypatch.delenv("ENACT_IDENTITY")
    with pytest.raises(ConfigError, match=r"several certificates \(ada, ben\).*ENACT_IDENTITY"):
        client_keys(SecurityConfig(cell.keys), "enact")
    for name in ("ada", "ben"):
        cell.files(name).certificate.unlink()
    assert client_keys(security, "enact").name == "shard.left"
    with pytest.raises(ConfigError, match="no certificate for 'enact'"):
        client_keys(SecurityConfig(away), "enact")
    assert client_keys(SecurityConfig(), "enact") is None


def test_silent_server_delays_a_look_by_half_a_second(cell):
    """One that takes connections and answers none: no reason is found."""
    port = int(cell.shards["left"].rpartition(":")[2])
    with socket.create_server(("127.0.0.1", port)):
        assert refusal(cell, cell.files("ada")) == ""


def test_other_protocol_at_the_port_is_explained(cell):
    """A shard without keys, or any other server."""
    port = int(cell.shards["left"].rpartition(":")[2])
    with socket.create_server(("127.0.0.1", port)) as server:

        def answer():
            with server.accept()[0] as line:
                line.recv(100)
                line.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        threading.Thread(target=answer, daemon=True).start()
        assert "is it a TLS endpoint?" in refusal(cell, cell.files("ada"))


def test_two_authorities_are_known_during_a_change(tmp_path, stranger):
    """Both certificates in one `ca.pem` accept keys of either."""
    cell = key_cells.KeyCell(tmp_path)
    for name in ("shard.left", "ben"):
        cell.make(name, authority=stranger if name == "ben" else None)
    both = cell.files("ada").authority
    both.write_bytes(both.read_bytes() + (tmp_path / "stranger" / "ca.pem").read_bytes())
    with cell.running(), connect(cell.file, actor="ben"), connect(cell.file, actor="ada"):
        assert own_certificate(cell.files("ben")).name == "ben"
