"""Commands in a cell whose data are in a database: what works on folders says so, by name."""

import pytest

from enact_dist.cli.main import main

URL = "postgresql://enact:secret@127.0.0.1:9/cell"


@pytest.fixture
def cell(tmp_path):
    file = tmp_path / "cell.toml"
    file.write_text(f'name = "c"\nstore = "{URL}"\n[shards.left]\nlisten = "tcp/127.0.0.1:7447"\n')
    return str(file)


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["backup", "left", "--to", "x"], "pg_dump"),
        (["restore", "left", "--from", "x"], "pg_restore"),
        (["rebalance", "--store", "left=x"], "all shards are found there"),
        (["forget", "pose", "--store", "left=x"], "all shards are found there"),
    ],
)
def test_commands_for_folders_refuse_a_database(cell, capsys, words, found):
    """They name the database, without its password, and what to do instead."""
    pytest.importorskip("psycopg")
    assert main(["shard", *words, "--cell", cell]) == 2
    said = capsys.readouterr().err
    assert found in said
    assert "postgresql://enact@127.0.0.1:9/cell" in said
    assert "secret" not in said


def test_a_standby_needs_a_database(tmp_path, capsys):
    """Two daemons of a shard with a folder would be two shards."""
    file = tmp_path / "cell.toml"
    file.write_text('name = "c"\n[shards.left]\nlisten = "tcp/127.0.0.1:7447"\n')
    assert main(["shard", "run", "left", "--standby", "--cell", str(file)]) == 2
    assert "--standby needs a database" in capsys.readouterr().err
