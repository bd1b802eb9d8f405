"""The switch between hosts under test: what is cut, late, lost or too much for a cable."""

import json
import os
import queue
import socket
import threading

import pytest

from enact_dist.errors import MisuseError
from enact_dist.verify.chaos.network.switch import QUEUE_S, Cable, Counts, Switch, _Way, address

MS = 1_000_000
EVERYBODY = "ff:ff:ff:ff:ff:ff"


def arrivals(cable, *, count, size=100, every_ns=0, seed="seed"):
    """Return when frames of one direction arrive (None: never), and the counts."""
    way, counts = _Way(seed), Counts()
    way.cable = cable
    return [way.due_ns(index * every_ns, size, counts) for index in range(count)], counts


def test_frame_takes_the_delay_and_stays_in_order_under_jitter():
    """Jitter makes some later, and none overtakes."""
    assert arrivals(Cable(0.02), count=1) == ([20 * MS], Counts())

    due, _ = arrivals(Cable(0.02, jitter_s=0.01), count=200, every_ns=MS // 10)

    assert due == sorted(due)
    assert all(20 * MS <= at - index * MS // 10 <= 50 * MS for index, at in enumerate(due))
    assert len({at - index * MS // 10 for index, at in enumerate(due)}) > 20


def test_loss_repeats_with_its_seed_and_is_as_often_as_said():
    """Of 10,000 frames about 5 % are lost: the same ones each time, others with another seed."""
    due, counts = arrivals(Cable(loss=0.05), count=10_000)

    assert counts.lost == due.count(None)
    assert 400 < counts.lost < 600
    assert arrivals(Cable(loss=0.05), count=10_000)[0] == due
    assert arrivals(Cable(loss=0.05), count=10_000, seed="other")[0] != due


def test_narrow_cable_carries_its_rate_and_drops_what_waits_too_long():
    """1,000 bytes per ms; a queue of `QUEUE_S`, then frames are dropped and counted."""
    due, counts = arrivals(Cable(bytes_per_s=1e6), count=1_000, size=1_000)
    carried = [at for at in due if at is not None]

    assert carried[:3] == [MS, 2 * MS, 3 * MS]
    assert QUEUE_S * 1e9 <= carried[-1] <= QUEUE_S * 1e9 + 2 * MS
    assert counts.crowded == 1_000 - len(carried) > 0


@pytest.mark.parametrize(("field", "value"), [("loss", 1.1), ("delay_s", -0.1)])
def test_cable_that_cannot_be_is_refused(field, value):
    """A loss above 1 and a negative delay are mistakes of the caller."""
    with pytest.raises(MisuseError, match="cannot be"):
        Cable(**{field: value})


@pytest.fixture
def net():
    """A running switch with three ports, whose other ends are the hosts."""
    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM) for _ in range(3)]
    for inside, outside in pairs:
        inside.setblocking(False)
        outside.settimeout(30.0)
    control, remote = os.pipe()
    said = queue.Queue()
    switch = Switch(1, [inside for inside, _ in pairs], control, say=said.put)
    thread = threading.Thread(target=switch.run)
    thread.start()

    def change(*words):
        os.write(remote, json.dumps(words).encode() + b"\n")
        return said.get(timeout=30.0)

    yield [outside for _, outside in pairs], change
    os.close(remote)
    thread.join(30.0)
    os.close(control)
    for pair in pairs:
        for end in pair:
            end.close()


def counted(change):
    return Counts(**json.loads(change("count").removeprefix("count")))


def frame(target, text):
    return bytes(10) + bytes.fromhex(target.replace(":", "")) + bytes(8) + text


def test_frames_go_where_they_are_addressed_and_group_frames_everywhere(net):
    """One port for one address, all others for a group, none for an address that nobody has."""
    hosts, change = net
    hosts[0].send(frame(address(7), b"nobody"))
    hosts[0].send(frame(address(2), b"two"))
    assert hosts[2].recv(99).endswith(b"two")

    hosts[0].send(frame(EVERYBODY, b"all"))

    assert hosts[1].recv(99).endswith(b"all")
    assert hosts[2].recv(99).endswith(b"all")
    assert counted(change) == Counts(forwarded=3)


def test_cut_holds_in_one_direction_until_it_is_healed(net, capsys):
    """What goes the other way arrives; each change is acknowledged once it holds."""
    hosts, change = net
    assert change("cut", 0, 1) == "done"
    hosts[0].send(frame(address(1), b"lost"))
    hosts[1].send(frame(address(0), b"back"))
    assert hosts[0].recv(99).endswith(b"back")
    assert change("heal", 0, 1) == "done"
    assert change("cable", 0, 1, 0.001, 0.0, 0.0, 0.0) == "done"
    hosts[0].send(frame(address(1), b"late"))

    assert hosts[1].recv(99).endswith(b"late")
    assert counted(change) == Counts(forwarded=2, cut=1)
