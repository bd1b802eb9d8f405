"""The keys of a cell in its `cell.toml`: a locked door for every shard, or for none."""

from pathlib import Path

import pytest

from enact_dist.config.environment import security_of
from enact_dist.config.read import parse_config
from enact_dist.config.rights import SecurityConfig
from enact_dist.errors import ConfigError

SHARD = 'name = "c"\n[shards.left]\nlisten = "{}"\n'
KEYS = '[security]\nkeys = "keys"\n'


def read(text, **environment):
    return parse_config(text, Path("/cell/cell.toml"), environment=environment)


def test_key_folder_is_relative_to_the_file():
    """So that a file and its keys are copied together."""
    config = read(SHARD.format("tls/127.0.0.1:7447") + KEYS + 'operators = ["ada"]\n')

    assert config.security == SecurityConfig(Path("/cell/keys"), ("ada",))
    assert config.shard("left").listen == ("tls/127.0.0.1:7447",)


def test_variable_names_the_key_folder_of_a_host():
    """It replaces the file's, and does where the file has none."""
    text = SHARD.format("tls/127.0.0.1:7447")

    assert read(text, ENACT_KEYS="/mine").security.keys == Path("/mine")
    assert read(text + KEYS, ENACT_KEYS="/mine").security.keys == Path("/mine")
    assert security_of({"ENACT_KEYS": "/mine"}, "tls/h:1").keys == Path("/mine")
    assert security_of({"ENACT_KEYS": "/mine"}, "tcp/h:1").keys is None


def test_cell_without_keys_has_none():
    """Nothing changes for it."""
    assert read(SHARD.format("tcp/127.0.0.1:7447")).security == SecurityConfig()


@pytest.mark.parametrize(
    ("text", "environment", "said"),
    [
        (SHARD.format("tls/127.0.0.1:1"), {}, r"line 3: tls/127.0.0.1:1 of shard left needs keys"),
        (SHARD.format("tcp/h:1") + KEYS, {}, r"line 3: tcp/h:1 .* a door without a lock.*tls/h:1"),
        (
            SHARD.format("tls/0.0.0.0:1") + 'advertise = "tcp/h:1"\n' + KEYS,
            {},
            r"line 4: tcp/h:1 .* a door without a lock",
        ),
        (SHARD.format("tls/0.0.0.0:1") + KEYS, {}, r"line 3: no client can connect to tls/0.0.0.0"),
        (
            SHARD.format("tls/h:1") + KEYS,
            {"ENACT_SHARD_LEFT_LISTEN": "tls/h:1,tcp/h:2"},
            r"tcp/h:2 .* a door without a lock",
        ),
        (SHARD.format("tcp/h:1"), {"ENACT_KEYS": "/k"}, r"a door without a lock"),
        ('security = "keys"\n' + SHARD.format("tcp/h:1"), {}, r"line 1: 'security' is a table"),
        (SHARD.format("tls/h:1") + '[security]\nkeys = ""\n', {}, r"line 5: 'keys'"),
        (SHARD.format("tls/h:1") + '[security]\nkey = "k"\n', {}, r"line 5: .*did you mean 'keys'"),
        (SHARD.format("tls/h:1") + KEYS + 'operators = ["a/b"]\n', {}, r"line 6: .*a/b"),
        (SHARD.format("quic/h:1") + KEYS, {}, r"quic/h:1' is no endpoint"),
        (SHARD.format("tls/h:1"), {"ENACT_KEY": "/k"}, r"did you mean ENACT_KEYS\?"),
    ],
)
def test_door_that_does_not_fit_is_refused(text, environment, said):
    """With the line, and what to write."""
    with pytest.raises(ConfigError, match=said):
        read(text, **environment)
