"""What the figures of a shard and of a connection mean, and what to do if one grows.

A shard counts from its start (`enact shard ls --counters`, `--json`, `/metrics`), a connection from
its own (`Cell.statistics`; `enact shard ls --counters` for its own one).  Help texts, metrics and
their documentation are made of these tables.
A figure without a remedy counts work done, or is harmless.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

from enact_dist.wire.limits import LEAF_BYTES_MAX

BODIES: Final = (
    f"arrays, long lists, texts and bytes over {LEAF_BYTES_MAX} B; other data count as 0"
)
"""The part of a datum that counters of bytes count: its body (see `docs/protocol.md`)."""


class Figure(NamedTuple):
    """One figure.

    Attributes:
        meaning: What it counts or measures.
        remedy: What to do if it grows; empty if growth is normal.
        kind: As in Prometheus: "counter", "gauge" (a current value, which may fall again) or
            "histogram" (latencies).
    """

    meaning: str
    remedy: str = ""
    kind: str = "counter"


def _gauge(meaning: str, remedy: str = "") -> Figure:
    return Figure(meaning, remedy, "gauge")


_BUSY: Final = "look for a busy host: top, and the shard's log"
_DYING: Final = "find out why actors die or freeze: enact actor ls, and their logs"
_NETWORK: Final = "check the network between these hosts: enact doctor"
_SLOW_READER: Final = "find the client that has stopped or is too slow: enact actor ls"

OF_A_SHARD: Final[dict[str, Figure]] = {
    # Work
    "commits": Figure("commits applied here"),
    "bytes_written": Figure(f"bytes of data in these commits: {BODIES}"),
    "bytes_fetched": Figure("bytes that clients fetched in slices"),
    "locks_granted": Figure("locks granted; those that used a kept grant are not counted"),
    "locks_validated": Figure("locks without a write here, confirmed when they ended"),
    "grants_kept": Figure("grants that stayed with their session, for its next locks of the data"),
    "grants_not_kept": Figure(
        "grants that could not stay: no page of marks and no question for recalls, or no room"
    ),
    "grants_revoked": Figure(
        "kept grants that ended unused, because another lock asked for the data"
    ),
    "grants_recalled": Figure(
        "kept grants in use, or of another host, when another lock asked; each ended with its"
        " block, or was given back"
    ),
    "standing_locks_begun": Figure("locks that waited for news, and entered the queue at a change"),
    "lock_waits": Figure(
        "locks that had to wait", "if too many: hold locks for less time, or use View"
    ),
    "locks_bypassed": Figure("locks granted before an earlier request that still waits"),
    "prepared": Figure("commits over several shards that this shard prepared"),
    "decisions": Figure("commits over several shards that this shard decided"),
    "commits_finished": Figure("prepared commits that this shard applied"),
    "views_waited": Figure("views that waited for the decision on a commit over several shards"),
    "views_forgotten": Figure(
        "views of a time that is beyond retention",
        "retain more: Aspect(…, retention=…) or cell.toml",
    ),
    "worlds_forked": Figure("world contexts forked"),
    "worlds_dropped": Figure("world contexts dropped"),
    "forks_waited": Figure("forks that waited for the decision on a commit over several shards"),
    # Events that follow from lost messages
    "commits_repeated": Figure("repeated commits, answered as the first time", _NETWORK),
    "prepares_repeated": Figure("repeated prepares, answered as the first time", _NETWORK),
    "finishes_repeated": Figure("decisions that another shard sent again", _NETWORK),
    "stale": Figure("lock requests ignored because they arrived too late", _NETWORK),
    "superseded": Figure("locks ended by the next lock of their thread: a lost release", _NETWORK),
    "orphans_freed": Figure("locks whose client did not know of them: a lost grant", _NETWORK),
    "grants_without_listener": Figure("locks granted between two requests of their client"),
    # Commits and locks that failed
    "commits_changed": Figure(
        "locks refused because an expected view had changed", "if many: use Read instead of View"
    ),
    "fenced": Figure("commits refused because their lock was lost", _DYING),
    "epoch_refusals": Figure(
        "requests from sessions that ended, or that began before the last start"
    ),
    "newer_types_missed": Figure(
        "locks refused until their client compares its type with the newer one",
        "update programs that write an older type: enact actor ls, and their logs",
    ),
    "reports_too_long": Figure("keep-alives whose actor's report was too long to be kept"),
    "types_succeeded": Figure("times that an aspect got a newer type, with more fields"),
    "wrong_shard": Figure(
        "requests from clients with a different list of shards",
        "start all shards with the same cell.toml",
    ),
    "fetches_gone": Figure("slices requested after their datum was removed: a lost lock", _DYING),
    "leases_expired": Figure("locks lost because their client was silent for a TTL", _DYING),
    "held_too_long": Figure(
        "locks held longer than hold_s", "raise hold_s, or do less under the lock"
    ),
    "sessions_died": Figure("clients whose process died without closing its session", _DYING),
    "sessions_barred": Figure("sessions ended because a reload no longer allows their name"),
    "waiters_dropped": Figure(
        "waiting locks dropped because their client was gone or silent", _DYING
    ),
    "locks_broken": Figure("locks ended with enact lock break"),
    # Commits in doubt
    "prepared_restored": Figure("commits in doubt found at the start"),
    "resolves_asked": Figure(
        "requests to other shards for the outcome of a commit",
        "enact lock ls; start the shard that it names",
    ),
    "resolved_committed": Figure("commits in doubt that the deciding shard had committed"),
    "resolved_aborted": Figure("commits in doubt that the deciding shard had aborted"),
    "decisions_refused": Figure(
        "decisions from other shards with a timestamp far ahead of the local clock",
        "set the clocks of both hosts: enact doctor",
    ),
    "prepared_forced": Figure("commits in doubt that an operator aborted (enact lock resolve)"),
    "forced_confirmed": Figure("of these, commits that no other shard had committed: no harm done"),
    "forced_but_committed": Figure(
        "of these, commits that another shard had committed: only a part took effect",
        "enact lock audit",
    ),
    "alarms": _gauge(
        "of these, conflicts that no operator has acknowledged yet", "enact lock audit"
    ),
    # This process and its host
    "namesakes_found": Figure(
        "times that the shard found two daemons with the same shard name",
        "the shard's log names their hosts; stop all but the one whose data you want to keep",
    ),
    "namesakes": _gauge("shards of the cell that more than one daemon serves now", "enact doctor"),
    "audit_left_out": _gauge(
        "operator actions too old for enact lock audit, which lists the newest 1,000"
    ),
    "catalogue_left_out": _gauge(
        "world contexts and aspects that do not fit into the catalogue sent to clients",
        "stop the cell and run enact shard forget --unused",
    ),
    "draining": _gauge("1 while the shard shuts down and grants no new locks"),
    "stalls": Figure("times that this host stood still; leases were extended by that time", _BUSY),
    "disk_stalls": Figure(
        "disk writes that took more than a second",
        "move the shard's folder to another disk; the shard's log gives the times",
    ),
    "store_copies": _gauge(
        "standbys of the cell's database that confirm each commit; 0 in a cell with folders; -1 if"
        " the cell's user cannot see them (GRANT pg_monitor)",
        "if 0 in a cell with a store, a commit stands on one host only: enact doctor",
    ),
    "lease_left_s": _gauge(
        "seconds that the shard may still answer without news of its database; 0 in a cell with"
        " folders"
    ),
    "store_stalled_s": _gauge(
        "seconds that answers or commits have waited now for the database",
        "look at the database and the way to it: enact doctor",
    ),
    "takeovers": Figure(
        "1 if this start took the shard over from a daemon that had not given it back",
        "the log of that daemon, or of its host, gives the reason",
    ),
    "slow_looks": Figure(
        "looks of a standby at its shard's row that took more than half of `lease_s`; what"
        " goes beyond does not count for the lease, so a takeover comes later",
        "look at the database and the way to it: enact doctor; or at the standby's host: top",
    ),
    "silences": Figure(
        "times that answers waited, since the database had confirmed nothing for `lease_s`",
        "look at the database and the way to it: enact doctor",
    ),
    "data_too_large": Figure(
        "commits refused because a datum was larger than a database keeps",
        "make the aspect volatile, or keep its shard in a folder",
    ),
    "overloads": Figure(
        "requests refused because too many wait", "find their clients: enact lock ls"
    ),
    "quota_refused": Figure(
        "requests refused because their process used up its share of the shard",
        "the shard's log names the process; a typical cause is a program that connects in a loop",
    ),
    "permission_denied": Figure(
        "requests refused because the rights of the cell do not allow them",
        "the shard's log names sender and right; see [rights] in cell.toml",
    ),
    "reloads": Figure("times that the shard took keys, names and rights anew"),
    "reloads_refused": Figure(
        "times that it could not, and kept the old ones", "the shard's log names the reason"
    ),
    "sessions_displaced": Figure(
        "idle sessions ended to make room in a full table",
        "see the shard's log: some program opens new sessions in a loop",
    ),
    "views_displaced": Figure(
        "views whose large data the shard no longer keeps: their client had too many",
        "find the client that opens views in ever new lanes; this library never does",
    ),
    "requests_refused": Figure(
        "requests that named another client's session, another shard, or no epoch",
        "see the error that the sender got; a copied process or session is a likely cause",
    ),
    "frames_refused": Figure(
        "messages that the shard could not read", "run the same release everywhere; see its log"
    ),
    "requests_dropped": Figure(
        "requests dropped because the queue was full; their clients repeat them",
        "the shard's log names the client; a typical cause is a program that never stops asking",
    ),
    "connections_refused": Figure(
        "sockets refused: too many, another user, or no greeting", "see the shard's log"
    ),
    "metrics_readers_refused": Figure(
        "readers of /metrics refused: too many, or no free descriptor or thread",
        "see the shard's log; raise LimitNOFILE",
    ),
    "answers_dropped": Figure(
        "answers dropped because their client did not read them", _SLOW_READER
    ),
    "answers_refused": Figure(
        "requests refused because the answer would be longer than a frame",
        "request less at once, for example with a narrower pattern",
    ),
    "notices_dropped": Figure(
        "notices dropped because a watcher did not read them; its watch reports a gap", _SLOW_READER
    ),
    "fetches_damaged": Figure(
        "requested data whose bytes on the disk differ from what was written",
        "check the disk; the shard's log names the data",
    ),
    # History
    "retained_bytes": _gauge("bytes of older versions kept now"),
    "retained_dropped": Figure(
        "older versions removed early: the limit of 256 MiB", "retain fewer versions of large data"
    ),
    "history_dropped": Figure(
        "older versions removed early to make room for a new datum",
        "raise shared_bytes_max, or retain fewer versions of large data",
    ),
    # Large data
    "payload_files": _gauge("payloads stored here now"),
    "payload_bytes": _gauge("bytes of payloads and drafts now"),
    "payload_bytes_max": _gauge("limit of the shared folder in bytes; 0 if it has none"),
    "payload_drafts": _gauge("payloads here now that no commit has named yet"),
    "payloads_adopted": Figure("payloads that a commit has named"),
    "payloads_missing": Figure(
        "payloads that a commit named before they arrived; the client sent them again"
    ),
    "payloads_refused": Figure(
        "payloads refused because the shared folder was at its limit",
        "raise shared_bytes_max, or release arrays that still reference old versions",
    ),
    "slices_dropped": Figure(
        "slices dropped because too many were waiting; the client sent them again", _BUSY
    ),
    "payload_fallbacks": Figure(
        "payloads stored outside the shared folder because it is full",
        "enlarge the folder: mount -o remount,size=…; docker run --shm-size=…",
    ),
    "drafts_displaced": Figure(
        "unfinished large data dropped to make room for a client below its share",
        "find the client that stages much and commits nothing: enact actor ls; or raise the limit",
    ),
    "files_ahead": _gauge("files made ahead of large data and not used yet"),
    "files_ahead_bytes": _gauge("bytes of these; part of payload_bytes"),
    "files_ahead_used": Figure(
        "files made ahead that a commit has named: each spared its client a call"
    ),
    "files_ahead_removed": Figure(
        "files made ahead of large data and removed unused: their client paused or ended, or room"
        " was short"
    ),
    "drafts_swept": Figure("drafts removed because their client was gone or gave them up", _DYING),
}

OF_A_CONNECTION: Final[dict[str, Figure]] = {
    "connects_failed": Figure("failed attempts to connect to further shards", "see the log"),
    "shards_doubted": Figure(
        "shards that more than one daemon serves; the client uses none of these daemons",
        "stop all daemons of that name but one: enact doctor",
    ),
    "keep_alives_failed": Figure("invalid answers to keep-alives", "see the log"),
    "keep_alives_unanswered": Figure("keep-alives that got no answer in time", _NETWORK),
    "grants_used_again": Figure("locks that needed no grant: they used one that was kept"),
    "pages_of_grants_failed": Figure(
        "shards whose page of marks cannot be used here, so that no grant of theirs is kept",
        "see the log; kept grants need file locks in the shared folder"
        " (enact_dist/docs/kept_grants.md)",
    ),
    "releases_unsent": Figure(
        "releases that could not be sent; the thread's next lock replaces them"
    ),
    "views_locked": Figure("views that took read locks because their shards did not agree"),
    "slices_repeated": Figure("slices of large data requested or sent again", _NETWORK),
    "maps_failed": Figure("payloads fetched because they could not be mapped", "see the log"),
    "payload_fallbacks": Figure(
        "data sent through the connection although the folder is shared", "see the log"
    ),
    "payload_folders_elsewhere": Figure(
        "shards whose shared folder this process cannot see",
        "for containers: mount one tmpfs in all of them, see enact_dist/docs/large_data.md",
    ),
}


GAUGES_OF_A_SHARD: Final[dict[str, Figure]] = {
    "standby": _gauge(
        "1 while the daemon stands by for another one that serves the shard; beside it, only what"
        " it counts meanwhile is shown"
    ),
    "ready": _gauge(
        "1 while the shard grants locks, 0 right after its start and while it shuts down"
    ),
    "epoch": _gauge(
        "number of this start; it changes with each restart", "the shard's log gives the reason"
    ),
    "uptime_seconds": _gauge("time since this start"),
    "sessions": _gauge("clients that are connected, or were until a moment ago"),
    "slots": _gauge("slots on this shard, including null ones"),
    "slot_bytes": _gauge(
        f"bytes of the newest data of all slots: {BODIES}", "enact world tree shows each"
    ),
    "locks_held": _gauge("locks held now, kept grants left out"),
    "locks_kept": _gauge("grants that stay with their sessions between two locks, used or not"),
    "locks_waiting": _gauge("locks waiting now", "enact lock ls shows who holds them up"),
    "requests_parked": _gauge("requests waiting for an answer"),
}

LATENCIES_OF_A_SHARD: Final[dict[str, Figure]] = {
    "lock_wait_seconds": Figure(
        "time from the first request of a lock to its grant here",
        "enact lock ls shows the holders; hold locks for less time, or use View",
        "histogram",
    ),
    "store_write_seconds": Figure(
        "time to store a batch of records, on the disk if an aspect is durable",
        "move the shard's folder to a faster disk",
        "histogram",
    ),
}


def described(
    counters: Mapping[str, int], figures: Mapping[str, Figure] = OF_A_SHARD
) -> Iterator[tuple[str, int, str, str]]:
    """Yield name, value, meaning and remedy of each counter above 0, in the order of the table."""
    order = {name: number for number, name in enumerate(figures)}
    for name in sorted(counters, key=lambda name: (order.get(name, len(order)), name)):
        if counters[name]:
            known = figures.get(name, Figure("unknown: from a newer release"))
            yield name, counters[name], known.meaning, known.remedy
