"""`enact lock ls|hold|break|resolve|audit`."""

from __future__ import annotations

import argparse
import os
import re
import sys
from datetime import datetime
from typing import TYPE_CHECKING, Final

from enact_dist.cli.text.output import print_json, print_table, shown_s
from enact_dist.cli.verbs import (
    DONE,
    UNREACHABLE,
    add_cell,
    add_noun,
    add_reader,
    add_timeout,
    add_verb,
    open_cell,
    seconds,
    slot_parts,
    verbs_of,
    whole,
)
from enact_dist.errors import ConfigError, LeaseLostError, MisuseError, ShardUnreachableError
from enact_dist.link.signals import StopSignals
from enact_dist.terms import Access, Entities, Entity, checked_name
from enact_dist.wire.texts import shown

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.cli.verbs import Verb
    from enact_dist.core.protocol.messages import Item
    from enact_dist.link.client.locks import CellClient
    from enact_dist.world.cell import Cell
    from enact_dist.world.listings import LockInfo

POLL_S: Final = 0.05
"""How soon a lost lock or an ended command is noticed."""

_HELD: Final = re.compile(r"(?:(?P<world>[^:/]+):)?(?P<slot>[^:]+):(?P<access>read|write)\Z")

_ACCESSES: Final = {
    ("read", False): Access.READ,
    ("write", False): Access.WRITE,
    ("read", True): Access.READ_EACH,
    ("write", True): Access.WRITE_EACH,
}


def add_to(nouns: argparse._SubParsersAction[Verb]) -> None:
    """Add the noun and its verbs."""
    verbs = verbs_of(add_noun(nouns, "lock"))
    ls = add_verb(
        verbs,
        "ls",
        "list who holds what and who waits for whom",
        run=list_locks,
        example="enact lock ls",
    )
    add_reader(ls)
    _add_hold(verbs)
    _add_break(verbs)
    _add_resolve(verbs)
    _add_audit(verbs)


def _add_hold(verbs: argparse._SubParsersAction[Verb]) -> None:
    hold = add_verb(
        verbs,
        "hold",
        "run a command while holding a lock; status is the command's, 1 if the lock is lost, 3 if"
        " its shard does not answer; either ends the command",
        run=hold_lock,
        example="enact lock hold online:robot/pose:write -- ./calibrate.sh\n"
        "enact lock hold --world online robot/pose:write 'tray/*/surface:read' -- sleep 5",
    )
    hold.usage = "enact lock hold [options] [WORLD:]ENTITY/ASPECT:read|write … -- COMMAND …"
    hold.add_argument(
        "requests",
        nargs="+",
        type=held,
        metavar="[WORLD:]ENTITY/ASPECT:MODE",
        help="what to hold; MODE is read or write; an entity with * means all that match",
    )
    hold.add_argument("--world", metavar="WORLD", help="of requests that name none")
    hold.add_argument("--wait", type=seconds, default=10.0, metavar="S", help="for the grant")
    hold.add_argument(
        "--hold", type=seconds, default=3600.0, metavar="S", help="at most (default: 3600)"
    )
    add_cell(hold)
    add_timeout(hold)


def _add_break(verbs: argparse._SubParsersAction[Verb]) -> None:
    cut = add_verb(
        verbs,
        "break",
        "take a lock away from its holder, who learns why; its commit will be refused",
        run=break_lock,
        example="enact lock break 1742 --shard left --reason 'camera unplugged'",
    )
    cut.add_argument("number", type=whole, metavar="NUMBER", help="as `enact lock ls` shows it")
    cut.add_argument("--shard", metavar="NAME", help="needed where two shards use the number")
    cut.add_argument("--reason", default="broken by hand", metavar="TEXT", help="for the holder")
    add_reader(cut)


def _add_resolve(verbs: argparse._SubParsersAction[Verb]) -> None:
    resolve = add_verb(
        verbs,
        "resolve",
        "give up a lock in doubt whose deciding shard is lost for good (audited)",
        run=resolve_lock,
        example="enact lock resolve --force-abort 17 --shard right --reason 'disk of left is gone'",
    )
    resolve.add_argument(
        "--force-abort",
        required=True,
        type=whole,
        metavar="LOCK",
        help="its number in `enact lock ls`; if the lost shard had committed it, only a part of"
        " that commit stands: restore that shard's folder first wherever you can",
    )
    resolve.add_argument("--shard", metavar="NAME", help="needed where two shards use the number")
    resolve.add_argument("--reason", required=True, metavar="TEXT", help="for the audit record")
    add_reader(resolve)


def _add_audit(verbs: argparse._SubParsersAction[Verb]) -> None:
    audit = add_verb(
        verbs,
        "audit",
        "list locks that were ended by hand, and alarms: commits that stand only in part since",
        run=list_audit,
        example="enact lock audit\n"
        "enact lock audit --settle 'bench/contacts written again from left' --shard right",
    )
    audit.add_argument("--settle", metavar="TEXT", help="say how all alarms so far were seen to")
    audit.add_argument("--shard", metavar="NAME", help="whose alarms; needed with --settle")
    add_reader(audit)


# ---------------------------------------------------------------- ls


def list_locks(arguments: argparse.Namespace) -> int:
    """Print all locks of the cell, held or awaited; status 3 if a shard does not answer."""
    with open_cell(arguments) as cell:
        shards, status = in_reach(cell)
        locks = cell.locks(shards)
    if arguments.json:
        print_json(locks)
        return status
    known = {(lock.shard, lock.number): lock for lock in locks}
    print_table(
        ("lock", "shard", "who", "state", "mode", "age", "lease left", "hold left", "data",
         "waits for"),
        [_row(lock, known) for lock in locks],
        empty="no lock is held or awaited",
    )  # fmt: skip
    return status


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
            why = f": {shard.problem}" if shard.problem else " does not answer"
            print(f"enact: shard {shard.name} at {shard.endpoint}{why}", file=sys.stderr)
    return tuple(reachable), status


def _row(lock: LockInfo, known: dict[tuple[str, int], LockInfo]) -> tuple[object, ...]:
    blockers = [_blocker(number, known.get((lock.shard, number))) for number in lock.waits_for]
    return (
        lock.number,
        lock.shard,
        who(lock),
        "held" if lock.granted else "waits",
        lock.modes,
        shown_s(lock.age_s),
        shown_s(lock.lease_left_s),
        shown_s(lock.hold_left_s) if lock.granted else "-",
        ", ".join(lock.slots),
        ", ".join(blockers) or "-",
    )


def who(lock: LockInfo) -> str:
    """Return the holder as people look for it: actor, host, process."""
    return shown(f"{lock.actor}@{lock.host} pid {lock.pid}")


def _blocker(number: int, lock: LockInfo | None) -> str:
    return f"{number} ({who(lock)})" if lock is not None else str(number)


# ---------------------------------------------------------------- hold


def held(text: str) -> tuple[str, str, str, str]:
    """Read ``[WORLD:]ENTITY/ASPECT:read|write``; an `argparse` type."""
    found = _HELD.match(text)
    if found is None:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not written [WORLD:]ENTITY/ASPECT:read or …:write"
        )
    entity, aspect = slot_parts(found["slot"])
    try:
        (Entities if "*" in entity else Entity)(entity)
        checked_name("aspect", aspect, slashes=False)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return found["world"] or "", entity, aspect, found["access"]


def hold_lock(arguments: argparse.Namespace) -> int:
    """Hold a lock while a command runs."""
    if not arguments.command:
        raise ConfigError("lock hold needs a command: enact lock hold REQUEST … -- COMMAND …")
    with (
        StopSignals() as stop,
        open_cell(arguments, observer=False, actor=_command_name(arguments)) as cell,
    ):
        return _hold(cell, arguments, stop)


def _hold(cell: Cell, arguments: argparse.Namespace, stop: StopSignals) -> int:
    from enact_dist.cli.held_command import HeldCommand

    items = [_item(cell, request, arguments.world) for request in arguments.requests]
    client = cell.world(items[0].context).session.client
    entries = client.aspect_entries()
    client.register(
        aspects=[entries[item.aspect]._replace(reads=True) for item in items],
        needed=lambda: _shards_of(client, items),
    )
    lock = client.acquire(items, wait_s=arguments.wait, hold_s=arguments.hold)
    name, by_itself = arguments.command[0], False
    try:
        with HeldCommand(arguments.command) as running:
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


def _command_name(arguments: argparse.Namespace) -> str:
    return f"hold:{os.path.basename(arguments.command[0])}"  # noqa: PTH119 (a word, not a file)


def _item(cell: Cell, request: tuple[str, str, str, str], default: str | None) -> Item:
    """Return the protocol's line for a request, whose datum type is of no matter here."""
    from enact_dist.access.session import unknown_aspect
    from enact_dist.core.protocol.messages import Item

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
    known = [name for name, entry in cell.aspects(enough=aspect).items() if entry[0]]
    if aspect not in known:
        raise unknown_aspect(aspect, known)
    cell.world(world)  # refuses an unknown one by name
    return Item(int(_ACCESSES[access, "*" in entity]), world, entity, aspect)


# ---------------------------------------------------------------- break


def break_lock(arguments: argparse.Namespace) -> int:
    """Take a lock away by its number."""
    with open_cell(arguments) as cell:
        shard = arguments.shard or _shard_of(arguments.number, cell)
        broken = cell.break_lock(arguments.number, shard=shard, reason=arguments.reason)
    if broken is None:
        raise MisuseError(f"shard {shard} knows no lock {arguments.number}; see enact lock ls")
    if arguments.json:
        print_json(broken)
    else:
        state = "held" if broken.granted else "awaited"
        print(
            f"broke lock {broken.number} on {shard}, {state} by {who(broken)}: {arguments.reason}"
        )
    return DONE


def resolve_lock(arguments: argparse.Namespace) -> int:
    """Abort a lock in doubt by its number."""
    number, reason = arguments.force_abort, arguments.reason
    with open_cell(arguments) as cell:
        shard = arguments.shard or _shard_of(number, cell)
        given_up = cell.force_abort(number, shard=shard, reason=reason)
    if given_up is None:
        raise MisuseError(
            f"lock {number} on shard {shard} is not in doubt, so nothing was done; see"
            " enact lock ls (enact lock break takes a lock from its holder)"
        )
    if arguments.json:
        print_json(given_up)
    else:
        print(f"gave up lock {number} on {shard}, in doubt for {who(given_up)}: {reason}")
    return DONE


# ---------------------------------------------------------------- audit


def list_audit(arguments: argparse.Namespace) -> int:
    """Print what operators did and what came of it; with `--settle`, first add to it."""
    if (arguments.settle is None) != (arguments.shard is None):
        raise ConfigError("--settle TEXT and --shard NAME go together")
    with open_cell(arguments) as cell:
        if arguments.settle is not None:
            cell.settle_alarms(shard=arguments.shard, how=arguments.settle)
        shards, status = in_reach(cell)
        entries = cell.audit(shards)
    if arguments.json:
        print_json(entries)
        return status
    rows = [
        (_local_time(one.stamp_s), one.shard, one.kind, one.identity or "-", one.text)
        for one in entries
    ]
    columns = ("when", "shard", "what", "by", "details")
    print_table(columns, rows, empty="no lock was ended by hand")
    return status


def _local_time(stamp_s: float) -> str:
    return datetime.fromtimestamp(stamp_s).astimezone().isoformat(" ", "seconds")


def _shard_of(number: int, cell: Cell) -> str:
    locks = cell.locks(in_reach(cell)[0])
    shards = sorted({lock.shard for lock in locks if lock.number == number})
    if not shards:
        raise MisuseError(f"no shard knows a lock {number}; see enact lock ls")
    if len(shards) > 1:
        raise ConfigError(f"shards {', '.join(shards)} all have a lock {number}; say --shard NAME")
    return shards[0]
