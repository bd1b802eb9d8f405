"""The tables of the shards of a database, and the statements that write them.

One row of `shard` per shard decides who may write: each batch, and each renewal of a lease, updates
it on condition of the epoch, or writes nothing.  Its beat grows by a random step each time: after a
failover that lost a beat, a standby that saw it must not take the next one for the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.errors import StoreError
from enact_dist.link.postgres.address import StandbyFigures

if TYPE_CHECKING:
    from enact_dist.link.postgres.connection import DatabaseSession

FORMAT: Final = 1
"""Format of the tables; the rows in them have that of `link.folder.lock`."""
_MAKE: Final = """
CREATE SCHEMA IF NOT EXISTS enact;
CREATE TABLE IF NOT EXISTS enact.shard (
    id int GENERATED ALWAYS AS IDENTITY UNIQUE, cell text NOT NULL, name text NOT NULL,
    format int NOT NULL, epoch bigint NOT NULL, batch bigint NOT NULL, beat bigint NOT NULL,
    holder text NOT NULL, PRIMARY KEY (cell, name)
) WITH (fillfactor = 10, autovacuum_vacuum_scale_factor = 0.02);
CREATE TABLE IF NOT EXISTS enact.record (
    shard int NOT NULL, id bigint NOT NULL, kind smallint NOT NULL, batch bigint NOT NULL,
    key bytea NOT NULL, body bytea NOT NULL, crc bigint NOT NULL, PRIMARY KEY (shard, id)
) WITH (fillfactor = 60, autovacuum_vacuum_scale_factor = 0.02);
CREATE TABLE IF NOT EXISTS enact.body (
    shard int NOT NULL, name text NOT NULL, part int NOT NULL, data bytea NOT NULL,
    PRIMARY KEY (shard, name, part)
) WITH (autovacuum_vacuum_scale_factor = 0.02);
ALTER TABLE enact.record ALTER body SET STORAGE EXTERNAL;
ALTER TABLE enact.body ALTER data SET STORAGE EXTERNAL;
"""
MISSING: Final = """
SELECT array_agg(name) FROM unnest(ARRAY['enact.shard', 'enact.record', 'enact.body']) AS name
WHERE to_regclass(name) IS NULL
"""
"""Names the tables that are not there."""
WITHOUT_ROW: Final = """
WITH RECURSIVE found(shard) AS (
    SELECT min(shard) FROM enact.record
    UNION ALL
    SELECT (SELECT min(shard) FROM enact.record WHERE shard > found.shard) FROM found
    WHERE shard IS NOT NULL
)
SELECT count(*) FROM found WHERE shard IS NOT NULL AND shard NOT IN (SELECT id FROM enact.shard)
"""
"""Counts shards that have data and no row of their own; looks once per shard into the index."""
STATE: Final = "SELECT id, format, epoch, batch, beat, holder FROM enact.shard"
_ONE: Final = " WHERE cell = %b AND name = %b"
FENCE: Final = """
UPDATE enact.shard SET epoch = %b, beat = beat + 1 + (random() * 1e9)::bigint, holder = %b
WHERE id = %b RETURNING epoch
"""
RENEW: Final = """
UPDATE enact.shard SET beat = beat + 1 + (random() * 1e9)::bigint
WHERE id = %b AND epoch = %b RETURNING holder
"""
RESIGN: Final = """
UPDATE enact.shard SET beat = beat + 1 + (random() * 1e9)::bigint,
    holder = CASE strpos(holder, '>') WHEN 0 THEN '' ELSE substr(holder, strpos(holder, '>')) END
WHERE id = %b AND epoch = %b RETURNING beat
"""
"""Gives a shard back: to any standby, or to the one that it was asked for."""
MOVE: Final = """
UPDATE enact.shard SET holder = %s WHERE cell = %s AND name = %s AND epoch = %s AND holder = %s
RETURNING epoch
"""
FILL: Final = "UPDATE enact.shard SET batch = %b WHERE id = %b RETURNING batch"
CLOCK: Final = "SELECT extract(epoch FROM clock_timestamp())::bigint"
RAISE: Final = """
UPDATE enact.shard SET epoch = %b, beat = beat + 1 + (random() * 1e9)::bigint, holder = ''
WHERE id = %b RETURNING epoch
"""
REACHED: Final = "SELECT epoch, batch FROM enact.shard WHERE id = %b"
WRITE: Final = """
WITH fence AS (
    UPDATE enact.shard SET batch = %b, beat = beat + 1 + (random() * 1e9)::bigint
    WHERE id = %b AND epoch = %b AND batch = %b RETURNING id
), gone AS (
    DELETE FROM enact.record USING fence
    WHERE record.shard = fence.id AND record.id = ANY(%b::bigint[])
), unnamed AS (
    DELETE FROM enact.body USING fence
    WHERE body.shard = fence.id AND body.name = ANY(%b::text[])
), put AS (
    INSERT INTO enact.record
    SELECT fence.id, r.* FROM fence, unnest(
        %b::bigint[], %b::bigint[], %b::bigint[], %b::bytea[], %b::bytea[], %b::bigint[]
    ) AS r
    ON CONFLICT (shard, id) DO UPDATE SET kind = excluded.kind, batch = excluded.batch,
        key = excluded.key, body = excluded.body, crc = excluded.crc
)
SELECT 1 / count(*) FROM fence
"""
"""A batch.  Without its row of the fence it divides by zero, which undoes the transaction."""
PUT_BODY: Final = """
INSERT INTO enact.body SELECT %b, %b, %b + r.part, r.data
FROM unnest(%b::bytea[]) WITH ORDINALITY AS r(data, part)
ON CONFLICT DO NOTHING
"""
"""Names are never used twice, so parts that are there are those of an earlier try."""
ROWS: Final = """
SELECT id, kind, batch, key, body, crc FROM enact.record WHERE shard = %b ORDER BY id
"""
NEWER: Final = """
SELECT id, kind, batch, key, body, crc FROM enact.record WHERE shard = %b AND batch > %b
"""
LISTED: Final = "SELECT id, batch, crc FROM enact.record WHERE shard = %b"
THESE: Final = """
SELECT id, kind, batch, key, body, crc
FROM unnest(%b::bigint[]) AS wanted(id) JOIN enact.record USING (id) WHERE shard = %b
"""
BODIES: Final = "SELECT name, data FROM enact.body WHERE shard = %b ORDER BY name, part"
COPIES: Final = """
SELECT application_name, sync_state, state FROM pg_stat_replication ORDER BY application_name
"""
COUNT_COPIES: Final = """
SELECT CASE WHEN count(*) > 0 AND count(sync_state) = 0 THEN -1
    ELSE count(*) FILTER (WHERE sync_state IN ('sync', 'quorum')) END
FROM pg_stat_replication
"""
"""Counts the standbys that confirm each commit; -1: this user cannot see what they do."""
SHARDS: Final = """
SELECT id, name, epoch, batch, beat, holder FROM enact.shard WHERE cell = %b ORDER BY name
"""
ERASE: Final = """
WITH gone AS (DELETE FROM enact.shard WHERE id = %b RETURNING id),
    rows AS (DELETE FROM enact.record USING gone WHERE shard = gone.id RETURNING 1),
    parts AS (DELETE FROM enact.body USING gone WHERE shard = gone.id)
SELECT count(*) FROM rows
"""
NAME_ME: Final = "SELECT set_config('application_name', %s, false)"
STANDBYS: Final = """
SELECT application_name FROM pg_stat_activity WHERE datname = current_database()
    AND application_name ~ '^enact-standby/[0-9.]+/'
ORDER BY backend_start
"""


def name_of_standby(shard: int, who: str, figures: StandbyFigures) -> str:
    """Return the name under which a standby's connection stands in `STANDBYS`."""
    counted = ".".join(map(str, (shard, *figures))) if any(figures) else str(shard)
    return f"enact-standby/{counted}/{who}"


def read_standby(name: str) -> tuple[int, str, StandbyFigures]:
    """Return the shard, process and figures that `name_of_standby` has put into a name."""
    _, counted, who = name.split("/", 2)
    shard, *figures = map(int, counted.split("."))
    return shard, who, StandbyFigures(*figures)


def state_of_shard(cell: str, shard: str) -> tuple[str, tuple[str, str]]:
    """Return the statement that reads a shard's row, and its values."""
    return STATE + _ONE, (cell, shard)


def make_tables(session: DatabaseSession, cell: str, shard: str) -> None:
    """Make the tables and the shard's row, unless they are there.

    Raises:
        StoreError: The tables are of another format, or rows of shards are missing.
        psycopg.Error: As the database reports it; this user may not make them.
    """
    connection = session.connection
    missing = session.row(MISSING)
    statement, values = state_of_shard(cell, shard)
    found = session.row(statement, values) if missing == (None,) else None
    if found is None:
        with connection.transaction():
            connection.execute("SELECT pg_advisory_xact_lock(4711)")
            if missing != (None,):
                connection.execute(_MAKE, prepare=False)
            if (lacking := (session.row(WITHOUT_ROW) or (0,))[0]) > 0:
                raise StoreError(
                    f"shard {shard} of cell {cell} has no row in table enact.shard, and nor have"
                    f" {lacking} shards with data in enact.record: one of them may be this one;"
                    " restore the database from a backup (pg_restore), or delete the rows of"
                    " enact.record whose shard has none in enact.shard, and the shard begins empty"
                )
            connection.execute(
                "INSERT INTO enact.shard (cell, name, format, epoch, batch, beat, holder)"
                " VALUES (%s, %s, %s, 0, 0, 0, '') ON CONFLICT DO NOTHING",
                (cell, shard, FORMAT),
            )
        session.check()
    elif found[1] != FORMAT:
        raise StoreError(
            f"the tables of shard {shard} have format {found[1]}, this program reads {FORMAT}:"
            " start the version of enact-dist that wrote them"
        )
