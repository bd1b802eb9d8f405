"""`enact record` and `enact replay`: a cell into a file, and a file into a cell."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Final

from enact_dist.cli.text.output import ProgressLine, print_json, shown_bytes, shown_s
from enact_dist.cli.text.times import MOMENT_HELP, moment
from enact_dist.cli.verbs import (
    CELL_DEFAULT,
    DONE,
    FAILED,
    NOUNS,
    add_timeout,
    add_verb,
    cell_target,
    entities,
    is_endpoint,
    open_cell,
    pair,
    pairs,
    seconds,
)
from enact_dist.link.signals import StopSignals

if TYPE_CHECKING:
    from enact_dist.access.arguments import When
    from enact_dist.cli.verbs import Verb
    from enact_dist.config.shows import Shows
    from enact_dist.recording import RecordingSummary, ReplaySummary

COMPRESSIONS: Final = ("zstd", "lz4", "none")
OFFSET_S_MAX: Final = 1e8
"""A larger number is a time in seconds since 1970, a smaller one counts from the begin."""


def add_to(nouns: argparse._SubParsersAction[Verb]) -> None:
    """Add both verbs, which have no noun."""
    _add_record(nouns)
    _add_replay(nouns)


def _add_record(nouns: argparse._SubParsersAction[Verb]) -> None:
    record = add_verb(
        nouns,
        "record",
        NOUNS["record"].summary,
        run=run_record,
        example="enact record cell.toml --out run.mcap\n"
        "enact record tcp/robot:7447 --out run.mcap --world online --entities 'camera/*'"
        " --shows image=image",
    )
    _add_cell(record)
    record.add_argument("--out", metavar="FILE", required=True, help="an .mcap file, a new one")
    record.add_argument("--world", action="append", metavar="NAME", help="only these contexts")
    record.add_argument(
        "--entities", metavar="PATTERN", type=entities, default="**", help="only these entities"
    )
    record.add_argument("--aspect", action="append", metavar="NAME", help="only these aspects")
    record.add_argument(
        "--seconds", type=seconds, metavar="N", help="end by itself after N seconds"
    )
    record.add_argument(
        "--shows",
        action="append",
        type=pair,
        metavar="ASPECT=KIND",
        help="image, mask, point_cloud, mesh, voxels, capsules, joints, pose, calibration or json"
        " (default: as the cell.toml says, else guessed)",
    )
    record.add_argument(
        "--exact-only", action="store_true", help="only what replay needs, nothing to look at"
    )
    record.add_argument(
        "--compress", choices=COMPRESSIONS, default="zstd", help="of chunks (default: zstd)"
    )
    _add_json(record)


def _add_replay(nouns: argparse._SubParsersAction[Verb]) -> None:
    replay = add_verb(
        nouns,
        "replay",
        NOUNS["replay"].summary,
        run=run_replay,
        example="enact replay run.mcap --speed 0.5 --into cell.toml --world online=replayed\n"
        "enact replay run.mcap --speed 0 --from 10 --to 20\n"
        "enact replay run.mcap --world online --entities 'camera/*' --aspect image",
    )
    replay.add_argument("file", metavar="FILE", help="a recording")
    replay.add_argument(
        "--into",
        dest="cell",
        metavar="CELL",
        help="a cell.toml or an endpoint (default: $ENACT_CELL, else ./cell.toml)",
    )
    replay.add_argument(
        "--speed", type=float, default=1.0, metavar="S", help="0: as fast as possible (default: 1)"
    )
    replay.add_argument(
        "--world",
        action="append",
        type=world_choice,
        metavar="NAME|OLD=NEW",
        help="replay only this context (repeat it for several); OLD=NEW writes the recorded data of"
        " OLD into NEW",
    )
    replay.add_argument(
        "--entities", metavar="PATTERN", type=entities, default="**", help="only these entities"
    )
    replay.add_argument("--aspect", action="append", metavar="NAME", help="only these aspects")
    replay.add_argument(
        "--from",
        dest="begin",
        metavar="T",
        type=moment,
        help="begin with the state as of T, seconds since the recording's begin, or " + MOMENT_HELP,
    )
    replay.add_argument("--to", dest="end", metavar="T", type=moment, help="end at T, likewise")
    replay.add_argument("--loop", action="store_true", help="begin anew at the end, until Ctrl-C")
    replay.add_argument(
        "--overwrite", action="store_true", help="also write into contexts that have data"
    )
    _add_json(replay)


def world_choice(text: str) -> tuple[str, str]:
    """Read ``NAME`` (returned twice) or ``OLD=NEW``; an `argparse` type."""
    return pair(text) if "=" in text else (text, text)


def _add_cell(parser: Verb) -> None:
    parser.add_argument(
        "cell",
        metavar="CELL",
        nargs="?",
        help=f"a cell.toml or an endpoint (default: $ENACT_CELL, else ./{CELL_DEFAULT})",
    )


def _add_json(parser: Verb) -> None:
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    add_timeout(parser)


# ---------------------------------------------------------------- record


def run_record(arguments: argparse.Namespace) -> int:
    """Record until a signal or for so many seconds; fail where versions or aspects are missing."""
    from enact_dist.recording import Recorder

    line = ProgressLine()
    with StopSignals() as stop, open_cell(arguments) as cell:
        recorder = Recorder(
            cell,
            arguments.out,
            worlds=arguments.world or (),
            entities=arguments.entities,
            aspects=arguments.aspect or (),
            shows=shows_of(arguments),
            pictures=not arguments.exact_only,
            compression=arguments.compress,
        )
        summary = recorder.run(
            stop.event,
            seconds=arguments.seconds,
            tell=lambda so_far: line.show(_recorded_line(so_far)),
        )
    line.end()
    if arguments.json:
        print_json(summary)
    else:
        print(_recorded_line(summary))
        for slot, count in summary.gap_slots.items():
            print(f"  missing {count} of {slot}")
        for name, count in summary.counts.items():
            print(f"  {name}: {count}")
    return FAILED if summary.missing or summary.unknown_aspects else DONE


def shows_of(arguments: argparse.Namespace) -> dict[str, Shows]:
    """Return what aspects look like: as the `cell.toml` says, and as the options do.

    Raises:
        ConfigError: An option names no kind.
    """
    from enact_dist.config.read import load_config
    from enact_dist.config.shows import Shows

    target = cell_target(arguments)
    declared = {}
    if not is_endpoint(target):
        declared = {aspect.name: aspect.shows for aspect in load_config(target).aspects}
    for name, kinds in pairs(arguments.shows, "--shows").items():
        declared[name] = Shows(tuple(kinds.split(",")))
    return declared


def _recorded_line(summary: RecordingSummary) -> str:
    parts = [
        f"{summary.path}: {shown_s(summary.seconds)}",
        f"{summary.commits} commits",
        f"{summary.versions} versions ({summary.initial} there at the begin)",
        f"{shown_bytes(summary.size_bytes)} in {summary.chunks} chunks",
    ]
    parts += [f"{count} MISSING ({reason})" for reason, count in summary.gaps.items()]
    parts += [f"the cell knows NO ASPECT {name!r}" for name in summary.unknown_aspects]
    return ", ".join(parts)


# ---------------------------------------------------------------- replay


def run_replay(arguments: argparse.Namespace) -> int:
    """Commit a recording again until its end or a signal; fail where nothing in it was chosen."""
    from enact_dist.recording import Replay

    def warn(text: str) -> None:
        line.end()
        print(f"enact: {text}", file=sys.stderr, flush=True)

    line = ProgressLine()
    worlds = pairs(arguments.world, "--world")
    with StopSignals() as stop, open_cell(arguments, observer=False, actor="replay") as cell:
        replay = Replay(
            cell,
            arguments.file,
            worlds=worlds,
            only_worlds=worlds if any(old == new for old, new in worlds.items()) else (),
            entities=arguments.entities,
            aspects=arguments.aspect or (),
            speed=arguments.speed,
            overwrite=arguments.overwrite,
        )
        begin_ns = int(replay.recording.facts.get("begin_ns", "0"))
        replay.between(_moment_ns(arguments.begin, begin_ns), _moment_ns(arguments.end, begin_ns))
        summary = replay.run(
            stop.event,
            loop=arguments.loop,
            tell=lambda so_far: line.show(_replayed_line(so_far)),
            warn=warn,
            show=warn,
        )
    line.end()
    if arguments.json:
        print_json(summary)
    else:
        print(_replayed_line(summary))
        for slot, who in summary.other_writers.items():
            print(f"  {slot}: {who} also writes it")
    if summary.rounds and not summary.versions:
        print("enact: no recorded data match the options, so nothing was set", file=sys.stderr)
        return FAILED
    return DONE


def _moment_ns(when: When | None, begin_ns: int) -> int:
    """Return the stamp of a moment, or of so many seconds after the begin; 0 for none.

    Raises:
        MisuseError: It lies in the future, or before 1970.
    """
    from enact_dist.access.arguments import stamp_of

    if when is None:
        return 0
    if isinstance(when, float) and 0.0 <= when < OFFSET_S_MAX:
        return begin_ns + round(when * 1e9)
    return stamp_of(when)


def _replayed_line(summary: ReplaySummary) -> str:
    parts = [
        f"{summary.path}: {shown_s(summary.seconds)}",
        f"{summary.commits} commits",
        f"{summary.versions} data",
    ]
    if summary.late:
        parts.append(f"{summary.late} late, by {shown_s(summary.late_s_max)} at most")
    if summary.gaps:
        parts.append(f"{summary.gaps} versions were MISSING when it was recorded")
    if summary.rounds and not summary.whole:
        missing = shown_bytes(summary.missing_bytes)
        parts.append(f"the recording was CUT OFF: {missing} after its last whole chunk not used")
    return ", ".join(parts)
