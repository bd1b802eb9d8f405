"""`enact`: usage, exit statuses, one line per error, and what it does not import."""

import argparse
import os
import subprocess
import sys
from pathlib import Path

import pytest

from enact_dist.cli.main import build_parser, main
from enact_dist.cli.verbs import NOUNS, function_of, renamed, table_of

PAGES = Path(__file__).parents[2] / "enact_dist" / "docs"


def walk_verbs(parser, words=()):
    """Yield the words and the parser of every verb."""
    groups = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    if words and not groups:
        yield list(words), parser
    for group in groups:
        for name, below in group.choices.items():
            yield from walk_verbs(below, (*words, name))


@pytest.mark.parametrize("words", [w for w, _ in walk_verbs(build_parser())], ids=" ".join)
def test_help_of_every_verb_ends_with_an_example(words, capsys):
    """Whoever asks a verb for help sees a command line that can be typed."""
    with pytest.raises(SystemExit) as ended:
        main([*words, "--help"])

    out = capsys.readouterr().out
    assert ended.value.code == 0
    assert f"  enact {' '.join(words)}" in out.partition("example")[2]


@pytest.mark.parametrize(
    "words",
    [
        "shard run left",
        "shard rebalance",
        "shard backup left --to b",
        "shard restore left --from b",
    ],
)
def test_help_of_what_needs_the_file_does_not_offer_an_endpoint(words, enact, capsys):
    """It would be refused, as what the verb needs stands in the file alone."""
    with pytest.raises(SystemExit):
        main([*words.split()[:2], "--help"])
    shown = " ".join(capsys.readouterr().out.split())

    assert "--cell FILE a cell.toml (default: $ENACT_CELL, else ./cell.toml)" in shown
    assert "endpoint such as" not in shown
    assert "is an endpoint" in enact(*words.split(), "--cell", "tcp/host:7447").err


def test_help_of_up_names_the_variable_that_it_goes_by(capsys, enact, monkeypatch):
    """Where no file is named, ENACT_CELL names it, as everywhere."""
    monkeypatch.setenv("ENACT_CELL", "elsewhere.toml")
    with pytest.raises(SystemExit):
        main(["up", "--help"])

    assert "$ENACT_CELL" in capsys.readouterr().out
    assert "elsewhere.toml" in enact("up").err


@pytest.mark.parametrize(
    ("words", "example"),
    [
        (w, line)
        for w, p in walk_verbs(build_parser())
        for line in (p.epilog or "").splitlines()
        if line.startswith("  ")
    ],
)
def test_examples_of_the_help_can_be_parsed(words, example):
    """No example names an option that does not exist."""
    import shlex

    line = shlex.split(example)[1:]
    line = line[: line.index("--")] if "--" in line else line

    assert isinstance(build_parser().parse_args(line), argparse.Namespace)


@pytest.mark.parametrize("noun", NOUNS)
def test_every_verb_of_a_table_names_its_function_and_a_page(noun):
    """A table names both by words, which no type checker follows."""
    assert (PAGES / f"{NOUNS[noun].page}.md").exists()
    for verb in table_of(noun):
        assert callable(function_of(noun, verb))
        assert (PAGES / f"{verb.page or NOUNS[noun].page}.md").exists()


@pytest.mark.parametrize(
    ("former", "now"),
    [
        ("world keep --help", "world pin"),
        ("world kept --help", "world pinned"),
        ("world let-go --help", "world unpin"),
        ("why online a/b --keep=incident --help", "why --pin"),
        ("lock audit --settle text --help", "lock --acknowledge"),
    ],
)
def test_former_name_works_and_names_its_successor(former, now, capsys):
    """One line on standard error, so that output that a program reads stays the same."""
    with pytest.raises(SystemExit) as ended:
        main(former.split())

    out, err = capsys.readouterr()
    assert ended.value.code == 0
    assert out.startswith(f"usage: enact {now.partition(' --')[0]}")
    assert f"is now called enact {now};" in err
    assert err.count("\n") == 1


def test_former_names_stand_in_no_help():
    """Nor in the list that a wrong verb gets; as values they stay what they are."""
    shown = [parser.format_help() for _, parser in walk_verbs(build_parser())]
    assert not any(f" {name} " in text for text in shown for name in ("let-go", "--settle"))
    assert renamed("world", ["world", "create", "keep"]) == (["world", "create", "keep"], [])


def test_readers_all_have_json():
    """Every verb that only looks can be read by a program."""
    readers = {"ls", "tree", "get", "watch", "doctor", "check"}
    found = {
        words[-1]: "--json" in parser.format_help()
        for words, parser in walk_verbs(build_parser())
        if words[-1] in readers
    }
    assert found == dict.fromkeys(readers, True)


@pytest.mark.parametrize(
    "words",
    [
        ["shard"],
        ["nonsense"],
        ["world", "get", "online"],
        ["lock", "break", "x"],
        ["why", "online", "a/b@99999999999999999999"],
    ],
)
def test_usage_is_refused_with_status_2(words, capsys):
    """A command line that cannot be read ends with status 2 and says how to write it."""
    with pytest.raises(SystemExit) as ended:
        main(words)

    assert ended.value.code == 2
    assert "usage: enact" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("wrold tree online", "'wrold' (choose from 'up', 'shard', "),
        ("world treee online", "did you mean 'tree'?\n"),
        ("cell keys mkae", "did you mean 'make'?\n"),
        ("bench --carrier soket", "did you mean 'socket'?\n"),
        ("wrold tree online", "; did you mean 'world'?\n"),
        ("nonsense", "'workcell')\n"),
    ],
)
def test_a_misspelt_word_is_told_with_the_one_that_may_be_meant(words, said, capsys):
    """Of commands, their verbs, and options with a choice; behind all that there are."""
    with pytest.raises(SystemExit) as ended:
        main(words.split())

    assert ended.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("words", [w for w, _ in walk_verbs(build_parser())], ids=" ".join)
def test_wrong_usage_is_told_with_the_usage_of_its_verb(words, capsys):
    """Not with that of `enact` alone, which tells nothing of the verb."""
    with pytest.raises(SystemExit) as ended:
        main([*words, "--no-such-option"])

    assert ended.value.code == 2
    assert f"usage: enact {' '.join(words)} " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("world tree online --json robot", {"pattern": "robot", "json": True}),
        ("world diff online online --at1 1700000000 robot", {"entities": "robot"}),
        ("world watch online --count 1 robot", {"pattern": "robot", "count": 1}),
        ("world at online --json -30s --timeout 2 tree robot", {"what": "tree", "name": "robot"}),
        ("world at online -30s --json tree --timeout 2 robot", {"what": "tree", "name": "robot"}),
        ("shard check --json left", {"name": "left"}),
        ("up --debug cell.toml", {"cell": "cell.toml", "debug": True}),
        ("bench --seconds 3 floor core", {"names": ["floor", "core"]}),
        ("bench floor --seconds 3 core", {"names": ["floor", "core"]}),
        ("world pin drop-17 online a/b --json c/d", {"slots": [("a", "b", 0), ("c", "d", 0)]}),
    ],
)
def test_options_may_stand_anywhere(line, found):
    """Before an argument that may be left out, too, as the usage lists them."""
    arguments = build_parser().parse_args(line.split())

    assert {name: getattr(arguments, name) for name in found} == found


def test_repeated_option_before_the_last_argument_counts_once():
    """Where options are taken out in a second pass, nothing of the first is left."""
    arguments = build_parser().parse_args(
        ["world", "watch", "online", "--aspect", "a", "robot", "--aspect", "b"]
    )

    assert (arguments.pattern, arguments.aspect) == ("robot", ["a", "b"])


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("world tree online robot other", "enact world tree: error: unrecognized arguments: other"),
        ("world tree online --jsn robot", "enact world tree: error: unrecognized arguments: --jsn"),
        ("world --jsn tree online", "enact world: error: unrecognized arguments: --jsn"),
        ("world tree online -- a b", "enact world tree: error: unrecognized arguments: b"),
        ("shard ls -- left", "enact shard ls: error: unrecognized arguments: left"),
    ],
)
def test_what_is_left_over_is_named_by_its_verb(line, said, capsys):
    """What is too much, or not known, and nothing else."""
    with pytest.raises(SystemExit):
        main(line.split())

    assert capsys.readouterr().err.endswith(f"{said}\n")


def test_two_dashes_end_the_options_of_all_but_a_held_command(enact):
    """What follows them is an argument, whatever it begins with; nothing of it is left out."""
    assert "no cell: there is no" in enact("world", "put", "online", "a/b", "--", "--5").err


def shell(script, folder):
    """Run a shell script in which `enact` is this version; return its status and all it printed."""
    enact = f"{sys.executable} -m enact_dist.cli.main"
    script = f'enact() {{ {enact} "$@"; }}\n{script}'
    env = os.environ | {"PYTHONPATH": str(PAGES.parents[1]), "LC_ALL": "C.UTF-8"}
    done = subprocess.run(
        ["bash", "-c", script], cwd=folder, env=env, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("script", "status", "said"),
    [
        ("enact --version > /dev/full", 1, "enact: [Errno 28] No space left on device\n"),
        ("enact --version | exec <&-; exit ${PIPESTATUS[0]}", 0, ""),
        ("enact doctor --json >&-; test $? -lt 2", 0, ""),
        ("enact world ls 2>&-", 2, ""),
        ("mkdir a; cd a; rmdir ../a; enact world ls", 1, "enact: the working folder was removed"),
        ("PYTHONIOENCODING=latin-1 enact lock hold --help", 0, "ASPECT:read|write \\u2026"),
    ],
)
def test_output_that_cannot_be_written_is_no_traceback(script, status, said, tmp_path):
    """A full disk, a reader that is gone, closed streams, a folder that is gone, another alphabet."""
    found, text = shell(script, tmp_path)

    assert said in text
    assert bool(said) == bool(text)
    assert (found, "Traceback" in text) == (status, False)


def test_no_command_prints_help_and_is_usage(enact):
    """`enact` alone shows what there is."""
    result = enact()
    assert result.status == 2
    assert "commands:" in result.out


def test_missing_cell_is_named_with_its_remedies(enact, tmp_path):
    """Without a cell.toml the error says where it looked and how to name one."""
    result = enact("world", "ls")

    assert result.status == 2
    assert result.err == (
        f"enact: no cell: there is no cell.toml in {tmp_path}; name one with --cell FILE or"
        " --cell tcp/host:7447, or set ENACT_CELL (docs/cell.md explains the file)\n"
    )


def test_config_error_is_one_line_with_file_and_line(enact, tmp_path):
    """A mistake in cell.toml is status 2 and one line on the error stream."""
    (tmp_path / "cell.toml").write_text('name = "c"\nshard = 1\n', encoding="utf-8")

    result = enact("shard", "run", "left")

    assert result.status == 2
    assert result.err.startswith("enact: cell.toml, line 2: unknown key 'shard'")
    assert result.err.count("\n") == 1


def test_cell_variable_names_the_cell(enact, tmp_path, monkeypatch):
    """ENACT_CELL stands for --cell."""
    monkeypatch.setenv("ENACT_CELL", str(tmp_path / "elsewhere.toml"))

    assert "elsewhere.toml" in enact("world", "ls").err


def test_debug_shows_the_traceback(tmp_path):
    """--debug lets the exception through, before and after the verb."""
    from enact_dist.errors import ConfigError

    for words in (["--debug", "world", "ls"], ["world", "ls", "--debug"]):
        with pytest.raises(ConfigError):
            main(words)


def test_unreachable_cell_is_status_3(enact):
    """Where nothing listens the status is 3 and the endpoint is named."""
    result = enact("world", "ls", "--cell", "tcp/127.0.0.1:9", "--timeout", "0.5")

    assert result.status == 3
    assert "tcp/127.0.0.1:9" in result.err


def test_help_loads_neither_zenoh_nor_open3d_nor_rich():
    """Asking for help costs no slow import."""
    code = (
        "import sys; from enact_dist.cli.main import build_parser; build_parser().format_help();"
        "print(sorted({'zenoh', 'open3d', 'rich', 'scipy', 'cv2'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize(
    "words", [["--help"], ["--version"], ["nonsense"], ["--debug", "up", "-h"]]
)
def test_command_line_loads_only_the_command_that_it_names(words):
    """The overview loads none of them: it takes as long as the interpreter needs to start."""
    code = (
        "import sys; from enact_dist.cli.main import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit: pass\n"
        "from enact_dist.cli.verbs import NOUNS\n"
        "modules = {noun.module for noun in NOUNS.values()}\n"
        "print(*(name for name in modules if f'enact_dist.cli.{name}' in sys.modules))\n"
        "print(*sorted({'numpy', 'msgpack', 'logging', 'asyncio'} & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=True
    )

    commands, slow = done.stdout.split("\n")[-3:-1]
    assert commands == ("up" if "up" in words else "")
    assert commands or not slow


def test_overview_says_of_each_command_what_its_own_help_says(capsys):
    """The summaries stand once, in the order of the table."""
    with pytest.raises(SystemExit):
        main(["--help"])

    assert capsys.readouterr().out == build_parser().format_help()
