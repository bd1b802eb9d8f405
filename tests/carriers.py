"""Which way a test's processes talk to their shards: over the Unix socket, over Zenoh, or as it says.

Everything that holds has to hold over either carrier.  A run therefore draws one of the two for each
test of the folders below, half and half, and forces it by `ENACT_CARRIER` upon all processes that
the test starts: a call never takes the other way unnoticed.  `ENACT_TEST_CARRIER` says how:

    ENACT_TEST_CARRIER=4711     draw as a run did whose last line names this seed
    ENACT_TEST_CARRIER=zenoh    that carrier for every test; or socket

`deploy/test --carrier both` runs all of them over the one, then over the other.

The same seed draws whether actors ask for their locks in advance or watch (`ENACT_STANDING`), and
whether grants stay (`ENACT_RETAIN`).  A test about grants that stay has the mark `kept_grants`.

Marks say what else:

    @pytest.mark.carrier("socket", "zenoh")   over both in every run: what matters most
    @pytest.mark.carrier("local", "drawn")    also with the shard in the test's own process
    @pytest.mark.carrier("auto")              the usual way: the test is about the choice itself, or
                                              some of its processes share no memory with the shard

Tests that measure times take the usual way, as their limits do.
"""

from __future__ import annotations

import hashlib
import os
import secrets
from pathlib import Path

VARIABLE = "ENACT_TEST_CARRIER"
BOTH = ("socket", "zenoh")
DRAWN, LOCAL, USUAL = "drawn", "local", "auto"
FOLDERS = frozenset(("actors", "api", "cli", "e2e", "link", "recording"))
"""Where tests reach shards by whatever way there is; elsewhere the tests name one, or need none."""


def choice() -> str:
    """Return what `ENACT_TEST_CARRIER` says; a fresh seed, for all processes of the run, if nothing.

    Raises:
        ValueError: It says what cannot be.
    """
    said = os.environ.setdefault(VARIABLE, str(secrets.randbelow(10**6)))
    if said not in BOTH and not said.isdecimal():
        raise ValueError(f"{VARIABLE}={said!r} is neither socket, zenoh nor a seed")
    return said


def drawn(node_id: str, seed: str) -> str:
    """Return the carrier that a run with this seed draws for a test."""
    digest = hashlib.blake2b(f"{seed}:{node_id}".encode(), digest_size=1).digest()
    return BOTH[digest[0] & 1]


def rank(node_id: str) -> bytes:
    """Return where a test stands in the order in which this run takes samples."""
    return hashlib.blake2b(f"{choice()} of {node_id}".encode(), digest_size=8).digest()


def switches(node) -> dict[str, str]:
    """Return the switches of a test: in a quarter of the tests each of them is off."""
    _, standing, kept = hashlib.blake2b(
        f"{choice()}:{node.nodeid}".encode(), digest_size=3
    ).digest()
    stays = kept >= 0x40 or node.get_closest_marker("kept_grants")
    return {
        "ENACT_STANDING": "0" if standing < 0x40 else "1",
        "ENACT_RETAIN": "1" if stays else "0",
    }


def ways(node) -> tuple[str, ...]:
    """Return the carriers that a test runs over, one after the other, in this run."""
    mark = node.get_closest_marker("carrier")
    if mark is not None:
        wanted = [asked for asked in mark.args if asked != LOCAL or "cell" in node.fixturenames]
        if choice() in BOTH and set(BOTH) <= set(wanted):
            wanted = [asked for asked in wanted if asked not in BOTH or asked == choice()]
        return tuple(way for asked in wanted for way in _ways(asked, node))
    folder = node.path.relative_to(Path(__file__).parent).parts[0]
    usual = folder not in FOLDERS or node.get_closest_marker("timing")
    return _ways(USUAL if usual else DRAWN, node)


def _ways(asked: str, node) -> tuple[str, ...]:
    if asked != DRAWN:
        return (asked,)
    said = choice()
    return (said if said in BOTH else drawn(node.nodeid, said),)
