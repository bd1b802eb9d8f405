"""`enact record` and `enact replay`: a cell into a file, and a file into a cell."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final

from enact_dist.cli.arguments import (
    ASPECTS,
    CELL_NAMED,
    COMPRESSIONS,
    ENTITIES,
    TIMEOUT,
    label,
    one_entity,
    pair,
    pairs,
    seconds,
    tolerance,
)
from enact_dist.cli.target import cell_target, is_endpoint, open_cell
from enact_dist.cli.text.output import ProgressLine, shown_bytes
from enact_dist.cli.text.times import MOMENT_HELP, moment
from enact_dist.cli.verbs import (
    DONE,
    FAILED,
    NOUNS,
    Option,
    OptionGroup,
    Output,
    Verb,
    flag,
    many,
    option,
)
from enact_dist.errors import ConfigError
from enact_dist.link.signals import StopSignals
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable

    from enact_dist.access.arguments import When
    from enact_dist.cli.verbs import Part
    from enact_dist.config.shows import Shows
    from enact_dist.recording import RecordingSummary, ReplaySummary

OFFSET_S_MAX: Final = 1e8
"""A larger number is a time in seconds since 1970, a smaller one counts from the begin."""


def world_choice(text: str) -> tuple[str, str]:
    """Read ``NAME`` (returned twice) or ``OLD=NEW``; an `argparse` type."""
    return pair(text) if "=" in text else (text, text)


_SUMMARY: Final = (flag("--json", "print the summary as JSON"), TIMEOUT)

_OF_A_FILE: Final = (
    option("--speed", "S", "0: as fast as possible (default: 1)", type=float),
    ENTITIES,
    ASPECTS,
    option("--from", "T",
           "begin with the state as of T, seconds since the recording's begin, or "
           + MOMENT_HELP, dest="begin", type=moment),
    option("--to", "T", "end at T, likewise", dest="end", type=moment),
    flag("--loop", "start again at the end, until Ctrl-C"),
    flag("--overwrite", "also write into contexts that have data"),
)  # fmt: skip

_STEP: Final = OptionGroup(
    "one step of an actor",
    (
        Option(("--step",), {
            "nargs": 2, "metavar": ("WORLD", "ENTITY/ASPECT[@VERSION]"),
            "help": "run the step again that made this version (default: the newest), on what its"
                    " commit had read, and compare what it writes",
        }),
        option("--actor", "MODULE:CLASS", "the actor that runs"),
        option("--name", "NAME",
               "take options, world contexts and entity, and the class unless --actor names one,"
               " of this actor in cell.toml", default=""),
        many("--option", "KEY=VALUE", "argument of the class", type=pair),
        option("--entity", "NAME", "the entity that triggered it, or the one that it works on",
               type=one_entity),
        many("--tolerance", "[ASPECT=]X",
             "how far numbers may be apart: 0.5, 1%%, shift_mm=0.5", type=tolerance, default=[]),
        option("--keep-as", "NAME",
               "keep the world context of the step, else it is dropped; of several, each is called"
               " NAME-WORLD", default=""),
        option("--invalidate", "LABEL",
               "then make the version null, and what was made of it, as enact invalidate does",
               type=label),
    ),
    """\
The step runs in world contexts of its own and writes no other.  Its code is not
kept from anything else: start, update and stop of an actor that moves a machine,
writes a file or sends a message do so again.  --world ROLE=NAME binds a role.
Status 0 if it writes the same, 4 if not, 1 if it raises.""",
)  # fmt: skip

VERBS: Final = (
    Verb(
        "record", NOUNS["record"].summary, "run_record",
        "enact record cell.toml --out run.mcap\n"
        "enact record tcp/robot:7447 --out run.mcap --world online --entities 'camera/*'"
        " --shows image=image",
        (
            CELL_NAMED,
            option("--out", "FILE", "a new .mcap file", required=True),
            many("--world", "NAME", "only these contexts"),
            ENTITIES,
            ASPECTS,
            option("--seconds", "N", "stop after N seconds", type=seconds),
            many("--shows", "ASPECT=KIND",
                 "image, mask, point_cloud, mesh, voxels, capsules, joints, pose, calibration or"
                 " json (default: as the cell.toml says, else guessed)", type=pair),
            flag("--exact-only", "record only what replay needs, nothing for viewers"),
            option("--compress", None, "compression of chunks (default: zstd)",
                   choices=COMPRESSIONS, default="zstd"),
            *_SUMMARY,
        ),
    ),
    Verb(
        "replay", NOUNS["replay"].summary, "run_replay",
        "enact replay run.mcap --speed 0.5 --into cell.toml --world online=replayed\n"
        "enact replay run.mcap --speed 0 --from 10 --to 20\n"
        "enact replay run.mcap --world online --entities 'camera/*' --aspect image\n"
        "enact replay --step online system/deviation@12 --actor my_actors:Deviation\n"
        "enact replay --step online system/deviation --name deviation --keep-as tried",
        (
            option("file", "FILE", "a recording", nargs="?"),
            Option(("--into", "--cell"), {
                "metavar": "CELL", "dest": "cell",
                "help": "a cell.toml or an endpoint (default: $ENACT_CELL, else ./cell.toml)",
            }),
            many("--world", "NAME|OLD=NEW",
                 "replay only this context (repeat it for several); OLD=NEW writes the recorded"
                 " data of OLD into NEW", type=world_choice),
            *_OF_A_FILE,
            *_SUMMARY,
            _STEP,
        ),
    ),
)  # fmt: skip


# ---------------------------------------------------------------- record


def run_record(options: argparse.Namespace) -> Output:
    """Record until a signal or for so many seconds; fail where versions or aspects are missing."""
    from enact_dist.recording import Recorder

    line = ProgressLine()
    with StopSignals() as stop, open_cell(options) as cell:
        recorder = Recorder(
            cell,
            options.out,
            worlds=options.world or (),
            entities=options.entities,
            aspects=options.aspect or (),
            shows=shows_of(options),
            pictures=not options.exact_only,
            compression=options.compress,
        )
        summary = recorder.run(
            stop.event,
            seconds=options.seconds,
            tell=lambda so_far: line.show(_recorded_line(so_far)),
        )
    line.end()
    missing = (f"  missing {count} of {slot}" for slot, count in summary.gap_slots.items())
    counts = (f"  {name}: {count}" for name, count in summary.counts.items())
    status = FAILED if summary.missing or summary.unknown_aspects else DONE
    return Output(summary, "\n".join((_recorded_line(summary), *missing, *counts)), status=status)


def shows_of(options: argparse.Namespace) -> dict[str, Shows]:
    """Return what aspects look like: as the `cell.toml` says, and as the options do.

    Raises:
        ConfigError: An option names no kind.
    """
    from enact_dist.config.read import load_config
    from enact_dist.config.shows import Shows

    target = cell_target(options)
    declared = {}
    if not is_endpoint(target):
        declared = {aspect.name: aspect.shows for aspect in load_config(target).aspects}
    for name, kinds in pairs(options.shows, "--shows").items():
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


def run_replay(options: argparse.Namespace) -> Output:
    """Commit a recording again until its end or a signal; fail where nothing in it was chosen.

    Raises:
        ConfigError: Neither a recording nor a step is named, or both, or an option of the other.
    """
    if (options.file is None) == (options.step is None):
        raise ConfigError("name either a recording or --step WORLD ENTITY/ASPECT@VERSION")
    of_a_step = options.step is not None
    if unused := _given(options, _OF_A_FILE if of_a_step else _STEP.options):
        what = "a recording, not of --step" if of_a_step else "--step, not of a recording"
        raise ConfigError(f"options of {what}: {', '.join(unused)}")
    if of_a_step:
        from enact_dist.cli.step import run_step

        return run_step(options)
    from enact_dist.recording import Replay

    def warn(text: str) -> None:
        line.end()
        print(f"enact: {text}", file=sys.stderr, flush=True)

    line = ProgressLine()
    worlds = pairs(options.world, "--world")
    with StopSignals() as stop, open_cell(options, observer=False, actor="replay") as cell:
        replay = Replay(
            cell,
            options.file,
            worlds=worlds,
            only_worlds=worlds if any(old == new for old, new in worlds.items()) else (),
            entities=options.entities,
            aspects=options.aspect or (),
            speed=1.0 if options.speed is None else options.speed,
            overwrite=options.overwrite,
        )
        begin_ns = int(replay.recording.facts.get("begin_ns", "0"))
        replay.between(_moment_ns(options.begin, begin_ns), _moment_ns(options.end, begin_ns))
        summary = replay.run(
            stop.event,
            loop=options.loop,
            tell=lambda so_far: line.show(_replayed_line(so_far)),
            warn=warn,
            show=warn,
        )
    line.end()
    nothing = bool(summary.rounds and not summary.versions)
    if nothing:
        print("enact: no recorded data match the options, so nothing was set", file=sys.stderr)
    others = (f"  {slot}: {who} also writes it" for slot, who in summary.other_writers.items())
    text = "\n".join((_replayed_line(summary), *others))
    return Output(summary, text, status=FAILED if nothing else DONE)


def _given(options: argparse.Namespace, among: Iterable[Part]) -> list[str]:
    """Return which of some options the command line has: those that are not as without it."""
    found = []
    for one in among:
        if isinstance(one, Option):  # no `OneOf` is among them
            name = one.settings.get("dest", one.names[0][2:].replace("-", "_"))
            value = getattr(options, name)
            if value is not None and value is not False and value != one.settings.get("default"):
                found.append(one.names[0])
    return found


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
