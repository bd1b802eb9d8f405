"""`enact doctor`: prints what `enact_dist.operate.doctor` found."""

from __future__ import annotations

import argparse
from typing import Final

from enact_dist.cli.arguments import READER
from enact_dist.cli.target import cell_target
from enact_dist.cli.text.output import coloured
from enact_dist.cli.verbs import DONE, FAILED, NOUNS, Output, Verb
from enact_dist.errors import ConfigError
from enact_dist.wire.texts import shown

_TEXTS: Final = ("subject", "text", "remedy")
_COLOUR_INDEX: Final = {"ok": 3, "warn": 1, "FAIL": 5}


VERBS: Final = (
    Verb(
        "doctor", NOUNS["doctor"].summary, "run_doctor", "enact doctor --cell cell.toml", READER
    ),
)  # fmt: skip


def run_doctor(options: argparse.Namespace) -> Output:
    """Print one line per check as it ends; status 1 if one of them failed."""
    from enact_dist.operate.doctor import examine
    from enact_dist.operate.doctor_cell import Level

    facts, status = [], DONE
    for finding in examine(_target(options), timeout_s=options.timeout_s):
        level = finding.level.value
        facts.append({"level": level, **{key: getattr(finding, key) for key in _TEXTS}})
        status = FAILED if finding.level is Level.FAIL else status
        if not options.json:
            mark = coloured(f"{level:4}", _COLOUR_INDEX[level])
            print(f"{mark}  {shown(f'{finding.subject}: {finding.text}')}", flush=True)
            if finding.remedy:
                print(f"      → {finding.remedy}", flush=True)
    return Output(facts, status=status)


def _target(options: argparse.Namespace) -> str:
    """Return the cell, or the empty string where none is named: the machine can still be checked.

    Raises:
        ConfigError: The file that was named does not exist.
    """
    try:
        return cell_target(options)
    except ConfigError:
        return ""
