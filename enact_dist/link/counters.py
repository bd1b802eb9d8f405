"""What the counters of a shard and of a connection mean, and what to do where one grows.

A shard counts from its start (`enact shard ls --counters`, `--json`, `/metrics`), a connection from
its own (`Cell.statistics`).  An empty remedy: that is work done, or harmless by itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.wire.limits import INLINE_BYTES_MAX

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

BODIES: Final = f"arrays, texts and bytes over {INLINE_BYTES_MAX} B, long lists; all else counts 0"
"""What of a datum counts where bytes of data are told: its body (see `enact_dist.wire`)."""


class Counter(NamedTuple):
    """One counter.

    Attributes:
        meaning: What it counts.
        remedy: What to do where it grows; empty where that is as it should be.
        now: Whether it is a figure of this moment, which falls again, and no count.
    """

    meaning: str
    remedy: str = ""
    now: bool = False


_BUSY: Final = "look for a busy host: top, and the shard's log"
_DYING: Final = "see why actors die or freeze: enact actor ls, and their log"
_NETWORK: Final = "look at the network between these hosts: enact doctor"
_SLOW_READER: Final = "find the client that is stopped or too slow: enact actor ls"

OF_A_SHARD: Final[dict[str, Counter]] = {
    # Work
    "commits": Counter("commits that were applied here"),
    "bytes_written": Counter(f"bytes of data in them: {BODIES}"),
    "bytes_fetched": Counter("bytes that were fetched in slices"),
    "locks_granted": Counter("locks that were granted"),
    "locks_validated": Counter("locks without a write here that were confirmed at their end"),
    "lock_waits": Counter("locks that had to wait", "where too many: shorter locks, or View"),
    "locks_bypassed": Counter("grants to one who came later than somebody who still waits"),
    "prepared": Counter("commits over several shards that were prepared here"),
    "decisions": Counter("commits over several shards that were decided here"),
    "commits_finished": Counter("prepared commits that were applied"),
    "views_waited": Counter("views that waited for a commit over several shards to be decided"),
    "views_forgotten": Counter(
        "views of a past that has left its retention",
        "retain more: Aspect(…, retention=…) or cell.toml",
    ),
    "worlds_forked": Counter("world contexts that were forked"),
    "worlds_dropped": Counter("world contexts that were dropped"),
    "forks_waited": Counter("forks that waited for a commit over several shards to be decided"),
    # Things that happen where messages are lost
    "commits_repeated": Counter("commits that came again and got their first answer", _NETWORK),
    "prepares_repeated": Counter("prepares that came again and got their first answer", _NETWORK),
    "finishes_repeated": Counter("decisions that were told again", _NETWORK),
    "stale": Counter("lock requests that came too late to count", _NETWORK),
    "superseded": Counter("locks ended by the next one of their thread: a lost release", _NETWORK),
    "orphans_freed": Counter("locks that their client did not know of: a lost grant", _NETWORK),
    "grants_without_listener": Counter("locks granted between two questions of their client"),
    # Commits and locks that came to nothing
    "commits_changed": Counter(
        "locks refused because an expected view had changed", "where many: Read instead of View"
    ),
    "fenced": Counter("commits refused because their lock was lost", _DYING),
    "epoch_refusals": Counter("requests of clients from before this start, or of ended sessions"),
    "newer_types_missed": Counter(
        "locks asked with an aspect's older type: the client was to compare types first",
        "bring programs up to date that only read now: enact actor ls, and their log",
    ),
    "types_succeeded": Counter("aspects whose type a newer one has succeeded, with more fields"),
    "wrong_shard": Counter(
        "requests made with another shard list", "start all shards with the same cell.toml"
    ),
    "fetches_gone": Counter("slices asked for after their datum had gone: a lost lock", _DYING),
    "leases_expired": Counter("locks lost because their client was silent for a TTL", _DYING),
    "held_too_long": Counter("locks that went over hold_s", "raise hold_s, or do less in the lock"),
    "sessions_died": Counter("clients that went without a goodbye", _DYING),
    "waiters_dropped": Counter("waiting locks of clients that went or were silent", _DYING),
    "locks_broken": Counter("locks that somebody ended by enact lock break"),
    # Commits in doubt
    "prepared_restored": Counter("commits in doubt that were found at the start"),
    "resolves_asked": Counter(
        "questions to other shards how a commit ended", "enact lock ls; start the shard it names"
    ),
    "resolved_committed": Counter("commits in doubt that turned out as committed"),
    "resolved_aborted": Counter("commits in doubt that turned out as aborted"),
    "decisions_refused": Counter(
        "decisions of other shards with a stamp that is far ahead of the clock here",
        "set the clocks of both hosts: enact doctor",
    ),
    "prepared_forced": Counter("commits in doubt aborted by hand (enact lock resolve)"),
    "forced_confirmed": Counter("such that had not been committed elsewhere: all is well"),
    "forced_but_committed": Counter(
        "such that had been committed elsewhere: they stand in part", "enact lock audit"
    ),
    "alarms": Counter("of these, those that nobody has settled yet", "enact lock audit", now=True),
    # This process and its host
    "namesakes_found": Counter(
        "times that two daemons were found under the name of one shard of the cell",
        "see the shard's log for where they are; stop all but the one whose data you want to keep",
    ),
    "namesakes": Counter(
        "shards of the cell that several daemons serve now", "enact doctor", now=True
    ),
    "audit_left_out": Counter(
        "acts of operators that are too old for enact lock audit, which lists the newest 1,000",
        now=True,
    ),
    "catalogue_left_out": Counter(
        "world contexts and aspects that the catalogue has no room to show",
        "stop the cell and run enact shard forget --unused",
        now=True,
    ),
    "draining": Counter("1 while this shard ends and grants nothing new", now=True),
    "stalls": Counter("times this host stood still; no lease paid for it", _BUSY),
    "disk_stalls": Counter(
        "times a write took more than a second",
        "move the shard's folder to another disk; see its log for when",
    ),
    "overloads": Counter("requests refused because too many wait", "find who asks: enact lock ls"),
    "quota_refused": Counter(
        "requests refused because their process has its whole share of the shard",
        "see the shard's log for whose; a program that connects in a loop does that",
    ),
    "sessions_displaced": Counter(
        "sessions that did nothing after their hello and made room where the table was full",
        "see the shard's log: somebody opens sessions in a loop, under ever new names",
    ),
    "views_displaced": Counter(
        "views whose large data a shard keeps no longer, since their client had too many of them",
        "find the client that takes views in ever new lanes; it is none of this library's",
    ),
    "requests_refused": Counter(
        "requests in the name of another's session or of another shard, or that name no epoch",
        "see the error at who sent them; the same session or process may be copied",
    ),
    "frames_refused": Counter(
        "messages that could not be read", "run the same release everywhere; see the shard's log"
    ),
    "requests_dropped": Counter(
        "requests that had no room beside all that wait: their clients ask again",
        "see the shard's log for whose; a program that asks without an end does that",
    ),
    "connections_refused": Counter(
        "sockets refused: too many, another user, or no greeting", "see the shard's log"
    ),
    "metrics_readers_refused": Counter(
        "readers of /metrics that were not taken: too many, or no descriptor or thread was free",
        "see the shard's log; raise LimitNOFILE",
    ),
    "answers_dropped": Counter("answers to clients that did not read them", _SLOW_READER),
    "answers_refused": Counter(
        "answers longer than a frame, in place of which the request was refused",
        "ask for less at once: a narrower pattern",
    ),
    "notices_dropped": Counter(
        "notices to watchers that did not read them; a watch tells its gap", _SLOW_READER
    ),
    "fetches_damaged": Counter(
        "data asked for whose bytes on the disk are not those that were written",
        "check the disk; see the shard's log for which",
    ),
    # History
    "retained_bytes": Counter("bytes of older versions that are kept now", now=True),
    "retained_dropped": Counter(
        "older versions let go early: the limit of 256 MiB", "retain fewer versions of large data"
    ),
    "history_dropped": Counter(
        "older versions let go early for the room of a new datum",
        "raise shared_bytes_max, or retain fewer versions of large data",
    ),
    # Large data
    "payload_files": Counter("payloads that lie here now", now=True),
    "payload_bytes": Counter("bytes of these and of drafts now", now=True),
    "payload_bytes_max": Counter(
        "the cap of the shared folder in bytes; 0 where there is none", now=True
    ),
    "payload_drafts": Counter("payloads now that no commit has named yet", now=True),
    "payloads_adopted": Counter("payloads that a commit has named"),
    "payloads_missing": Counter("payloads named by a commit and not here; they came again"),
    "payloads_refused": Counter(
        "payloads refused because of the cap",
        "raise shared_bytes_max, or let go of arrays that hold old versions",
    ),
    "slices_dropped": Counter(
        "slices dropped since too many wait for their place; they came again", _BUSY
    ),
    "payload_fallbacks": Counter(
        "payloads that are no file of the shared folder: it is full",
        "enlarge the folder: mount -o remount,size=…; docker run --shm-size=…",
    ),
    "drafts_displaced": Counter(
        "large data on their way that were given up for a client with less than its share",
        "see who stages much and commits nothing: enact actor ls; or raise shared_bytes_max",
    ),
    "drafts_swept": Counter("drafts whose client went or gave them up", _DYING),
}

OF_A_CONNECTION: Final[dict[str, Counter]] = {
    "connects_failed": Counter("tries to connect to further shards that failed", "see the log"),
    "shards_doubted": Counter(
        "shards that more than one daemon serves; none of them is trusted",
        "stop all daemons of that name but one: enact doctor",
    ),
    "keep_alives_failed": Counter("answers to keep-alives that made no sense", "see the log"),
    "keep_alives_unanswered": Counter("keep-alives without an answer in time", _NETWORK),
    "releases_unsent": Counter("locks whose release could not be sent; the next one ends them"),
    "views_locked": Counter("views that took a lock, since their shards did not agree"),
    "slices_repeated": Counter("slices of large data that were asked or sent again", _NETWORK),
    "maps_failed": Counter("payloads that could not be mapped and were fetched", "see the log"),
    "payload_fallbacks": Counter("data that travelled though the folder is shared", "see the log"),
    "payload_folders_elsewhere": Counter(
        "shards whose shared folder this process does not see",
        "for containers: mount one tmpfs in all of them, see Large data in the README",
    ),
}


def told(counters: Mapping[str, int]) -> Iterator[tuple[str, int, str, str]]:
    """Yield name, value, meaning and remedy of all that are not 0, as they stand in the table."""
    order = {name: number for number, name in enumerate(OF_A_SHARD)}
    for name in sorted(counters, key=lambda name: (order.get(name, len(order)), name)):
        if counters[name]:
            known = OF_A_SHARD.get(name, Counter("of a newer release"))
            yield name, counters[name], known.meaning, known.remedy
