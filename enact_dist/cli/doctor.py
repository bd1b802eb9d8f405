"""`enact doctor`: prints what `enact_dist.operate.doctor` found."""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.cli.text.output import coloured, print_json
from enact_dist.cli.verbs import DONE, FAILED, NOUNS, add_reader, add_verb, cell_target
from enact_dist.errors import ConfigError
from enact_dist.wire.texts import shown

if TYPE_CHECKING:
    import argparse

    from enact_dist.cli.verbs import Verb

_COLOUR_INDEX = {"ok": 3, "warn": 1, "FAIL": 5}


def add_to(nouns: argparse._SubParsersAction[Verb]) -> None:
    """Add the verb, which has no noun."""
    doctor = add_verb(
        nouns,
        "doctor",
        NOUNS["doctor"].summary,
        run=run_doctor,
        example="enact doctor --cell cell.toml",
    )
    add_reader(doctor)


def run_doctor(arguments: argparse.Namespace) -> int:
    """Print one line per check; status 1 if one of them failed."""
    from enact_dist.operate.doctor import examine
    from enact_dist.operate.doctor_cell import Level

    target = _target(arguments)
    findings = []
    for finding in examine(target, timeout_s=arguments.timeout_s):
        findings.append(finding)
        if not arguments.json:
            mark = coloured(f"{finding.level.value:4}", _COLOUR_INDEX[finding.level.value])
            print(f"{mark}  {shown(f'{finding.subject}: {finding.text}')}", flush=True)
            if finding.remedy:
                print(f"      → {finding.remedy}", flush=True)
    if arguments.json:
        print_json(
            [
                {
                    "level": finding.level.value,
                    "subject": finding.subject,
                    "text": finding.text,
                    "remedy": finding.remedy,
                }
                for finding in findings
            ]
        )
    return FAILED if any(finding.level is Level.FAIL for finding in findings) else DONE


def _target(arguments: argparse.Namespace) -> str:
    """Return the cell, or the empty string where none is named: the machine can still be checked.

    Raises:
        ConfigError: The file that was named does not exist.
    """
    try:
        return cell_target(arguments)
    except ConfigError:
        return ""
