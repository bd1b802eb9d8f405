"""`enact lock ls|hold|break|resolve|audit`."""

from __future__ import annotations

import argparse
import os
import re
import sys
from datetime import datetime
from typing import TYPE_CHECKING, Final

from enact_dist.cli.arguments import (
    CELL,
    READER,
    TIMEOUT,
    in_words,
    seconds_of,
    slot_parts,
    whole,
)
from enact_dist.cli.target import open_cell
from enact_dist.cli.verbs import DONE, LOOKS, UNREACHABLE, Output, Verb, option
from enact_dist.errors import ConfigError, LeaseLostError, MisuseError, ShardUnreachableError
from enact_dist.link.signals import StopSignals
from enact_dist.terms import Access, Entities, Entity, checked_name
from enact_dist.wire.texts import shown
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from enact_dist.core.protocol.messages import Item
    from enact_dist.link.client.locks import CellClient
    from enact_dist.operate.cell_rows import ShardRates
    from enact_dist.world.cell import Cell
    from enact_dist.world.listings import LockInfo, ShardInfo

POLL_S: Final = 0.05
"""How soon a lost lock or an ended command is noticed."""

_HELD: Final = re.compile(r"(?:(?P<world>[^:/]+):)?(?P<slot>[^:]+):(?P<access>read|write)\Z")

_SHARD: Final = option("--shard", "NAME", "needed where two shards use the number")
_ACCESSES: Final = {
    ("read", False): Access.READ,
    ("write", False): Access.WRITE,
    ("read", True): Access.READ_EACH,
    ("write", True): Access.WRITE_EACH,
}


@in_words()
def held(text: str) -> tuple[str, str, str, str]:
    """Read ``[WORLD:]ENTITY/ASPECT:read|write``; an `argparse` type."""
    found = _HELD.match(text)
    if found is None:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not written [WORLD:]ENTITY/ASPECT:read or …:write"
        )
    entity, aspect = slot_parts(found["slot"])
    (Entities if "*" in entity else Entity)(entity)
    checked_name("aspect", aspect, slashes=False)
    return found["world"] or "", entity, aspect, found["access"]


LOCK_COLUMNS: Final = ("lock", "shard", "who", "state", "mode", "age", "lease left", "hold left",
                       "data", "waits for")  # fmt: skip
VERBS: Final = (
    Verb(
        "ls",
        "list who holds what and who waits for whom; `kept` is a grant that stays between two locks"
        " and ends when another process asks, `kept, used` one that a block uses, `recalled` one"
        " that another lock waits for",
        "list_locks",
        "enact lock ls",
        READER,
        cell=LOOKS,
        columns=LOCK_COLUMNS,
        empty="no lock is held or awaited",
        page="kept_grants",
    ),
    Verb(
        "hold",
        "run a command while holding a lock; the exit status is the command's, 1 if the lock is"
        " lost, 3 if its shard does not answer; either ends the command",
        "hold_lock",
        "enact lock hold online:robot/pose:write -- ./calibrate.sh\n"
        "enact lock hold --world online robot/pose:write 'tray/*/surface:read' -- sleep 5",
        (
            option("requests", "[WORLD:]ENTITY/ASPECT:MODE",
                   "what to hold; MODE is read or write; an entity with * means all that match",
                   nargs="+", type=held),
            option("--world", "WORLD", "world context of requests that name none"),
            seconds_of("--wait", "how long to wait for the grant (default: 10)", 10.0),
            seconds_of("--hold", "how long to hold the lock at most (default: 3600)", 3600.0),
            CELL,
            TIMEOUT,
        ),
        settings={"usage": "enact lock hold [options] [WORLD:]ENTITY/ASPECT:read|write …"
                           " -- COMMAND …"},
    ),
    Verb(
        "break", "take a lock away from its holder, who learns why; its commit will be refused",
        "break_lock",
        "enact lock break 1742 --shard left --reason 'camera unplugged'",
        (
            option("number", "NUMBER", "as `enact lock ls` shows it", type=whole),
            _SHARD,
            option("--reason", "TEXT", "reason that the holder sees", default="broken by hand"),
            *READER,
        ),
        cell=LOOKS,
    ),
    Verb(
        "resolve", "give up a lock in doubt whose deciding shard is lost for good (audited)",
        "resolve_lock",
        "enact lock resolve --force-abort 17 --shard right --reason 'disk of left is gone'",
        (
            option("--force-abort", "LOCK",
                   "its number in `enact lock ls`; if the lost shard had committed it, only a part"
                   " of that commit stands: restore that shard's folder first wherever you can",
                   required=True, type=whole),
            _SHARD,
            option("--reason", "TEXT", "reason for the audit record", required=True),
            *READER,
        ),
        cell=LOOKS,
        page="limits",
    ),
    Verb(
        "audit",
        "list locks that were ended by hand, and alarms: commits that stand only in part since",
        "list_audit",
        "enact lock audit\n"
        "enact lock audit --acknowledge 'bench/contacts written again from left' --shard right",
        (
            option("--acknowledge", "TEXT", "record what was done about all alarms so far"),
            option("--shard", "NAME", "whose alarms; needed with --acknowledge"),
            *READER,
        ),
        columns=("when", "shard", "what", "by", "details"),
        empty="no lock was ended by hand",
        page="limits",
    ),
)  # fmt: skip


# ---------------------------------------------------------------- ls


def list_locks(cell: Cell, _options: argparse.Namespace) -> Output:
    """List all locks of the cell, held or awaited; status 3 if a shard does not answer."""
    shards, status = in_reach(cell)
    locks = cell.locks(shards)
    return Output(locks, rows=lock_rows(locks), status=status)


def lock_rows(locks: Sequence[LockInfo]) -> list[tuple[str, ...]]:
    """Return the rows of a table of locks, each with who holds what it waits for."""
    known = {(lock.shard, lock.number): lock for lock in locks}
    return [tuple(map(str, _row(lock, known))) for lock in locks]


def in_reach(cell: Cell) -> tuple[tuple[str, ...], int]:
    """Return the shards that can be asked, and the exit status; name the others.

    A lock in doubt is looked for exactly when another shard is lost.
    """
    status, reachable = DONE, []
    for shard in cell.shards():
        if shard.reachable:
            reachable.append(shard.name)
        else:
            status = UNREACHABLE
            name_away(shard)
    return tuple(reachable), status


def name_away(shard: ShardInfo | ShardRates) -> None:
    """Print which shard does not answer, and why if that is known."""
    why = f": {shard.problem}" if shard.problem else " does not answer"
    print(f"enact: shard {shard.name} at {shard.endpoint}{why}", file=sys.stderr)


def _row(lock: LockInfo, known: dict[tuple[str, int], LockInfo]) -> tuple[object, ...]:
    others = ((number, known.get((lock.shard, number))) for number in lock.waits_for)
    blockers = [
        f"{number} ({who(one)})" if one is not None else str(number) for number, one in others
    ]
    return (
        lock.number,
        lock.shard,
        who(lock),
        lock.state,
        lock.modes,
        shown_s(lock.age_s),
        shown_s(lock.lease_left_s),
        shown_s(lock.hold_left_s) if lock.granted and lock.hold_left_s is not None else "-",
        ", ".join(lock.slots),
        ", ".join(blockers) or "-",
    )


def who(lock: LockInfo) -> str:
    """Return the holder as people look for it: actor, host, process."""
    return shown(f"{lock.actor}@{lock.host} pid {lock.pid}")


# ---------------------------------------------------------------- hold


def hold_lock(options: argparse.Namespace) -> int:
    """Hold a lock while a command runs."""
    if not options.command:
        raise ConfigError("lock hold needs a command: enact lock hold REQUEST … -- COMMAND …")
    name = f"hold:{os.path.basename(options.command[0])}"  # noqa: PTH119 (a word, not a file)
    with StopSignals() as stop, open_cell(options, observer=False, actor=name) as cell:
        return _hold(cell, options, stop)


def _hold(cell: Cell, options: argparse.Namespace, stop: StopSignals) -> int:
    from enact_dist.cli.held_command import HeldCommand

    items = [_item(cell, request, options.world) for request in options.requests]
    client = cell.world(items[0].context).session.client
    entries = client.aspect_entries()
    client.register(
        aspects=[entries[item.aspect]._replace(reads=True) for item in items],
        needed=lambda: _shards_of(client, items),
    )
    lock = client.acquire(items, wait_s=options.wait, hold_s=options.hold)
    name, by_itself = options.command[0], False
    try:
        with HeldCommand(options.command) as running:
            while not running.wait(POLL_S):
                running.pass_on(stop)
                if not client.valid(lock):
                    # It may be lost: the command must not go on while that is unknown.
                    running.pause()
                    client.check(lock)
                    running.resume()
            by_itself = True
        client.check(lock)
    except LeaseLostError as error:
        fate = "had ended by itself" if by_itself else "was ended, as it no longer holds the lock"
        raise LeaseLostError(f"{error}; {name} {fate}", cause=error.cause) from error
    except ShardUnreachableError as error:
        doubt = "whether it held the lock to its end" if by_itself else "whether it holds the lock"
        fate = "had ended by itself, but" if by_itself else "was ended, as"
        raise ShardUnreachableError(
            f"{error}; {name} {fate} it is unknown {doubt}",
            shard=error.shard,
            endpoint=error.endpoint,
        ) from error
    finally:
        client.release(lock)
    return running.status


def _shards_of(client: CellClient, items: Iterable[Item]) -> Iterator[str]:
    """Yield the shards on which these data lie: those of a pattern on any."""
    for item in items:
        yield from client.shards() if "*" in item.entity else (client.shard_of(item.entity),)


def _item(cell: Cell, request: tuple[str, str, str, str], default: str | None) -> Item:
    """Return the protocol's line for a request, whose datum type is of no matter here."""
    from enact_dist.access.session import unknown_aspect
    from enact_dist.core.protocol.messages import Item
    from enact_dist.world.cell import session_behind

    world, entity, aspect, access = request
    world = world or default or ""
    worlds = cell.worlds() if not world else ()
    if len(worlds) == 1:
        (world,) = worlds
    if not world:
        raise ConfigError(
            f"in which world context is {entity}/{aspect}? write WORLD:{entity}/{aspect}:{access}"
            f" or --world WORLD (known: {', '.join(worlds) or 'none'})"
        )
    known = session_behind(cell).typed_aspects(enough=aspect)
    if aspect not in known:
        raise unknown_aspect(aspect, known)
    cell.world(world)  # refuses an unknown one by name
    return Item(int(_ACCESSES[access, "*" in entity]), world, entity, aspect)


# ---------------------------------------------------------------- break, resolve, audit


def break_lock(cell: Cell, options: argparse.Namespace) -> Output:
    """Take a lock away by its number."""
    number, reason = options.number, options.reason
    shard = options.shard or _shard_of(number, cell)
    broken = cell.break_lock(number, shard=shard, reason=reason)
    if broken is None:
        raise MisuseError(f"shard {shard} knows no lock {number}; see enact lock ls")
    state = ("kept" if broken.state == "kept" else "held") if broken.granted else "awaited"
    return Output(broken, f"broke lock {number} on {shard}, {state} by {who(broken)}: {reason}")


def resolve_lock(cell: Cell, options: argparse.Namespace) -> Output:
    """Abort a lock in doubt by its number."""
    number, reason = options.force_abort, options.reason
    shard = options.shard or _shard_of(number, cell)
    given_up = cell.force_abort(number, shard=shard, reason=reason)
    if given_up is None:
        raise MisuseError(
            f"lock {number} on shard {shard} is not in doubt, so nothing was done; see"
            " enact lock ls (enact lock break takes a lock from its holder)"
        )
    return Output(
        given_up, f"gave up lock {number} on {shard}, in doubt for {who(given_up)}: {reason}"
    )


def list_audit(options: argparse.Namespace) -> Output:
    """List what operators did and what came of it; with `--acknowledge`, first add to it."""
    if (options.acknowledge is None) != (options.shard is None):
        raise ConfigError("--acknowledge TEXT and --shard NAME go together")
    with open_cell(options) as cell:
        if options.acknowledge is not None:
            cell.acknowledge_alarms(shard=options.shard, how=options.acknowledge)
        shards, status = in_reach(cell)
        entries = cell.audit(shards)
    times = (datetime.fromtimestamp(one.stamp_s).astimezone() for one in entries)
    rows = [
        (at.isoformat(" ", "seconds"), one.shard, one.kind, one.identity or "-", one.text)
        for at, one in zip(times, entries, strict=True)
    ]
    return Output(entries, rows=rows, status=status)


def _shard_of(number: int, cell: Cell) -> str:
    locks = cell.locks(in_reach(cell)[0])
    shards = sorted({lock.shard for lock in locks if lock.number == number})
    if not shards:
        raise MisuseError(f"no shard knows a lock {number}; see enact lock ls")
    if len(shards) > 1:
        raise ConfigError(f"shards {', '.join(shards)} all have a lock {number}; say --shard NAME")
    return shards[0]
