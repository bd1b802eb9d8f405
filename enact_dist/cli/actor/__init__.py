"""`enact actor`: the table of its verbs; the modules beside carry them out."""

from __future__ import annotations

from typing import Final

from enact_dist.cli.arguments import (
    CELL,
    CELL_FILE,
    JSON,
    LOG,
    READER,
    TIMEOUT,
    duration,
    file_of,
    one_entity,
    pair,
    seconds_of,
)
from enact_dist.cli.text.times import span
from enact_dist.cli.verbs import LOOKS, Verb, flag, many, option

_NAME: Final = option("name", "NAME", "name of the actor, as enact actor ls shows it")

VERBS: Final = (
    Verb(
        "run", "run one actor, or several, in this process until SIGTERM or until all are done",
        "run:run_actors",
        "enact actor run fusion\n"
        "enact actor run camera-3 subtraction-3\n"
        "enact actor run --process camera-3\n"
        "enact actor run actors.palletizing.fusion:Fusion --world training=training"
        " --option voxel_m=0.002",
        (
            option("targets", "TARGET",
                   "MODULE:CLASS, or the name of an actor of cell.toml; several names: these share"
                   " the process, each in a thread with a session of its own", nargs="*"),
            option("--process", "NAME", "run all actors that have this `process` in cell.toml",
                   default=""),
            CELL,
            TIMEOUT,
            LOG,
            option("--name", None, "how others see it (default: class and entity)", default=""),
            many("--world", "ROLE=NAME",
                 "bind a role to a world context; without any, each role to that of its name",
                 type=pair),
            many("--option", "KEY=VALUE", "argument of the class", type=pair),
            option("--entity", "NAME",
                   "the one entity that it works on, of those that its patterns match",
                   type=one_entity),
            seconds_of("--every", "period of a source, seconds"),
            option("--drain", "S",
                   "seconds that an update may take after SIGTERM before it is cut off (default:"
                   " `drain_s` of the actor in cell.toml, else 8)", dest="drain_s", type=duration),
        ),
    ),
    Verb(
        "set",
        "change attributes of a running actor until it ends; it starts again with the values of"
        " cell.toml",
        "tell:set_values",
        "enact actor set camera gain=0.7 label=front",
        (
            _NAME,
            CELL,
            TIMEOUT,
            option("values", "KEY=VALUE", "attribute and its new value", nargs="+", type=pair),
        ),
    ),
    Verb(
        "restart",
        "restart an actor after its current update; its supervisor (enact up, systemd, docker)"
        " starts it again",
        "tell:restart_actor",
        "enact actor restart camera",
        (_NAME, CELL, TIMEOUT),
    ),
    Verb(
        "ls", "list the sessions of the cell with what their actors report, and which are silent",
        "actor:list_actors",
        "enact actor ls --json",
        READER,
        cell=LOOKS,
        columns=("actor", "host", "pid", "state", "updates", "rate", "failures", "refused",
                 "incomplete", "wait p99", "last update", "lease left", "locks", "last error"),
        empty="no actor is connected",
    ),
    Verb(
        "check", "check all declared reads and writes of the cell's actors, without running any",
        "actor:check_actors",
        "enact actor check --cell cell.toml\nenact actor check --graph cell.svg\n"
        "enact actor check --learn 10min",
        (
            CELL_FILE,
            JSON,
            many("--initial", "ASPECT", "an aspect that is written from outside; may be repeated",
                 default=[]),
            file_of("--graph", "FILE.svg",
                    "draw entities, aspects and actors with all declared reads and writes; of a"
                    " running cell, with the rate of each actor"),
            flag("--rights", "write rights.toml beside the cell.toml: what each actor may read and"
                 " write by its declaration"),
            option("--learn", "TIME",
                   "in a running cell with [rights], collect what is refused in this time (such as"
                   " 10min), and print the rules that would allow it; 0: what its shards have"
                   " refused so far", type=span),
        ),
    ),
)  # fmt: skip
