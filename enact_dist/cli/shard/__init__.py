"""`enact shard`: the table of its verbs; the modules beside carry them out."""

from __future__ import annotations

from typing import Final

from enact_dist.cli.arguments import (
    CELL_FILE,
    JSON,
    LOG,
    READER,
    address,
    duration,
    endpoints,
    file_of,
    pair,
)
from enact_dist.cli.verbs import OneOf, Option, Verb, flag, many, option
from enact_dist.link.daemon.counters import BODIES

CHECK_S: Final = 2.0
"""How long a health check waits: it is called every few seconds, and a local answer takes 1 ms."""

MOVE_S: Final = 20.0
"""How long a hand-over may take, with the drain of the daemon that serves."""
_NAME: Final = option("name", "NAME", "name of the shard in cell.toml")
_FOLDER: Final = file_of("--folder", "DIR", "folder of the shard, unless it is that of cell.toml")

_DATABASE: Final = option(
    "--store", "URL", "the database (default: `store` of cell.toml); only this command uses it"
)


def _path(name: str, text: str) -> Option:
    return file_of(name, "DIR", text, dest="path", required=True)


def _store(text: str) -> Option:
    return many("--store", "NAME=PATH", text, type=pair)


VERBS: Final = (
    Verb(
        "run", "run one shard daemon of the cell until SIGTERM", "shard:run_shard",
        "enact shard run left --cell cell.toml\n"
        "enact shard run left --cell cell.toml --standby",
        (
            _NAME,
            CELL_FILE,
            many("--listen", "ENDPOINT", "replaces `listen` of cell.toml", type=endpoints),
            many("--advertise", "ENDPOINT", "replaces `advertise`", type=endpoints),
            option("--folder", "DIR", "replaces `folder` of cell.toml"),
            option("--store", "URL",
                   "replaces `store`: the database that keeps the data of all shards"),
            flag("--standby",
                 "in a cell with a store: wait until no other daemon serves the shard, then take"
                 " over"),
            option("--metrics", "HOST:PORT",
                   "serve /metrics for Prometheus there; a port alone is one of the loopback",
                   type=address),
            LOG,
            option("--drain", "S",
                   "seconds that holders of locks may still finish after SIGTERM (default:"
                   " `drain_s` of cell.toml, or 0.8)", dest="drain_s", type=duration),
        ),
    ),
    Verb(
        "ls",
        f"list the shards of the cell and their states; data: bytes of {BODIES}",
        "shard:list_shards",
        "enact shard ls --cell tcp/127.0.0.1:7447",
        (flag("--counters", "list the counters of each shard, and of this command's connection to"
              " them, and what they mean"), *READER),
        columns=("shard", "endpoint", "state", "epoch", "up", "slots", "data", "shared", "sessions",
                 "locks", "rtt"),
        empty="no shards",
    ),
    Verb(
        "check", "ask shards whether they are ready, or alive; made to be called every few seconds",
        "shard:check_shards",
        "enact shard check left --cell cell.toml --alive\n"
        "enact shard check --cell tcp/127.0.0.1:7447 --json",
        (
            option("name", "NAME", "name of the shard (default: each one of the cell)", nargs="?"),
            OneOf((
                flag("--ready", "check that it answers and grants locks (the default)"),
                flag("--alive", "check that it answers"),
            )),
            *READER,
        ),
        defaults={"timeout_s": CHECK_S},
    ),
    Verb(
        "reload",
        "let running shards of this host take keys, names and rights anew; sessions and locks stay",
        "reload:reload_shards",
        "enact shard reload left --cell cell.toml\nenact shard reload --all",
        (
            option("name", "NAME", "name of the shard", nargs="?"),
            flag("--all", "all shards of this host"),
            CELL_FILE,
            JSON,
        ),
        page="security",
    ),
    Verb(
        "move",
        "in a cell with a store: let the daemon that serves a shard hand it over to a standby, and"
        " stand by itself",
        "move:move_shard",
        "enact shard move left --to cell-b --cell cell.toml",
        (
            _NAME,
            option("--to", "HOST", "the host of the standby; with a space and its process number if"
                   " it has several", required=True),
            *READER,
        ),
        defaults={"timeout_s": MOVE_S},
        page="surviving",
    ),
    Verb(
        "rebalance", "move entities to where cell.toml places them, while the cell is stopped",
        "rebalance:run_rebalance",
        "enact shard rebalance --cell cell.toml --new third --dry-run\n"
        "enact shard rebalance --cell cell.toml --store right=/mnt/copy/right\n"
        "enact shard rebalance --cell cell.toml --store gone=data/gone",
        (
            CELL_FILE,
            _store("folder of a shard: a copy of one on another host, or of one that leaves the"
                   " cell; not in a cell with a database, where all are found"),
            many("--new", "NAME", "this shard is new: it is no mistake that it has no data yet",
                 default=[]),
            flag("--dry-run", "list what would move, change nothing"),
            JSON,
        ),
    ),
    Verb(
        "forget",
        "delete aspects with their types and all their data, while the cell is stopped; then they"
        " may be registered with other types",
        "forget:run_forget",
        "enact shard forget surface --cell cell.toml\n"
        "enact shard forget surface contact_count --cell cell.toml --yes\n"
        "enact shard forget --unused --cell cell.toml --dry-run",
        (
            option("aspects", "ASPECT", "name of an aspect", nargs="*"),
            flag("--unused",
                 "delete all aspects and world contexts without data, except forks and those that"
                 " cell.toml names"),
            CELL_FILE,
            _store("folder of a shard that is not where the cell.toml says"),
            many("--shard", "NAME",
                 "only this one: it was restored from a backup that has the aspect as it was",
                 default=[]),
            OneOf((
                flag("--dry-run", "list what would be deleted, change nothing (status 0)"),
                flag("--yes",
                     "delete it; without this option the command only lists it, with status 1 where"
                     " there is anything"),
            )),
            JSON,
        ),
    ),
    Verb(
        "backup", "copy the data of a shard on this host to a new folder, whether it runs or not",
        "backup:run_backup",
        "enact shard backup left --to backups/left-1 --cell cell.toml",
        (_NAME, _path("--to", "a folder that does not exist yet"), _FOLDER, CELL_FILE, JSON),
    ),
    Verb(
        "restore", "let a stopped shard start again with what a backup holds", "backup:run_restore",
        "enact shard restore left --from backups/left-1 --replace --cell cell.toml",
        (
            _NAME,
            _path("--from", "the folder of the backup"),
            _FOLDER,
            CELL_FILE,
            JSON,
            flag("--replace", "move the present folder aside, beside it"),
        ),
    ),
    Verb(
        "restored",
        "after the database of a stopped cell went back to an earlier moment: begin new epochs",
        "store:run_restored",
        "enact shard restored --cell cell.toml\n"
        "enact shard restored left right --cell cell.toml --json",
        (
            option("shards", "SHARD", "name of a shard (default: all that the database has)",
                   nargs="*"),
            flag("--fence", "take shards from daemons that still serve them; those daemons end"),
            CELL_FILE,
            JSON,
        ),
        columns=("shard", "epoch before", "epoch now", "newest batch", "was held by"),
        page="surviving",
    ),
    Verb(
        "export-store", "copy a stopped shard from the database to a new folder",
        "store:run_export",
        "enact shard export-store left data/left --cell cell.toml\n"
        "enact shard export-store left data/left --store postgresql://enact@db1,db2/cell",
        (
            _NAME,
            file_of("path", "FOLDER", "a folder that does not exist yet"),
            _DATABASE,
            CELL_FILE,
            JSON,
        ),
        page="surviving",
    ),
    Verb(
        "import-store",
        "copy a stopped shard from its folder to a database that has no data of it",
        "store:run_import",
        "enact shard import-store left data/left --cell cell.toml\n"
        "enact shard import-store left data/left --store postgresql://enact@db1,db2/cell",
        (
            _NAME,
            file_of("path", "FOLDER", "the folder of the shard"),
            _DATABASE,
            CELL_FILE,
            JSON,
        ),
        page="surviving",
    ),
    Verb(
        "erase", "delete all that the database has of stopped shards", "store:run_erase",
        "enact shard erase left --cell cell.toml\n"
        "enact shard erase left --yes --cell cell.toml",
        (
            option("shards", "SHARD", "name of a shard (default: all that the database has)",
                   nargs="*"),
            flag("--yes", "delete it; without this option the command lists it, with status 1"),
            CELL_FILE,
            JSON,
        ),
        columns=("shard", "epoch", "newest batch", "rows"),
        page="surviving",
    ),
)  # fmt: skip
