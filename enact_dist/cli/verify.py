"""`enact verify`: the real core under simulated faults, judged; see `enact_dist.verify`."""

from __future__ import annotations

import argparse
from typing import Final

from enact_dist.cli.arguments import counted, file_of, seconds, seconds_of
from enact_dist.cli.verbs import NOUNS, OneOf, OptionGroup, Verb, flag, many, option


def minutes(text: str) -> float:
    """Read a positive number of minutes as seconds; an `argparse` type."""
    return seconds(text) * 60.0


_SIMULATION: Final = (
    counted("--seeds", "number of seeds (default: 200)"),
    option("--first", "SEED", "first of the seeds (default: never the same twice)", type=int),
    counted("--jobs", "processes (default: one per processor)"),
    OneOf((
        seconds_of("--seconds", "how long to run"),
        option("--minutes", "M", "how long to run", dest="seconds", type=minutes),
    )),
    flag("--keep-going", "do not stop at a violation"),
    option("--shrink", "S",
           "seconds to look for a shorter schedule that still fails (default: 60; 0: do not)",
           dest="shrink_s", type=float, default=60.0),
    OptionGroup("one run again", (
        option("--seed", "SEED", "run this seed, and print its events", type=int),
        option("--only", "FAULT,…", "with these faults only"),
        option("--locks", "LOCK,…", "with these locks only"),
        option("--clients", "N,…", "with these clients only"),
        seconds_of("--until", "begin no lock after that", dest="until_s"),
    )),
)  # fmt: skip
_RECOVERY: Final = OptionGroup("recovery figures", (
    flag("--recovery",
         "kill real daemons and clients of a throw-away cell; measure how soon locks are back"),
    counted("--rounds", "deaths per figure (default: 5)", 5),
))  # fmt: skip
_CHAOS: Final = OptionGroup("real daemons and clients", (
    OneOf((
        flag("--chaos",
             "kill, stop and cut off real processes for a minute, on hosts of their own and a"
             " network that is slow and loses frames now and then, and check what they saw"),
        file_of("--history", "FOLDER", "check once more what an earlier run has kept"),
    )),
    counted("--shards", "number of shards (default: 3)", 3),
    counted("--actors", "number of actors (default: 8)", 8),
    file_of("--keep", "FOLDER", "a new folder that keeps journals and data"),
    option("--store", "URL",
           "keep the shards in this database, with a standby daemon for each, and leave nothing"
           " there; `nodes`: in two servers of PostgreSQL on hosts of their own, which meet faults,"
           " too (needs root and namespaces)",
           default=""),
    flag("--require-namespaces",
         "fail where there are no namespaces, instead of leaving out what needs a network"),
))  # fmt: skip
_FLOODS: Final = OptionGroup("one client against the others", (
    flag("--floods",
         "flood the shards of a temporary cell with questions, sessions, registrations, forged"
         " messages and so on, in turn, while an honest client keeps updating"),
    many("--flood", "NAME", "run only this flood (repeatable)"),
    counted("--updates", "per flood (default: 3000)", 3000),
    option("--carrier", None,
           "how the honest client's calls travel (default: once over each)",
           choices=("socket", "zenoh")),
))  # fmt: skip

VERBS: Final = (
    Verb(
        "verify", NOUNS["verify"].summary, "run_verify",
        "enact verify\n"
        "enact verify --minutes 10 --json\n"
        "enact verify --seed 17\n"
        "enact verify --recovery\n"
        "enact verify --chaos --minutes 5\n"
        "enact verify --chaos --store nodes --shards 2 --minutes 5\n"
        "enact verify --floods --json\n"
        "enact verify --frames --minutes 10\n"
        "enact verify --takeover --minutes 10",
        (
            *_SIMULATION,
            _RECOVERY,
            _CHAOS,
            _FLOODS,
            flag("--frames",
                 "send every kind of message to the core and the store, with hostile values in"
                 " each field (default: for one minute; see --seconds, --minutes, --seeds,"
                 " --first, --seed)"),
            flag("--takeover",
                 "simulate shards in a replicated database, each with a standby daemon, and the"
                 " faults of both (see --seeds, --first, --seconds, --minutes, --jobs, --seed)"),
            flag("--json", "print one JSON object"),
        ),
    ),
)  # fmt: skip


def run_verify(options: argparse.Namespace) -> int:
    """Run what the options ask for."""
    if options.chaos or options.history is not None:
        from enact_dist.verify.chaos import command as chaos

        return chaos.run(options)
    if options.floods or options.flood:
        from enact_dist.verify.floods import command as floods

        return floods.run(options)
    if options.frames:
        from enact_dist.verify.frames import command as frames

        return frames.run(options)
    if options.takeover:
        from enact_dist.verify.takeover import command as takeover

        return takeover.run(options)
    if options.recovery:
        from enact_dist.verify import recovery

        return recovery.run(options)
    from enact_dist.verify.simulation import command

    return command.run(options)
