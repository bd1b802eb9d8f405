"""`load_config`: what a cell.toml says, and every way in which it can be wrong."""

from pathlib import Path

import pytest

from enact_dist.config.environment import setting_of
from enact_dist.config.read import load_config, parse_config
from enact_dist.core.protocol.messages import AspectEntry, Pin, ShardEntry
from enact_dist.errors import ConfigError
from enact_dist.terms import Durability, Retention
from enact_dist.world.connecting import _known_of

FILE = Path("/cells/demo/cell.toml")

FULL = """\
# a cell with everything
name = "palletizing"
worlds = ["training", "online"]
session_ttl_s = 3
data_folder = "data"
carrier = "zenoh"

[shards.left]
listen = "tcp/127.0.0.1:7447"

[shards.right]
listen = ["tcp/0.0.0.0:7448", "tcp/127.0.0.1:7449"]
advertise = "tcp/tray-pc:7448"
folder = "/srv/right"
host = "tray-pc"
drain_s = 10

[[pins]]
entities = "tray/**"
shard = "right"

[[pins]]
entities = "system"
shard = "left"

[aspects.depth]
durability = "volatile"
retention = 8

[aspects.flags]
compare = "vocabulary.flags:FLAGS"

[actors.fusion]
class = "actors.palletizing.fusion:Fusion"
worlds = { training = "training", now = "online" }
options = { voxel_m = 0.002, names = ["a", "b"] }
every_s = 0.5
host = "tray-pc"
entity = "view/1"
"""

SHARD = '[shards.left]\nlisten = "tcp/127.0.0.1:7447"\n'


def parsed(text, **environment):
    return parse_config(text, FILE, environment=environment, shown="cell.toml")


def refused(text, **environment):
    with pytest.raises(ConfigError) as caught:
        parsed(text, **environment)
    return caught.value


def test_what_an_aspect_shows_is_read_with_its_frames():
    """One kind or several, a frame for all entities or one per pattern."""
    text = MINIMAL_SHOWS.format(
        'shows = ["image", "transform"]\nparent = "tray"\nframe = { "view/*" = "{entity}" }'
    )
    (aspect,) = parse_config(text, Path("cell.toml"), environment={}).aspects
    assert aspect.shows.kinds == ("image", "transform")
    assert aspect.shows.frame_of("view/3") == "view/3"
    assert aspect.shows.parent_of("view/3") == "tray"


def test_what_voxels_and_joints_are_is_read():
    """What their data leave open: size and place of a grid, names of joints."""
    text = MINIMAL_SHOWS.format(
        'shows = ["voxels", "joints", "transform"]\nvoxel_m = 0.025\norigin_m = [-3.6, 0, 1]\n'
        'joints = ["base", "tip"]\nparent = "cell"\ninverse = true'
    )
    shows = parse_config(text, Path("cell.toml"), environment={}).aspects[0].shows
    assert (shows.voxel_m, shows.origin_m) == (0.025, (-3.6, 0.0, 1.0))
    assert (shows.joints, shows.inverse) == (("base", "tip"), True)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ('shows = "film"', "line 5.*film.*known: image"),
        ('shows = "transform"', "line 5.*parent"),
        ('show = "image"', "line 5.*did you mean"),
        ('shows = "pose"\nframe = "{x}"', "names no frame"),
        ('shows = "voxels"\norigin_m = [0.0, 1.0]', "line 5.*three numbers"),
        ('shows = "voxels"\norigin_m = [0.0, "1"]', "line 6.*an array of numbers"),
        ('shows = "transform"\nparent = "a"\ninverse = 1', "line 7.*a boolean"),
    ],
)
def test_what_an_aspect_cannot_show_is_refused(words, said):
    """With its line, and what it may be."""
    with pytest.raises(ConfigError, match=said):
        parse_config(MINIMAL_SHOWS.format(words), Path("cell.toml"), environment={})


MINIMAL_SHOWS = """\
name = "c"
[shards.s]
listen = "tcp/127.0.0.1:7447"
[aspects.seen]
{}
"""


def test_config_holds_every_key_when_the_file_gives_all():
    """Each key of the table in the module docstring arrives in its field."""
    config = parsed(FULL)

    left, right = config.shards
    (fusion,) = config.actors
    assert (config.name, config.worlds, config.ttl_s) == (
        "palletizing", ("training", "online"), 3.0
    )  # fmt: skip
    assert (config.carrier, config.ttl_ns) == ("zenoh", 3_000_000_000)
    assert (left.listen, left.advertise) == (("tcp/127.0.0.1:7447",),) * 2
    assert left.folder == Path("/cells/demo/data/left")
    assert right.listen == ("tcp/0.0.0.0:7448", "tcp/127.0.0.1:7449")
    assert right.advertise == ("tcp/tray-pc:7448",)
    assert (right.folder, right.host) == (Path("/srv/right"), "tray-pc")
    assert (left.drain_s, right.drain_s) == (None, 10.0)
    assert config.pins == (Pin("tray/**", "right"), Pin("system", "left"))
    assert [entry.durability for entry in config.aspects] == [
        Durability.VOLATILE, None
    ]  # fmt: skip
    assert [entry.compare for entry in config.aspects] == ["", "vocabulary.flags:FLAGS"]
    assert (fusion.name, fusion.class_path) == ("fusion", "actors.palletizing.fusion:Fusion")
    assert dict(fusion.worlds) == {"training": "training", "now": "online"}
    assert dict(fusion.options) == {"voxel_m": 0.002, "names": ["a", "b"]}
    assert (fusion.every_s, fusion.host, fusion.entity) == (0.5, "tray-pc", "view/1")


def test_config_needs_only_a_name_and_a_shard():
    """A cell of two facts has defaults for the rest, and keeps its data in memory."""
    config = parsed('name = "c"\n' + SHARD)

    assert (config.ttl_s, config.worlds, config.actors, config.pins) == (2.0, (), (), ())
    assert (config.shards[0].folder, config.data_folder) == (None, None)


def test_config_lists_its_aspects_as_catalogue_entries():
    """An aspect of the file lets any type register, and leaves to the actors what it does not say."""
    assert parsed(FULL).aspect_entries() == (
        AspectEntry("depth", "", "volatile", 8),
        AspectEntry("flags", "", ""),
    )


def test_config_bounds_history_by_versions_age_and_bytes():
    """A table says each figure by itself; what it leaves out has no limit."""
    text = 'name = "c"\n' + SHARD + "[aspects.x]\nretention = { versions = 100, age_s = 60 }\n"
    both = parsed(text)
    size = parsed(text.replace("age_s = 60", "size_bytes = 1_000_000"))

    assert both.aspects[0].retention == Retention(versions=100, age_s=60.0)
    assert both.aspect_entries() == (AspectEntry("x", "", "", 100, 60_000_000_000),)
    assert size.aspect_entries() == (AspectEntry("x", "", "", 100, 0, 1_000_000),)


RIG = """
[actors.camera]
class = "rig:Camera"
process = "rig"
env = { GAIN = "1", SIDE = "left" }
drain_s = 3

[actors.alone]
class = "rig:Alone"

[actors.subtraction]
class = "rig:Subtraction"
process = "rig"
env = { GAIN = "1", DEPTH = "8" }
"""


def test_actors_of_one_process_are_found_together():
    """In the order of the file; variables are of the process, the longest drain counts."""
    rig, alone = parsed(f'name = "c"\n{SHARD}{RIG}').processes()

    assert (rig.name, rig.members) == ("rig", ("camera", "subtraction"))
    assert rig.env == {"GAIN": "1", "SIDE": "left", "DEPTH": "8"}
    assert rig.drain_s == 3.0
    assert (alone.name, alone.members, alone.drain_s) == ("alone", ("alone",), None)


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        (
            'GAIN = "1", DEPTH',
            'GAIN = "2", DEPTH',
            r"line \d+: .*share the process 'rig', but env sets GAIN to '1' for one and '2' for the",
        ),
        (
            'Subtraction"',
            'Subtraction"\nhost = "tray-pc"',
            r"share the process 'rig', so their `host` must be the same: 'none', 'tray-pc'",
        ),
        (
            'process = "rig"',
            'process = "alone"',
            r"process 'alone' of actor camera has the name of an actor that runs in another",
        ),
        ('process = "rig"', 'process = "a/b"', "cannot name a process"),
    ],
)
def test_actors_that_cannot_share_a_process_are_refused(before, after, said):
    """Each in one line that names both and what to write."""
    text = f'name = "c"\n{SHARD}{RIG}'

    with pytest.raises(ConfigError, match=said):
        parsed(text.replace(before, after, 1))


def test_placement_map_names_advertised_endpoints_and_pins():
    """The placement map tells clients where shards are reached, not where they listen."""
    placement = parsed(FULL).placement_map()

    assert placement.shards == (
        ShardEntry("left", ("tcp/127.0.0.1:7447",)),
        ShardEntry("right", ("tcp/tray-pc:7448",)),
    )
    assert placement.pins == (Pin("tray/**", "right"), Pin("system", "left"))


def test_placement_version_is_stable_when_only_endpoints_differ():
    """Hosts that reach a shard at different endpoints still agree on the placement."""
    here = parsed(FULL)
    there = parsed(FULL, ENACT_SHARD_LEFT_LISTEN="tcp/10.0.0.7:7447")

    assert here.placement_map().version == there.placement_map().version == 1_160_235_009


@pytest.mark.parametrize(
    ("old", "new"),
    [('shard = "left"', 'shard = "right"'), ("tray/**", "tray/*"), ("[shards.left]", "[shards.a]")],
)
def test_placement_version_changes_when_entities_may_move(old, new):
    """Whatever can move an entity to another shard gives the map another version."""
    changed = FULL.replace(old, new).replace(
        'shard = "left"', 'shard = "a"' if "a]" in new else 'shard = "left"'
    )
    assert parsed(FULL).placement_map().version != parsed(changed).placement_map().version


def test_shard_is_refused_by_name_when_the_cell_has_none():
    """Asking for a shard that does not exist names those that do."""
    with pytest.raises(ConfigError, match="no shard 'middle'; it has left, right"):
        parsed(FULL).shard("middle")


WRONG = {
    "unknown key": ('name = "c"\n' + SHARD + 'lisen = "x"\n', 4, "unknown key 'lisen' in [shards.left]; did you mean 'listen'?"),
    "unknown root key": ('name = "c"\nwordls = []\n' + SHARD, 2, "unknown key 'wordls' in the file; did you mean 'worlds'?"),
    "unknown table": ('name = "c"\n' + SHARD + "\n[aspect.x]\n", 5, "unknown key 'aspect' in the file; did you mean 'aspects'?"),
    "no name": (SHARD, 1, "the file needs the key 'name'"),
    "empty name": ('name = ""\n' + SHARD, 1, "'name' in the file is an empty string"),
    "bad name": ('name = "a/b"\n' + SHARD, 1, "'a/b' cannot name a cell"),
    "name type": ("name = 3\n" + SHARD, 1, "'name' in the file is a string, not an integer (3)"),
    "no shard": ('name = "c"\n', 1, "the cell has no shard"),
    "shards type": ('name = "c"\nshards = 1\n', 2, "'shards' in the file is a table, not an integer (1)"),
    "shard type": ('name = "c"\n[shards]\nleft = 1\n', 3, "'left' in [shards] is a table, not an integer (1)"),
    "shard name": ('name = "c"\n[shards."a b"]\nlisten = "tcp/h:1"\n', 2, "'a b' cannot name a shard"),
    "no listen": ('name = "c"\n\n[shards.left]\nfolder = "f"\n', 3, "[shards.left] needs the key 'listen'"),
    "endpoint": ('name = "c"\n[shards.left]\nlisten = "127.0.0.1:7447"\n', 3, "'127.0.0.1:7447' is no endpoint"),
    "port": ('name = "c"\n[shards.left]\nlisten = "tcp/h:70000"\n', 3, "'tcp/h:70000' is no endpoint"),
    "endpoint type": ('name = "c"\n[shards.left]\nlisten = [\n  "tcp/h:1",\n  7,\n]\n', 5, "an array of strings, not an integer (7)"),
    "wildcard": ('name = "c"\n[shards.left]\nlisten = "tcp/0.0.0.0:7447"\n', 3, "no client can connect to tcp/0.0.0.0:7447"),
    "drain": ('name = "c"\n' + SHARD + "drain_s = -1\n", 4, "'drain_s' in [shards.left] must lie between 0 and 3600, not -1"),
    "same endpoint": ('name = "c"\n' + SHARD + '[shards.right]\nlisten = "tcp/127.0.0.1:7447"\n', 5, "shards left and right share endpoint tcp/127.0.0.1:7447"),
    "same folder": ('name = "c"\n' + SHARD + 'folder = "f"\n[shards.right]\nlisten = "tcp/h:1"\nfolder = "f"\n', 7, "shards left and right share folder /cells/demo/f"),
    "ttl type": ('name = "c"\nsession_ttl_s = true\n' + SHARD, 2, "'session_ttl_s' in the file is a number, not a boolean (True)"),
    "ttl range": ('name = "c"\nsession_ttl_s = 0.01\n' + SHARD, 2, "must lie between 0.2 and 60, not 0.01"),
    "ttl nan": ('name = "c"\nsession_ttl_s = nan\n' + SHARD, 2, "must lie between 0.2 and 60, not nan"),
    "carrier": ('name = "c"\ncarrier = "mqtt"\n' + SHARD, 2, "unknown carrier 'mqtt' (known: auto, zenoh, socket)"),
    "world name": ('name = "c"\nworlds = [\n  "a",\n  "b c",\n]\n' + SHARD, 4, "'b c' cannot name a world context"),
    "world twice": ('name = "c"\nworlds = ["a",\n"a"]\n' + SHARD, 3, "the world context 'a' is listed twice"),
    "worlds type": ('name = "c"\nworlds = {}\n' + SHARD, 2, "'worlds' in the file is an array of strings, not a table ({})"),
    "pin pattern": ('name = "c"\n' + SHARD + '[[pins]]\nentities = "a//b"\nshard = "left"\n', 5, "'a//b' is no pattern of entities"),
    "pin shard": ('name = "c"\n' + SHARD + '[[pins]]\nentities = "a"\nshard = "left"\n[[pins]]\nentities = "b"\nshard = "lef"\n', 9, "unknown shard 'lef'; did you mean 'left'? (known: left)"),
    "pin key": ('name = "c"\n' + SHARD + '[[pins]]\nentity = "a"\n', 5, "unknown key 'entity' in [pins]; did you mean 'entities'?"),
    "pins type": ('name = "c"\n' + SHARD + '[pins]\nshard = "left"\n', 4, "'pins' is an array of tables ([[pins]]), not a table"),
    "pin type": ('name = "c"\npins = [\n1]\n' + SHARD, 3, "'pins' holds tables ([[pins]]), not an integer (1)"),
    "durability": ('name = "c"\n' + SHARD + '[aspects.x]\ndurability = "volatil"\n', 5, "unknown durability 'volatil' in [aspects.x]; did you mean 'volatile'?"),
    "retention": ('name = "c"\n' + SHARD + "[aspects.x]\nretention = 0\n", 5, "versions of a retention is a number from 1 to 100000, not 0"),
    "retention kind": ('name = "c"\n' + SHARD + "[aspects.x]\nretention = true\n", 5, "a retention is a number of versions or Retention(versions, age_s, size_bytes), not True"),
    "retention key": ('name = "c"\n' + SHARD + "[aspects.x]\nretention = { version = 3 }\n", 5, "unknown key 'version' in [aspects.x.retention]; did you mean 'versions'?"),
    "retention age": ('name = "c"\n' + SHARD + "[aspects.x]\nretention = { age_s = 0 }\n", 5, "'age_s' in [aspects.x.retention] must lie between 0.001 and 1e+09, not 0"),
    "retention bytes": ('name = "c"\n' + SHARD + "[aspects.x]\nretention = { size_bytes = 0.5 }\n", 5, "'size_bytes' in [aspects.x.retention] is a whole number above 0, not a float (0.5)"),
    "retention empty": ('name = "c"\n' + SHARD + "[aspects.x]\nretention = {}\n", 5, "Retention() has no limit"),
    "compare": ('name = "c"\n' + SHARD + '[aspects.x]\ncompare = "vocabulary"\n', 5, "'compare' is written package.module:NAME, not 'vocabulary'"),
    "aspect key": ('name = "c"\n' + SHARD + "[aspects]\nx = { durable = true }\n", 5, "unknown key 'durable' in [aspects.x]; did you mean 'durability'?"),
    "aspect name": ('name = "c"\n' + SHARD + '[aspects."a/b"]\n', 4, "'a/b' cannot name an aspect"),
    "no class": ('name = "c"\n' + SHARD + "[actors.x]\n", 4, "[actors.x] needs the key 'class'"),
    "class": ('name = "c"\n' + SHARD + '[actors.x]\nclass = "a.b.C"\n', 5, "'class' is written package.module:Class, not 'a.b.C'"),
    "role": ('name = "c"\nworlds = ["online"]\n' + SHARD + '[actors.x]\nclass = "a:B"\nworlds = { now = "onlin" }\n', 7, "role 'now' is bound to unknown world context 'onlin'; did you mean 'online'? (known: online)"),
    "role type": ('name = "c"\n' + SHARD + '[actors.x]\nclass = "a:B"\nworlds = { now = 1 }\n', 6, "'now' in [actors.x.worlds] is a string, not an integer (1)"),
    "options type": ('name = "c"\n' + SHARD + '[actors.x]\nclass = "a:B"\noptions = []\n', 6, "'options' in [actors.x] is a table, not an array ([])"),
    "period": ('name = "c"\n' + SHARD + '[actors.x]\nclass = "a:B"\nevery_s = 0\n', 6, "'every_s' in [actors.x] must lie between 0.001 and 86400, not 0"),
    "entity": ('name = "c"\n' + SHARD + '[actors.x]\nclass = "a:B"\nentity = "camera/*"\n', 6, "'camera/*' cannot name an entity"),
    "no toml": ('name = "c"\nworlds = [\n', 2, ""),
    "no number": ('name = "c"\nlease_s = 1' + "0" * 5000 + "\n", 2, "Exceeds the limit (4300 digits)"),
    "no depth": ('name = "c"\nworlds = ' + "[" * 5000, 2, "maximum recursion depth exceeded"),
    "no home": ('name = "c"\ndata_folder = "~nobody-here/d"\n' + SHARD, 2, "'~nobody-here/d' begins with a home that is not known"),
    "twice": ('name = "c"\nname = "d"\n', 2, "Cannot overwrite a value"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_config_is_refused_with_line_and_reason(case):
    """Whatever is wrong in a file is named with the file, the line and the offending value."""
    text, line, reason = WRONG[case]

    error = refused(text)

    assert reason in str(error)
    assert str(error).startswith(f"cell.toml, line {error.line}: ")
    assert (error.line, error.path) == (line, "cell.toml")


def test_load_config_names_the_file_when_it_is_missing(tmp_path):
    """A file that does not exist is a config error with its name."""
    from enact_dist.config.read import load_config

    with pytest.raises(ConfigError, match=r"cannot read .*nowhere.toml: No such file"):
        load_config(tmp_path / "nowhere.toml")


def test_load_config_reads_a_file_and_resolves_its_folders(tmp_path):
    """Folders are relative to the file, not to the working folder."""
    from enact_dist.config.read import load_config

    file = tmp_path / "cell.toml"
    file.write_text(FULL, encoding="utf-8")

    config = load_config(file, environment={})

    assert config.path == file
    assert config.shard("left").folder == tmp_path / "data" / "left"


def test_load_config_refuses_a_file_that_is_not_text(tmp_path):
    """Bytes that are no UTF-8 are refused by name, not by a traceback."""
    from enact_dist.config.read import load_config

    file = tmp_path / "cell.toml"
    file.write_bytes(b'name = "\xff"\n')
    with pytest.raises(ConfigError, match="is not UTF-8"):
        load_config(file)


def test_environment_overrides_the_file():
    """Each documented variable replaces its key."""
    config = parsed(
        FULL,
        ENACT_SESSION_TTL_S="0.5",
        ENACT_DATA_FOLDER="/var/enact",
        ENACT_SHARD_LEFT_LISTEN="tcp/10.0.0.1:1, tcp/10.0.0.2:2",
        ENACT_SHARD_RIGHT_ADVERTISE="tcp/other:9",
        ENACT_SHARD_RIGHT_FOLDER="/var/right",
        ENACT_SHARD_LEFT_DRAIN_S="0",
        ENACT_SHARD_RIGHT_DRAIN_S="30",
        ENACT_CARRIER="zenoh",
        ENACT_CELL="elsewhere",
        PATH="/bin",
    )

    left, right = config.shards
    assert config.ttl_s == 0.5
    assert left.listen == left.advertise == ("tcp/10.0.0.1:1", "tcp/10.0.0.2:2")
    assert (left.folder, right.folder) == (Path("/var/enact/left"), Path("/var/right"))
    assert right.advertise == ("tcp/other:9",)
    assert (left.drain_s, right.drain_s) == (0.0, 30.0)


@pytest.mark.parametrize("listen", ["tcp/0.0.0.0:7447", "tcp/10.0.0.1:7447"])
def test_advertised_endpoint_may_be_the_one_of_the_file(listen):
    """As in a container: listen on every address, and be known by the name as before."""
    known = "tcp/127.0.0.1:7447"
    config = parsed(FULL, ENACT_SHARD_LEFT_LISTEN=listen, ENACT_SHARD_LEFT_ADVERTISE=known)

    assert (config.shard("left").listen, config.shard("left").advertise) == ((listen,), (known,))


def test_data_folder_override_leaves_a_folder_of_its_own():
    """A shard whose folder is written in the file stays there."""
    assert parsed(FULL, ENACT_DATA_FOLDER="/var").shard("right").folder == Path("/srv/right")


def test_empty_variables_count_as_none():
    """A compose file hands on what nobody has set as an empty text."""
    of_cell = ("SESSION_TTL_S", "DATA_FOLDER", "CARRIER", "SHARED_BYTES_MAX")
    of_shard = [
        f"SHARD_LEFT_{key}" for key in ("LISTEN", "ADVERTISE", "FOLDER", "METRICS", "DRAIN_S")
    ]
    nothing = {f"ENACT_{name}": "" for name in (*of_cell, *of_shard)}

    assert parsed(FULL, **nothing) == parsed(FULL)
    assert setting_of(nothing, "CARRIER", "auto") == "auto"
    assert setting_of(nothing, "SESSION_TTL_S", 2.0) == 2.0


def test_an_endpoint_takes_what_the_environment_says_of_a_cell(monkeypatch, tmp_path):
    """As for a file: an endpoint alone says neither how long a session lives nor the carrier."""
    monkeypatch.setenv("ENACT_SESSION_TTL_S", "7.5")
    monkeypatch.setenv("ENACT_CARRIER", "zenoh")
    known = _known_of("tcp/127.0.0.1:7447")
    assert (known.ttl_s, known.carrier) == (7.5, "zenoh")
    monkeypatch.setenv("ENACT_SESSION_TTL_S", "0.1")
    with pytest.raises(ConfigError, match=r"no number of seconds from 0\.2 to 60"):
        _known_of("tcp/127.0.0.1:7447")


WRONG_ENVIRONMENT = [
    ("ENACT_SESSION_TTL_S", "fast", "ENACT_SESSION_TTL_S='fast' is no number of seconds"),
    ("ENACT_SESSION_TTL_S", "nan", "ENACT_SESSION_TTL_S='nan' is no number of seconds"),
    ("ENACT_CARRIER", "mqtt", r"ENACT_CARRIER='mqtt' is unknown \(known: auto, zenoh, socket\)"),
    ("ENACT_SESSION_TTL", "2", "did you mean ENACT_SESSION_TTL_S"),
    ("ENACT_RETAINS", "0", "did you mean ENACT_RETAIN"),
    ("ENACT_SHARD_LEFT_DRAIN_S", "ever", "ENACT_SHARD_LEFT_DRAIN_S='ever' is no number of seconds"),
    ("ENACT_SHARD_LEFT_LISTN", "x", "did you mean 'ENACT_SHARD_LEFT_LISTEN'"),
    ("ENACT_SHARD_LEFT_LISTN", "", "did you mean 'ENACT_SHARD_LEFT_LISTEN'"),
    ("ENACT_SHARD_MIDDLE_LISTEN", "x", "no key of a shard of /cells/demo/cell.toml"),
    (
        "ENACT_SHARD_LEFT_LISTEN",
        "10.0.0.1:1",
        "ENACT_SHARD_LEFT_LISTEN: '10.0.0.1:1' is no endpoint",
    ),
    (
        "ENACT_DATA_FOLDER",
        "~nobody-here/d",
        "ENACT_DATA_FOLDER: '~nobody-here/d' begins with a home",
    ),
    ("ENACT_SHARD_LEFT_LISTEN", "tcp/0.0.0.0:1", "set ENACT_SHARD_LEFT_ADVERTISE too"),
]


@pytest.mark.parametrize(("name", "value", "reason"), WRONG_ENVIRONMENT)
def test_environment_is_refused_when_it_names_nothing(name, value, reason):
    """A misspelt or unusable override is refused by its name, never ignored."""
    with pytest.raises(ConfigError, match=reason):
        parsed(FULL, **{name: value})


def test_example_of_the_docstring_is_a_valid_cell():
    """The example that the module documents can be loaded as it stands."""
    import textwrap

    import enact_dist.config.read as module

    example = module.__doc__.split("Example::")[1].split("`enact_dist/docs")[0]

    config = parsed(textwrap.dedent(example))

    assert [shard.name for shard in config.shards] == ["left", "right"]
    assert config.shard("right").folder == Path("/cells/demo/data/right")


def test_byte_order_mark_is_no_error(tmp_path):
    """Some editors write one at the start of each file."""
    text = 'name = "cell"\n[shards.a]\nlisten = "tcp/127.0.0.1:7447"\n'
    (tmp_path / "cell.toml").write_bytes(b"\xef\xbb\xbf" + text.encode())

    assert load_config(tmp_path / "cell.toml", environment={}).name == "cell"


def test_file_in_utf_16_is_told_to_be_saved_as_utf_8(tmp_path):
    """As other editors write files; one line, with the remedy."""
    (tmp_path / "cell.toml").write_bytes('name = "cell"\n'.encode("utf-16"))

    with pytest.raises(ConfigError, match=r"cell\.toml is not UTF-8 .*save it as UTF-8$"):
        load_config(tmp_path / "cell.toml", environment={})


@pytest.mark.parametrize("listen", ['""', "[]", '["tcp/127.0.0.1:7447", ""]'])
def test_empty_endpoint_is_refused_with_an_example(listen):
    """It says what to write, not which types of TOML there are."""
    text = f'name = "cell"\n[shards.a]\nlisten = {listen}\n'

    with pytest.raises(
        ConfigError, match=r"line 3: .*(empty|needs).*such as tcp/127\.0\.0\.1:7447"
    ):
        parse_config(text, FILE, environment={})
