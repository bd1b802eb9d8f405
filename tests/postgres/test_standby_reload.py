"""A standby takes keys and rights anew as a serving daemon does, and serves with them later."""

import json
import os
import signal

import pytest
from polling import until

pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")

import key_cells
from ports import free_port
from replicated_cell import COUNT, ReplicatedCell

from enact_dist import Entity, Lock, Write, connect
from enact_dist.cli.main import main
from enact_dist.errors import PermissionDeniedError
from enact_dist.link.log import READY, STANDS_BY
from enact_dist.link.zenoh.tls import look, own_certificate

pytestmark = [pytest.mark.slow, pytest.mark.carrier("zenoh")]
ALLOWED = 'write = "online:bench/count"\n'


class GuardedCell(ReplicatedCell):
    """Two daemons of a shard with keys, and rights for `ben`."""

    def __init__(self, folder, url, name):
        super().__init__(folder, url, os.environ, name=name)
        self.places = tuple(f"tls/127.0.0.1:{free_port()}" for _ in range(2))
        both = ", ".join(f'"{place}"' for place in self.places)
        rights = (
            '[rights]\nprograms = ["writer"]\n'
            f'[[rights.allow]]\nwho = "writer"\nread = "online:**"\n{ALLOWED}'
        )
        self.keys = key_cells.KeyCell(
            folder, {"left": self.places[0]}, more=f"advertise = [{both}]\n{rights}"
        )
        text = self.file.read_text()
        store = f'name = "{name}"\nstore = "{url}"\nlease_s = 2.0\n'
        self.file.write_text(text.replace('name = "locked"\n', store))
        self.keys.make("writer")

    def shows_new(self, place):
        """Return whether a daemon shows the certificate that its file has now."""
        found = look(self.places[place], self.keys.files("ada")).certificate
        newest = own_certificate(self.keys.files("shard.left"))
        return found is not None and found.ends_s == newest.ends_s

    def await_log(self, place, text, *, count=1):
        read = self.log(place).read_text
        until(lambda: read().count(text) >= count, missed=read)

    def write(self):
        """Write as `writer`, who may or may not."""
        with connect(self.file, actor="writer", timeout_s=20.0) as cell:
            write = Write(cell.world("online"), Entity("bench"), COUNT)
            with Lock(write, wait_s=20.0) as lock:
                lock[write] = 1

    def allow(self, *, writes):
        text = self.file.read_text().replace(ALLOWED, "")
        self.file.write_text(text + ALLOWED if writes else text)


@pytest.fixture
def cell(server, tmp_path, shard_name):
    cell = GuardedCell(tmp_path, server.url, f"guarded{shard_name}")
    yield cell
    cell.end()


def test_a_standby_takes_keys_and_rights_and_serves_with_them(cell, capsys):
    """Asked by the command, with the daemon that serves; it shows them at once, and later."""
    active, standby = cell.start(0), cell.start(1, says=STANDS_BY)
    cell.write()
    cell.keys.make("shard.left", seconds=50_000)
    cell.allow(writes=False)

    assert main(["shard", "reload", "left", "--cell", str(cell.file), "--json"]) == 0

    said = [row["text"] for row in json.loads(capsys.readouterr().out)]
    assert "reloaded" in said
    assert any(f"{standby.pid}, which stands by, reloaded" in text for text in said)
    cell.await_log(1, "reloaded in")
    assert cell.shows_new(0)
    assert cell.shows_new(1)
    active.kill()
    standby.expect(READY)
    with pytest.raises(PermissionDeniedError, match="writer may not write"):
        cell.write()
    assert standby.status is None


def test_a_daemon_that_gave_its_shard_away_takes_keys_and_rights(cell):
    """By SIGHUP, in each of its parts; broken settings leave the old ones, with the reason."""
    daemons = [cell.start(0), cell.start(1, says=STANDS_BY)]
    move = ["shard", "move", "left", "--cell", str(cell.file), "--to"]
    host = os.uname().nodename
    assert main([*move, f"{host} {daemons[1].pid}"]) == 0
    daemons[0].expect(STANDS_BY)

    cell.keys.make("shard.left", seconds=60_000)
    cell.allow(writes=False)
    daemons[0].signal(signal.SIGHUP)
    cell.await_log(0, "reloaded in")
    assert cell.shows_new(0)
    good = cell.file.read_text()
    cell.file.write_text(good.replace("[rights]", "[rights]\nbroken = 1"))
    daemons[0].signal(signal.SIGHUP)
    cell.await_log(0, "not reloaded, so the old keys, names and rights stay")
    cell.file.write_text(good)

    assert main([*move, f"{host} {daemons[0].pid}"]) == 0
    daemons[0].expect(READY)
    with pytest.raises(PermissionDeniedError, match="writer may not write"):
        cell.write()
    cell.allow(writes=True)
    daemons[0].signal(signal.SIGHUP)
    cell.await_log(0, "reloaded in", count=2)
    cell.write()
    assert [daemon.status for daemon in daemons] == [None, None]
