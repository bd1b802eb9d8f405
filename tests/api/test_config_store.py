"""`store` of a cell.toml: the database that keeps the data of all shards, in place of folders."""

from pathlib import Path

import pytest

from enact_dist.config.read import parse_config
from enact_dist.errors import ConfigError

FILE = Path("/cells/demo/cell.toml")
SHARD = '[shards.left]\nlisten = "tcp/127.0.0.1:7447"\n'
URL = "postgresql://enact@db1,db2/cell"


def parsed(text, **environment):
    return parse_config(text, FILE, environment=environment, shown="cell.toml")


def test_a_store_in_a_database_takes_the_place_of_folders():
    """From the file or from a variable, which may hold the password."""
    config = parsed(f'name = "c"\nstore = "{URL}"\nlease_s = 3\n{SHARD}')
    assert (config.store, config.lease_s, config.shard("left").folder) == (URL, 3.0, None)
    secret = "postgres://enact:secret@db/cell"
    assert parsed(f'name = "c"\nstore = "{URL}"\n{SHARD}', ENACT_STORE=secret).store == secret
    assert parsed(f'name = "c"\n{SHARD}', ENACT_STORE=secret).store == secret
    assert parsed(f'name = "c"\n{SHARD}').store == ""


@pytest.mark.parametrize(
    ("text", "environment", "line", "problem"),
    [
        (f'name = "c"\nstore = "{URL}"\ndata_folder = "d"\n{SHARD}', {}, 3, "data_folder = .*exclude"),
        (f'name = "c"\nstore = "{URL}"\n{SHARD}folder = "d"\n', {}, 5, "folder = .*exclude"),
        (f'name = "c"\ndata_folder = "d"\n{SHARD}', {"ENACT_STORE": URL}, 2, "ENACT_STORE"),
        (f'name = "c"\nstore = "{URL}"\n{SHARD}', {"ENACT_DATA_FOLDER": "d"}, 1, "exclude"),
        (f'name = "c"\nstore = "mysql://x"\n{SHARD}', {}, 2, "write postgresql://"),
        (f'name = "c"\nlease_s = 0.1\n{SHARD}', {}, 2, "lease_s"),
    ],
)  # fmt: skip
def test_a_store_beside_a_folder_is_refused_with_its_line(text, environment, line, problem):
    """A shard has its data in one place."""
    with pytest.raises(ConfigError, match=problem) as refused:
        parsed(text, **environment)
    assert refused.value.line == line
