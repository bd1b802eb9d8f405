"""The types of what the public API returns: for annotations and `isinstance`, never to be made."""

from enact_dist.access.reads import EachData
from enact_dist.access.snapshot import SlotInfo, Snapshot
from enact_dist.access.watch import Change, Watch
from enact_dist.actor.report import ActorStatistics
from enact_dist.compare.diff import Diff, DiffKind
from enact_dist.compare.watch_diff import DiffWatch
from enact_dist.terms import NullReason
from enact_dist.world.context import Version
from enact_dist.world.lineage import CauseTree, EffectTree
from enact_dist.world.listings import (
    ActorInfo,
    AspectInfo,
    AuditInfo,
    LockInfo,
    RefusalInfo,
    ShardInfo,
)
from enact_dist.world.past import PastContext

__all__ = [
    "ActorInfo",
    "ActorStatistics",
    "AspectInfo",
    "AuditInfo",
    "CauseTree",
    "Change",
    "Diff",
    "DiffKind",
    "DiffWatch",
    "EachData",
    "EffectTree",
    "LockInfo",
    "NullReason",
    "PastContext",
    "RefusalInfo",
    "ShardInfo",
    "SlotInfo",
    "Snapshot",
    "Version",
    "Watch",
]
