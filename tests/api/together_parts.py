"""What tests of sets share: two cameras, and the cell that they publish to."""

from __future__ import annotations

import contextlib

from ports import free_endpoint

from enact_dist import (
    Aspect,
    Durability,
    Entity,
    Lock,
    Together,
    View,
    World,
    Write,
    connect,
    local,
)
from enact_dist.core.protocol.messages import Pin, PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings

PATIENCE_S = 30.0
KEPT = 4
LEFT, RIGHT, SYSTEM = Entity("camera/left"), Entity("camera/right"), Entity("system")
DEPTH = Aspect("depth", int, Durability.VOLATILE, retention=KEPT)
TOTAL = Aspect("total", int, Durability.VOLATILE)
role = World("online")


@contextlib.contextmanager
def cameras(kind, tmp_path, monkeypatch):
    """Open a cell of one kind: "local", "one shard" or "two shards", one for each camera."""
    if kind == "local":
        with local(worlds=["online"]) as opened:
            yield opened
        return
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))
    monkeypatch.setenv("ENACT_CARRIER", "socket")
    names = ("s0", "s1") if kind == "two shards" else ("s0",)
    endpoints = [free_endpoint() for _ in names]
    placement = PlacementMap(
        1,
        tuple(ShardEntry(name, (at,)) for name, at in zip(names, endpoints, strict=True)),
        (Pin(str(LEFT), "s0"), Pin(str(RIGHT), names[-1])),
    )
    shards = [
        start_shard(
            DaemonSettings(
                "cell", ShardSettings(name, placement, worlds=("online",)), (at,), carrier="socket"
            )
        )
        for name, at in zip(names, endpoints, strict=True)
    ]
    try:
        with connect(endpoints[0]) as opened:
            yield opened
    finally:
        for shard in shards:
            shard.stop(drain_s=0.0)


def capture(cell, entity, stamp_ns, value=None, aspect=DEPTH):
    """Commit a datum that was captured at a stamp; by default the stamp is its value, too."""
    request = Write(cell.world("online"), entity, aspect)
    with Lock(request) as lock:
        lock.put(request, stamp_ns if value is None else value, stamp_ns=stamp_ns)


def pair(world, **options):
    return Together([View(world, entity, DEPTH) for entity in (LEFT, RIGHT)], **options)
