"""`enact world`: the table of its verbs; the modules beside carry them out."""

from __future__ import annotations

from typing import Final

from enact_dist.cli.arguments import (
    ASPECTS,
    COMPRESSIONS,
    PATTERN,
    READER,
    SLOT,
    WORLD,
    counted,
    entities,
    pair,
    seconds_of,
    slot_version,
    tolerance,
    world_name,
)
from enact_dist.cli.text.rates import WINDOW_S
from enact_dist.cli.text.times import MOMENT_HELP, moment
from enact_dist.cli.verbs import CHANGES, LOOKS, OneOf, Option, Verb, flag, many, option


def _at(name: str, text: str) -> Option:
    return option(name, "TIME", text, type=moment)


VERBS: Final = (
    Verb(
        "ls", "list the world contexts of the cell", "contents:list_worlds",
        "enact world ls",
        READER,
        cell=LOOKS,
        columns=("world", "entities", "data", "size", "fork of"),
        empty="the cell has no world context",
    ),
    Verb(
        "aspects",
        "list the registered aspects: types, durability, retention, and how many slots there are",
        "contents:list_aspects",
        "enact world aspects\nenact world aspects online --json",
        (
            option("world", "WORLD", "count slots of this world context only (default: of all)",
                   nargs="?", default=""),
            *READER,
        ),
        cell=LOOKS,
        columns=("aspect", "slots", "data", "size", "durability", "retained", "shards", "type"),
        empty="the cell knows no aspect",
        page="data",
    ),
    Verb(
        "tree", "show the entities of a world context with their aspects", "contents:show_tree",
        "enact world tree online 'tray/**'",
        (WORLD, PATTERN, flag("--null", "also show slots without a datum"), *READER),
        cell=LOOKS,
    ),
    Verb(
        "get", "print or save one datum, as last committed", "contents:get_datum",
        "enact world get online system/deviation\n"
        "enact world get training product/surface --out surface.npz",
        (
            WORLD,
            SLOT,
            option("--out", "FILE", "save it: .npz (arrays), .npy (one array) or .json (the rest)"),
            *READER,
        ),
        cell=LOOKS,
    ),
    Verb(
        "put", "set one datum under a lock, checked by its aspect's type", "contents:put_datum",
        "enact world put online work_bench/contact_count 3\n"
        "enact world put online camera/intrinsics @intrinsics.npy",
        (
            WORLD,
            SLOT,
            option("value", "VALUE", "JSON literal (null deletes), or @FILE: .npy, .json or raw"),
            flag("--new", "register the aspect, if unknown, by the value's type"),
            seconds_of("--wait", "how long to wait for the lock (default: 10)", 10.0),
            *READER,
        ),
        cell=CHANGES,
    ),
    Verb(
        "create", "make a world context, unless the cell has it", "contents:create_world",
        "enact world create planning",
        (option("world", "NAME", "name of the world context", type=world_name), *READER),
        cell=CHANGES,
    ),
    Verb(
        "watch", "print the present data, then every change, until Ctrl-C", "watch:watch_world",
        "enact world watch online 'tray/**' --aspect surface\n"
        "enact world watch online robot --data\n"
        "enact world watch online 'camera/*' --stats --seconds 10",
        (
            WORLD,
            PATTERN,
            many("--aspect", "NAME", "watch only these aspects, from the moment a shard knows them"
                 " (repeatable)"),
            OneOf((
                flag("--data", "also print the data; of large arrays, a summary"),
                flag("--stats", "print rate, period, jitter, delay since capture, size and"
                     f" bandwidth of each datum over the last {WINDOW_S:.0f} s, and at the end over"
                     " the whole run"),
            )),
            seconds_of("--every", "how often --stats prints (default: 1)", 1.0),
            seconds_of("--seconds", "leave after S seconds"),
            counted("--count", "leave after N changes"),
            *READER,
        ),
    ),
    Verb(
        "history", "list the versions of a datum that are still known", "time:show_history",
        "enact world history online system/deviation\n"
        "enact world history online system/deviation --since -5min --count 20",
        (
            WORLD,
            SLOT,
            counted("--count", "only the newest N"),
            _at("--since", "only versions that were current after this moment"),
            *READER,
        ),
        cell=LOOKS,
        columns=("version", "time", "age", "size", "actor", "position", ""),
        page="time",
    ),
    Verb(
        "at", "show a world context as it was", "time:show_past",
        "enact world at online -30s\n"
        "enact world at online 2026-11-21T10:00:00 tree 'tray/**'\n"
        "enact world at online -30s get system/deviation --json",
        (
            WORLD,
            _at("moment", MOMENT_HELP),
            option("what", None, "what to show (default: tree)", nargs="?", choices=("tree", "get"),
                   default="tree"),
            option("name", "NAME", "a pattern of entities (default: all), or ENTITY/ASPECT for get",
                   nargs="?"),
            option("--out", "FILE", "save a datum: .npz (arrays), .npy (one array) or .json"),
            *READER,
        ),
        page="time",
    ),
    Verb(
        "fork", "make another world context with the data of one", "time:fork_world",
        "enact world fork online what_if\n"
        "enact world fork online what_if --at -30s",
        (
            WORLD,
            option("name", "NAME", "name of the new world context"),
            _at("--at", f"copy the context as of {MOMENT_HELP}"),
            *READER,
        ),
        cell=CHANGES,
        page="time",
    ),
    Verb(
        "drop", "delete a world context with all its data and their history", "time:drop_world",
        "enact world drop what_if",
        (WORLD, *READER),
        cell=CHANGES,
        page="time",
    ),
    Verb(
        "pin", "pin versions under a label: they outlive their retention", "time:pin_versions",
        "enact world pin drop-17 online tray/package/3/surface@12 system/deviation",
        (
            option("label", "LABEL", "the name by which unpin releases them"),
            WORLD,
            option("slots", "ENTITY/ASPECT[@VERSION]",
                   "which versions; of a slot the newest unless one is named",
                   nargs="+", type=slot_version),
            *READER,
        ),
        cell=CHANGES,
        page="time",
    ),
    Verb(
        "pinned", "list the pinned versions by label", "time:list_pinned",
        "enact world pinned",
        READER,
        cell=LOOKS,
        columns=("label", "datum", "version", "time", "age", "size"),
        empty="no version is pinned",
        page="time",
    ),
    Verb(
        "unpin", "release the versions that are pinned under a label", "time:unpin_label",
        "enact world unpin drop-17",
        (option("label", "LABEL", "as `enact world pinned` lists it"), *READER),
        cell=CHANGES,
        page="time",
    ),
    Verb(
        "diff", "compare two world contexts: exit 0 if equal, 4 if they differ", "diff:show_diff",
        "enact world diff training online\n"
        "enact world diff online what_if 'tray/**' --aspect surface\n"
        "enact world diff online online --at1 -30s --tolerance shift_mm=0.5",
        (
            option("left", "WORLD1", "name of a world context"),
            option("right", "WORLD2", "another one, or the same at another time"),
            option("entities", "PATTERN", "only entities whose names match (default: all)",
                   nargs="?", type=entities, default="**"),
            ASPECTS,
            _at("--at1", f"compare the first as of {MOMENT_HELP}"),
            _at("--at2", "compare the second as of a moment, likewise"),
            many("--tolerance", "[ASPECT=]X",
                 "how far numbers may be apart, in their unit, or in percent of the larger (1%%);"
                 " this overrides cell.toml; without ASPECT it holds for every aspect that"
                 " has no tolerance of its own", type=tolerance, default=[]),
            flag("--all", "list every slot that only one side has"),
            flag("--trust",
                 "run every module that a `compare` in cell.toml names, not only those in the"
                 " packages of the cell's actors (caution: this runs code that cell.toml chooses)"),
            *READER,
        ),
        columns=("entity", "aspect", "difference"),
        page="time",
    ),
    Verb(
        "export", "write one world context, all of one moment, into a file or folder",
        "export:export_world",
        "enact world export online --out online.mcap\n"
        "enact world export training --at -10min --out training/",
        (
            WORLD,
            option("--out", "FILE|FOLDER", "a new FILE.mcap, or a new folder", required=True),
            _at("--at", f"write the context as of {MOMENT_HELP}"),
            many("--shows", "ASPECT=KIND", "as for enact record", type=pair),
            option("--compress", None, "compression of an .mcap file (default: zstd)",
                   choices=COMPRESSIONS, default="zstd"),
            *READER,
        ),
        cell=LOOKS,
        page="recordings",
    ),
)  # fmt: skip
