"""`enact top`: keys of its screen, plain tables, a shard that goes and comes back, a terminal."""

import asyncio
import os
import pty
import queue
import select
import signal
import sys
import termios
import time
from contextlib import asynccontextmanager
from dataclasses import replace

import pytest

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.cli.main import main
from enact_dist.cli.top.tables import TABLES, headline
from enact_dist.operate.cell_rates import Looks
from enact_dist.world.listings import ActorInfo, LockInfo, ShardInfo
from enact_dist.world.look import Look, look_at

pytest.importorskip("textual", reason="enact top needs the extra 'view'")

PATIENCE_S = 60.0
COUNT = Aspect("count_in_top", int)


def look(commits=0, *, away=False):
    """A cell of one shard, three actors and two locks."""
    left = ShardInfo("left", "tcp/h:1", True, 1, True, 1.0 + commits, counters={"commits": commits})
    gone = ShardInfo("left", "tcp/h:1", reachable=False, problem="no route")
    states = {"camera": "running", "fusion": "stuck", "arm": "starting"}
    actors = [
        ActorInfo(name, "h", 1, f"s{name}", ("left",), 0.9, 0,
                  {"actors": [{"name": name, "state": state}]})
        for name, state in states.items()
    ]  # fmt: skip
    locks = (
        LockInfo("left", 1, "a", "arm", "h", 1, True, "write", 2.0, 0.5, 9.0, ("slot",), ()),
        LockInfo("left", 2, "b", "fusion", "h", 1, False, "read", 1.0, 0.5, 9.0, ("slot",), (1,)),
    )
    return Look(1_000.0 + commits, 0.0, (gone if away else left,), tuple(actors), locks)


class Screen:
    """A screen that shows looks when the test hands them to it."""

    def __init__(self, pilot, feed, asked):
        self.pilot, self.app, self._feed, self.asked = pilot, pilot.app, feed, asked

    async def show(self, one):
        """Hand over a look, and wait until it is shown."""
        before = self.app._rates
        self._feed.put(one)
        await self.until(lambda: self.app._rates is not before)

    async def until(self, condition):
        end_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end_s
            await self.pilot.pause(0.01)

    def shown(self):
        """The keys of the panels that are on the screen."""
        return "".join(t.key for t in TABLES if self.app._panel(t).display)

    def column(self, key, index=0):
        """The texts of a column of a panel, from above."""
        (table,) = (table for table in TABLES if table.key == key)
        panel = self.app._panel(table)
        return [str(panel.get_row_at(row)[index]) for row in range(panel.row_count)]

    def text(self, name):
        return str(self.app.query_one(f"#{name}").render())


@asynccontextmanager
async def top(*, size=(150, 50)):
    from enact_dist.cli.top.screen import TopApp

    feed, looks, asked = queue.Queue(), Looks(), []

    def take():
        asked.append(1)
        one = feed.get(timeout=PATIENCE_S)
        if isinstance(one, Exception):
            raise one
        return looks.add(one)

    app = TopApp("mine", take, every_s=0.001)
    async with app.run_test(size=size) as pilot:
        yield Screen(pilot, feed, asked)
    feed.put(look())  # lets the thread see that it is over


def on_screen(test):
    """Run a test as a coroutine with a screen."""

    def run():
        async def inside():
            async with top() as screen:
                await test(screen)

        asyncio.run(inside())

    run.__name__, run.__doc__ = test.__name__, test.__doc__
    return run


@on_screen
async def test_screen_shows_all_panels_and_each_alone(screen):
    """The key of a panel shows it alone, once more all; counters have a place of their own."""
    await screen.show(look())
    await screen.show(look(20))
    assert screen.shown() == "sald"
    assert "commits" in screen.text("headline")
    assert screen.column("s", 3) == ["1/s"]
    for key, shown in (("l", "l"), ("d", "d"), ("d", "sald"), ("c", "c")):
        await screen.pilot.press(key)
        assert screen.shown() == shown
    assert screen.column("c", 1) == ["commits"]
    await screen.pilot.press("escape")
    assert screen.shown() == "sald"


@on_screen
async def test_locks_name_what_they_wait_for(screen):
    """Who waits for whom; the row that is marked stays so."""
    await screen.show(look())

    assert screen.column("l") == ["1", "2"]
    assert screen.column("l", 9) == ["-", "1 (arm@h pid 1)"]
    await screen.pilot.press("l", "down")
    await screen.show(look(1))
    assert screen.app._panel(TABLES[2]).cursor_row == 1


@on_screen
async def test_rows_are_sorted_by_the_column_that_a_key_chooses(screen):
    """`o` takes the next column, `r` the other direction; the heading has an arrow."""
    await screen.show(look())
    await screen.pilot.press("a")
    assert screen.column("a") == ["arm", "camera", "fusion"]
    await screen.pilot.press("o")
    assert screen.column("a", 1) == ["running", "starting", "stuck"]
    await screen.pilot.press("r")
    assert screen.column("a", 1) == ["stuck", "starting", "running"]
    labels = [str(one.label) for one in screen.app._panel(TABLES[1]).columns.values()]
    assert [label for label in labels if "▼" in label] == ["state ▼"]


@on_screen
async def test_filter_keeps_rows_with_a_text(screen):
    """Keys that are written into it do nothing else; escape shows all rows."""
    await screen.show(look())
    await screen.pilot.press("slash", *"ca", "enter")
    assert screen.column("a") == ["camera"]
    assert "only rows with 'ca'" in screen.text("headline")
    await screen.pilot.press("escape")
    assert screen.column("a") == ["arm", "camera", "fusion"]


@on_screen
async def test_pause_takes_no_look_until_it_ends(screen):
    """The look that is under way is the last one."""
    await screen.show(look())
    await screen.until(lambda: len(screen.asked) == 2)  # this one waits for the test
    await screen.pilot.press("p")
    await screen.show(look(1))
    assert "PAUSED" in screen.text("headline")
    await screen.pilot.pause(0.1)
    assert len(screen.asked) == 2
    await screen.pilot.press("p")
    await screen.until(lambda: len(screen.asked) == 3)
    assert "PAUSED" not in screen.text("headline")


@on_screen
async def test_shard_that_is_away_is_told_until_it_is_back(screen):
    """The screen goes on."""
    await screen.show(look())
    await screen.show(look(5, away=True))
    assert "shard left at tcp/h:1 has not answered for 0 s: no route" in screen.text("away")
    assert screen.column("s", 1)[0].startswith("AWAY for")
    await screen.show(look(9))
    assert screen.text("away") == ""
    assert "shard left is back after 4.0 s" in screen.text("events")


@on_screen
async def test_title_says_when_slots_were_looked_at(screen):
    """Where that was not now."""
    await screen.show(look())
    assert screen.app._panel(TABLES[3]).border_title == "data: 0"
    await screen.show(replace(look(5), slots=None))
    assert screen.app._panel(TABLES[3]).border_title.startswith("data: 0, all as of ")


def test_error_of_a_look_ends_the_screen_and_is_raised_by_its_caller():
    """The command prints it as its own error, without the traceback of a thread."""

    async def inside():
        async with top() as screen:
            screen._feed.put(ValueError("closed"))
            await screen.until(lambda: not screen.app.is_running)
            with pytest.raises(ValueError, match="closed"):
                screen.app.checked()

    asyncio.run(inside())


def test_screen_that_is_to_end_before_it_runs_ends():
    """A signal may come while the cell is opened; any thread may say so, and does not wait."""
    from enact_dist.cli.top.screen import TopApp

    asked = []
    app = TopApp("mine", lambda: asked.append(1), every_s=1.0)
    app.end()

    async def inside():
        async with app.run_test() as pilot:
            await Screen(pilot, None, asked).until(lambda: not app.is_running)

    asyncio.run(inside())
    assert (asked, app.checked()) == ([], None)


def test_many_rows_are_counted_beyond_those_that_are_shown(monkeypatch):
    """A cell may have a hundred thousand slots; a screen shows the busiest."""
    from enact_dist.cli.top import screen as drawn

    monkeypatch.setattr(drawn, "ROWS_SHOWN_MAX", 2)

    async def inside():
        async with top() as screen:
            await screen.show(look())
            assert screen.column("a") == ["arm", "camera"]
            assert screen.app._panel(TABLES[1]).border_title == "actors: 3, the first 2 shown"

    asyncio.run(inside())


def test_unknown_figures_come_last():
    """Before there are two looks no rate is known."""
    rates = Looks().add(look())

    shards = TABLES[0]
    assert shards.lines(rates, 9, column=3) == shards.lines(rates, 9, column=3, turned=True)
    assert shards.lines(rates, 9, only="LEFT")[1] == 1
    assert shards.lines(rates, 9, only="right") == ([], 0)
    assert headline(rates).startswith("1 of 1 shards, - commits, 3 actors")


# ---------------------------------------------------------------- a cell


def commit(cell_file, count):
    with connect(cell_file) as cell:
        request = Write(cell.world("online"), Entity("top/1"), COUNT)
        for number in range(count):
            with Lock(request) as lock:
                lock[request] = number


def test_once_prints_plain_tables(enact, cell_file):
    """Standard output is no terminal here, so nothing has to be said for it."""
    commit(cell_file, 3)
    found = enact("top", "--every", "0.2", "--cell", cell_file)

    assert found.status == 0
    assert found.out.startswith("cell clitest at ")
    assert "2 of 2 shards" in found.out
    assert "online:top/1/count_in_top" in found.out


def test_once_as_json_has_what_the_tables_have(enact, cell_file):
    """For scripts: rates as numbers, null where they are not known."""
    commit(cell_file, 1)
    words = ("--once", "--every", "0.2", "--entities", "top/*", "--world", "online")
    found = enact("top", *words, "--json", "--cell", cell_file).json

    assert found["cell"] == "clitest"
    assert [one["name"] for one in found["shards"]] == ["left", "right"]
    assert all(one["commits_hz"] >= 0.0 for one in found["shards"])
    assert {(one["world"], one["entity"]) for one in found["data"]} == {("online", "top/1")}
    assert found["data"][0]["hz"] == 0.0
    assert found["seconds"] > 0.1
    assert enact("top", "--world", "training", "--once", "--json", "--every", "0.1",
                 "--cell", cell_file).json["data"] == []  # fmt: skip


def test_world_context_that_the_cell_does_not_have_is_refused(enact, cell_file):
    """It is not shown as one without data."""
    found = enact("top", "--once", "--world", "onlin", "--cell", cell_file)

    assert found.status == 1
    assert "'onlin'" in found.err
    assert found.out == ""


def test_looking_leaves_nothing_behind_at_the_shards(cell_file):
    """No session, no lock and no commit are made by it."""
    with connect(cell_file, observer=True) as cell:
        before = look_at(cell)
        looks = Looks()
        for _ in range(3):
            rates = looks.add(look_at(cell))

    assert [one.commits_hz for one in rates.shards] == [0.0, 0.0]
    assert rates.actors == tuple(Looks().add(before).actors)
    assert not rates.locks


@pytest.mark.slow
def test_shard_that_is_killed_is_away_and_comes_back(spawn, until, enact, write_cell):
    """What the other shard does stays on the screen meanwhile, and no look waits for long."""
    file = write_cell()
    shards = {name: spawn("shard", "run", name, "--cell", file) for name in ("left", "right")}
    for shard in shards.values():
        until(shard, "ready: shard")
    looks = Looks()
    with connect(file, observer=True) as cell:

        def seen(wanted):
            end_s = time.monotonic() + PATIENCE_S
            while not wanted(rates := looks.add(look_at(cell))):
                assert time.monotonic() < end_s
            return rates

        assert not looks.add(look_at(cell)).away
        shards["right"].kill()
        shards["right"].wait()
        gone = seen(lambda rates: rates.away)
        assert [one.name for one in gone.away] == ["right"]
        assert gone.shards[0].commits_hz == 0.0
        assert gone.took_s < 5.0
        once = enact("top", "--once", "--every", "0.1", "--cell", file)
        assert once.status == 3
        assert "AWAY for" in once.out
        assert "enact: shard right at" in once.err

        again = spawn("shard", "run", "right", "--cell", file)
        until(again, "ready: shard")
        back = seen(lambda rates: not rates.away)

    texts = [text.partition(" after ")[0] for _, text in back.events]
    assert texts == ["shard right is away", "shard right is back"]
    assert back.events[-1][1].endswith(", restarted")


# ---------------------------------------------------------------- a terminal


def read_terminal(terminal, wanted):
    """Return what was drawn up to a text."""
    seen, end_s = b"", time.monotonic() + PATIENCE_S
    while wanted not in seen:
        assert time.monotonic() < end_s, seen[-2000:]
        if select.select([terminal], [], [], 0.2)[0]:
            seen += os.read(terminal, 65_536)
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("how", ["q", "sigterm"])
def test_screen_on_a_terminal_ends_with_the_terminal_as_it_was(how, spawn, cell_file):
    """It draws, and whatever ends it: the other screen is left, the cursor is back, lines echo."""
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(theirs, (40, 140))
    before = termios.tcgetattr(theirs)
    process = spawn(
        "top", "--every", "0.2", "--cell", cell_file,
        stdin=theirs, stdout=theirs, stderr=theirs, env={"TERM": "xterm-256color"},
    )  # fmt: skip
    drawn = read_terminal(ours, b"2 of 2 shards")
    if how == "sigterm":
        process.send_signal(signal.SIGTERM)
    else:
        os.write(ours, b"q")
    drawn += read_terminal(ours, b"\x1b[?1049l")
    status = process.wait(PATIENCE_S)
    while select.select([ours], [], [], 0.2)[0]:
        drawn += os.read(ours, 65_536)
    after = termios.tcgetattr(theirs)
    os.close(ours)
    os.close(theirs)

    assert status == 0
    assert b"\x1b[?1049h" in drawn
    assert drawn.rindex(b"\x1b[?25h") > drawn.rindex(b"\x1b[?25l")
    assert b"Traceback" not in drawn
    assert after == before


def test_screen_without_textual_names_the_extra(cell_file, monkeypatch, capsys):
    """And what needs it not."""
    monkeypatch.setattr("enact_dist.extras.find_spec", lambda _: None)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)

    assert main(["top", "--cell", str(cell_file)]) == 2
    assert "install the extra 'view'" in capsys.readouterr().err
