"""Raw Zenoh between two processes, as a floor: `python -m …echoes.zenoh_echo PORT` serves.

A query is answered with as many bytes as its payload asks for; a publication is sent back.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Any, Final

import zenoh

from enact_dist.errors import LinkError

QUERY: Final = "floor/query"
THERE: Final = "floor/there"
BACK: Final = "floor/back"
SMALL_BYTES: Final = 64
START_S: Final = 20.0
ANSWER_S: Final = 30.0


def _config(port: int, *, listen: bool) -> Any:
    way = "listen" if listen else "connect"
    return zenoh.Config.from_json5(
        json.dumps(
            {
                "mode": "peer",
                way: {"endpoints": [f"tcp/127.0.0.1:{port}"]},
                "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
                # Between hosts there is none; it would answer 10 MB four times as fast.
                "transport": {"shared_memory": {"enabled": False}},
            }
        )
    )


class ZenohEcho:
    """The near end.  A context manager."""

    def __init__(self, port: int) -> None:
        self._session: Any = zenoh.open(_config(port, listen=False))
        self._querier: Any = self._session.declare_querier(
            QUERY, consolidation=zenoh.ConsolidationMode.NONE, timeout=ANSWER_S
        )
        self._publisher: Any = self._session.declare_publisher(THERE, express=True)
        self._back = self._session.declare_subscriber(BACK, zenoh.handlers.FifoChannel(16))
        try:
            self._wait_matching()
        except BaseException:
            self.close()
            raise

    def _wait_matching(self) -> None:
        # Zenoh would tell over a channel, which cannot be waited on for a limited time.
        deadline_s = time.monotonic() + START_S
        while not (
            self._querier.matching_status.matching and self._publisher.matching_status.matching
        ):
            if time.monotonic() > deadline_s:
                raise LinkError(f"the raw Zenoh process was not matched within {START_S:g} s")
            time.sleep(0.01)

    def query(self, size: int = SMALL_BYTES) -> int:
        """Fetch so many bytes with one query; return how many came.

        Raises:
            LinkError: No answer came.
        """
        for reply in self._querier.get(payload=size.to_bytes(SMALL_BYTES, "little")):
            if reply.ok is not None:
                # What a reader of numpy arrays cannot do without: one copy into Python's memory.
                return len(reply.ok.payload.to_bytes())
        raise LinkError(f"a raw Zenoh query was not answered within {ANSWER_S:g} s")

    def publish(self) -> None:
        """Publish a little and wait until it is back."""
        self._publisher.put(b"x" * SMALL_BYTES)
        self._back.recv()

    def close(self) -> None:
        """Close the session."""
        self._session.close()

    def __enter__(self) -> ZenohEcho:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _send_back(session: Any, there: Any) -> None:
    publisher = session.declare_publisher(BACK, express=True)
    for sample in there:
        publisher.put(sample.payload)


def serve(port: int) -> None:
    """Answer until the standard input ends."""
    with zenoh.open(_config(port, listen=True)) as session:
        fifo = zenoh.handlers.FifoChannel
        there = session.declare_subscriber(THERE, fifo(16))
        threading.Thread(target=_send_back, args=(session, there), daemon=True).start()
        queries = session.declare_queryable(QUERY, fifo(16), complete=True)
        threading.Thread(target=_answer, args=(queries,), daemon=True).start()
        print("ready:", flush=True)
        sys.stdin.read()


def _answer(queries: Any) -> None:
    bodies: dict[int, bytes] = {}
    for query in queries:
        with query:
            size = int.from_bytes(query.payload.to_bytes(), "little")
            if size not in bodies:
                bodies[size] = bytes(size)
            query.reply(QUERY, bodies[size])


if __name__ == "__main__":
    serve(int(sys.argv[1]))
