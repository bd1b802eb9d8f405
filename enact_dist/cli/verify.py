"""`enact verify`: the real core under simulated faults, judged; see `enact_dist.verify`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from enact_dist.cli.verbs import NOUNS, add_verb, seconds, whole

if TYPE_CHECKING:
    import argparse

    from enact_dist.cli.verbs import Verb


def add_to(nouns: argparse._SubParsersAction[Verb]) -> None:
    """Add the verb, which has no noun."""
    verify = add_verb(
        nouns,
        "verify",
        NOUNS["verify"].summary,
        run=run_verify,
        example="enact verify\n"
        "enact verify --minutes 10 --json\n"
        "enact verify --seed 17\n"
        "enact verify --recovery\n"
        "enact verify --chaos --minutes 5\n"
        "enact verify --floods --json\n"
        "enact verify --frames --minutes 10",
    )
    add_simulation(verify)
    add_recovery(verify)
    add_chaos(verify)
    add_floods(verify)
    verify.add_argument(
        "--frames",
        action="store_true",
        help="send every kind of message to the core and the store, with hostile values in each"
        " field (default: for one minute; see --seconds, --minutes, --seeds, --first, --seed)",
    )
    verify.add_argument("--json", action="store_true", help="print one JSON object")


def add_simulation(verify: Verb) -> None:
    """Add the options of the simulation."""
    verify.add_argument("--seeds", type=whole, metavar="N", help="how many (default: 200)")
    verify.add_argument(
        "--first", type=int, metavar="SEED", help="first of them (default: never the same twice)"
    )
    verify.add_argument(
        "--jobs", type=whole, metavar="N", help="processes (default: one per processor)"
    )
    time = verify.add_mutually_exclusive_group()
    time.add_argument("--seconds", type=seconds, metavar="S", help="how long to go on")
    time.add_argument(
        "--minutes", dest="seconds", type=minutes, metavar="M", help="how long to go on"
    )
    verify.add_argument("--keep-going", action="store_true", help="do not stop at a violation")
    verify.add_argument(
        "--shrink",
        dest="shrink_s",
        type=float,
        default=60.0,
        metavar="S",
        help="seconds to look for a shorter schedule that still fails (default: 60; 0: do not)",
    )
    again = verify.add_argument_group("one run again")
    again.add_argument("--seed", type=int, metavar="SEED", help="run this seed, and tell its story")
    again.add_argument("--only", metavar="FAULT,…", help="with these faults only")
    again.add_argument("--locks", metavar="LOCK,…", help="with these locks only")
    again.add_argument("--clients", metavar="N,…", help="with these clients only")
    again.add_argument(
        "--until", dest="until_s", type=seconds, metavar="S", help="begin no lock after that"
    )


def add_recovery(verify: Verb) -> None:
    """Add the options of the recovery figures."""
    recovery = verify.add_argument_group("recovery figures")
    recovery.add_argument(
        "--recovery",
        action="store_true",
        help="kill real daemons and clients of a throw-away cell; say how soon locks are back",
    )
    recovery.add_argument(
        "--rounds", type=whole, default=5, metavar="N", help="deaths per figure (default: 5)"
    )


def add_chaos(verify: Verb) -> None:
    """Add the options of the run of real processes; it takes `--seed` and `--minutes` too."""
    chaos = verify.add_argument_group("real daemons and clients")
    what = chaos.add_mutually_exclusive_group()
    what.add_argument(
        "--chaos",
        action="store_true",
        help="kill, stop and cut off real processes for a minute, on hosts of their own and a"
        " network that is slow and loses frames now and then, and check what they saw",
    )
    what.add_argument(
        "--history", type=Path, metavar="FOLDER", help="check what a run has kept once more"
    )
    chaos.add_argument("--shards", type=whole, default=3, metavar="N", help="default: 3")
    chaos.add_argument("--actors", type=whole, default=8, metavar="N", help="default: 8")
    chaos.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="a new folder that keeps journals and data"
    )
    chaos.add_argument(
        "--require-namespaces",
        action="store_true",
        help="fail where there are no namespaces, instead of leaving out what needs a network",
    )


def add_floods(verify: Verb) -> None:
    """Add the options of the floods."""
    floods = verify.add_argument_group("one client against the others")
    floods.add_argument(
        "--floods",
        action="store_true",
        help="flood the shards of a temporary cell with questions, sessions, registrations, forged"
        " messages and so on, in turn, while an honest client keeps updating",
    )
    floods.add_argument(
        "--flood", action="append", metavar="NAME", help="run only this flood (repeatable)"
    )
    floods.add_argument(
        "--updates", type=whole, default=3000, metavar="N", help="per flood (default: 3000)"
    )
    floods.add_argument(
        "--carrier",
        choices=("socket", "zenoh"),
        help="how the honest client's calls travel (default: once over each)",
    )


def minutes(text: str) -> float:
    """Read a positive number of minutes as seconds; an `argparse` type."""
    return seconds(text) * 60.0


def run_verify(arguments: argparse.Namespace) -> int:
    """Run what the options ask for."""
    if arguments.chaos or arguments.history is not None:
        from enact_dist.verify.chaos import command as chaos

        return chaos.run(arguments)
    if arguments.floods or arguments.flood:
        from enact_dist.verify.floods import command as floods

        return floods.run(arguments)
    if arguments.frames:
        from enact_dist.verify.frames import command as frames

        return frames.run(arguments)
    if arguments.recovery:
        from enact_dist.verify import recovery

        return recovery.run(arguments)
    from enact_dist.verify.simulation import command

    return command.run(arguments)
