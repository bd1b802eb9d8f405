"""`enact top`: the table of the verb; the modules beside carry it out."""

from __future__ import annotations

from typing import Final

from enact_dist.cli.arguments import ENTITIES, READER, seconds_of
from enact_dist.cli.verbs import NOUNS, Verb, flag, many

VERBS: Final = (
    Verb(
        "top", NOUNS["top"].summary, "command:run_top",
        "enact top\n"
        "enact top --every 0.5 --world online --entities 'camera/*'\n"
        "enact top --once\n"
        "enact top --once --json",
        (
            flag("--once", "print plain tables of two looks and leave; also if standard output is"
                           " no terminal"),
            seconds_of("--every", "time between two looks (default: 1); a cell that takes long to"
                                  " answer is looked at less often", 1.0),
            many("--world", "NAME", "only the data of these contexts"),
            ENTITIES,
            *READER,
        ),
        details="""

Needs the extra 'view' (textual), except with --once.  It only reads.  Keys: s a l d c show the
shards, actors, locks, data or counters alone, and once more all; / filters the rows; o sorts by the
next column, r in the other direction; p pauses; escape shows all; q leaves.""",
    ),
)  # fmt: skip
