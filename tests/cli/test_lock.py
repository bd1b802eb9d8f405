"""`enact lock` against two real shards: who holds, who waits, and a command under a lock."""

import time

import pytest

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.cli.main import main
from enact_dist.errors import LeaseLostError

COUNT = Aspect("count", int)
PINNED = '[[pins]]\nentities = "**"\nshard = "left"\n'


@pytest.fixture(scope="module")
def cell(cell_file):
    with connect(cell_file, actor="painter") as opened:
        opened.world("online").init(Entity("piece"), COUNT, 1)
        yield opened


@pytest.fixture
def at(enact, cell, cell_file):
    """Call `enact lock VERB --cell FILE …`."""
    return lambda verb, *words: enact("lock", verb, "--cell", cell_file, *words)


def slot(cell, name="piece"):
    return Write(cell.world("online"), Entity(name), COUNT)


def waiting(at):
    """Return the locks as soon as somebody waits."""
    deadline_s = time.monotonic() + 30.0
    while time.monotonic() < deadline_s:
        locks = at("ls", "--json").json
        if any(not lock["granted"] for lock in locks):
            return locks
    raise AssertionError("nobody waits")


def test_ls_says_that_no_lock_is_held(at):
    """An empty list is a sentence for people and an empty list for programs."""
    assert at("ls").out == "no lock is held or awaited\n"
    assert at("ls", "--json").json == []


def test_ls_shows_the_holder_and_who_waits_for_whom(at, cell, spawn, cell_file):
    """A waiting writer is shown with the name, host and process of the one in its way."""
    with Lock(slot(cell)):
        spawn("world", "put", "online", "piece/count", "7", "--cell", cell_file)
        locks = waiting(at)
        table = at("ls").out

    holder = next(lock for lock in locks if lock["granted"])
    waiter = next(lock for lock in locks if not lock["granted"])
    assert (holder["actor"], holder["modes"]) == ("painter", "write")
    assert 0.0 < holder["lease_left_s"] <= 1.1
    assert waiter["waits_for"] == [holder["number"]]
    line = next(line for line in table.splitlines()[1:] if " waits " in line)
    assert f"{holder['number']} (painter@{holder['host']} pid {holder['pid']})" in line


def test_ls_shows_which_grants_are_kept_and_break_takes_them_away(at, cell):
    """Between two blocks one is `kept`, in a block `kept, used`; broken it is asked for anew."""

    def shown():
        (line,) = [line for line in at("ls").out.splitlines() if "kept/count" in line]
        (lock,) = [lock for lock in at("ls", "--json").json if "kept/count" in lock["slots"][0]]
        return line, lock

    request = slot(cell, "kept")
    for _ in range(4):
        with Lock(request) as held:
            held[request] = held.get(request, 0) + 1
    line, lock = shown()
    assert " kept  " in line
    assert (lock["kept"], lock["granted"], lock["hold_left_s"]) == ("unused", True, None)
    assert "  -  " in line

    broken = at("break", lock["number"], "--reason", "not needed")
    assert f"broke lock {lock['number']} on left, kept by painter@" in broken.out
    for _ in range(4):
        with Lock(request) as held:
            held[request] += 1
    with pytest.raises(LeaseLostError, match="used too long"), Lock(request) as held:
        line, lock = shown()
        assert " kept, used  " in line
        assert at("break", lock["number"], "--reason", "used too long").status == 0
        held[request] = 99
    with Lock(request) as held:
        assert held[request] == 8


def test_hold_passes_on_the_status_of_its_command(at):
    """The command runs while the lock is held, and its status is ours."""
    assert at("hold", "online:piece/count:write", "--", "sh", "-c", "exit 7").status == 7
    assert at("hold", "--world", "online", "piece/count:read", "--", "true").status == 0


def test_hold_holds_while_its_command_runs(at, cell, spawn, until, cell_file):
    """Nobody else gets the lock before the command has ended."""
    command = "echo running; read line; echo done"
    hold = spawn("lock", "hold", "--cell", cell_file, "online:piece/count:write", "--",
                 "sh", "-c", command, stdin=-1)  # fmt: skip
    until(hold, "running")
    names = [lock["actor"] for lock in at("ls", "--json").json if lock["kept"] != "unused"]
    hold.stdin.write("\n")
    hold.stdin.close()
    until(hold, "done")

    with Lock(slot(cell), wait_s=30.0):
        pass
    assert names == ["hold:sh"]
    assert hold.wait(60) == 0


def test_hold_kills_its_command_and_fails_when_the_lock_is_broken(at, spawn, until, cell_file):
    """A command never goes on without its lock: it is ended, children too, status 1."""
    hold = spawn("lock", "hold", "--cell", cell_file, "online:piece/count:write", "--",
                 "sh", "-c", "echo running; sleep 60; echo survived")  # fmt: skip
    until(hold, "running")
    locks = at("ls", "--json").json
    (number,) = [lock["number"] for lock in locks if lock["actor"] == "hold:sh"]

    broken = at("break", number, "--reason", "wrong piece")
    rest = hold.stdout.read()

    assert broken.status == 0
    assert f"broke lock {number} on " in broken.out
    assert hold.wait(60) == 1
    assert "was lost" in rest
    assert "survived" not in rest


def test_hold_says_that_it_ended_its_command_when_the_shard_went(write_cell, spawn, until, enact):
    """Status 3, the shard, and what became of the command: it may hold nothing any more."""
    file = write_cell(PINNED)
    shard, other = (spawn("shard", "run", name, "--cell", file) for name in ("left", "right"))
    for started in (shard, other):
        until(started, "ready: shard")
    assert enact("world", "put", "--new", "online", "piece/count", "1", "--cell", file).status == 0
    hold = spawn("lock", "hold", "--cell", file, "--timeout", "5", "online:piece/count:write",
                 "--", "sh", "-c", "echo running; sleep 60; echo survived")  # fmt: skip
    until(hold, "running")
    shard.kill()
    rest = hold.stdout.read()

    assert hold.wait(60) == 3
    assert "shard left" in rest
    assert "sh was ended, as it is unknown whether it holds the lock" in rest
    assert "survived" not in rest


def test_help_of_hold_names_each_status_of_its_own(capsys):
    """A script has to tell them from those of its command."""
    with pytest.raises(SystemExit):
        main(["lock", "hold", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "1 if the lock is lost, 3 if its shard does not answer" in said


def test_command_dies_with_whoever_held_its_lock(spawn, until, at, cell_file):
    """Even kill -9 of `lock hold` leaves no command that believes it is locked."""
    hold = spawn("lock", "hold", "--cell", cell_file, "online:piece/count:write", "--",
                 "sh", "-c", "echo running; exec sleep 60")  # fmt: skip
    until(hold, "running")
    hold.kill()

    # The pipe ends only when the command, which writes to it, is gone, too.
    assert hold.stdout.read() == ""


def test_hold_of_a_pattern_keeps_newcomers_out(at, cell, spawn, until, cell_file):
    """An entity with a star stands for all that match, those yet to come included."""
    hold = spawn("lock", "hold", "--cell", cell_file, "online:box/*/count:write", "--",
                 "sh", "-c", "echo running; read line", stdin=-1)  # fmt: skip
    until(hold, "running")
    from enact_dist.errors import LockTimeoutError

    with pytest.raises(LockTimeoutError), Lock(slot(cell, "box/9"), wait_s=0.2):
        pass
    hold.stdin.close()
    assert hold.wait(60) == 1  # `read` without input


@pytest.mark.parametrize(
    ("words", "status", "reason"),
    [
        (("online:piece/count:write",), 2, "needs a command"),
        (("piece/count:write", "--", "true"), 2, "in which world context is piece/count?"),
        (("nowhere:piece/count:write", "--", "true"), 1, "no world context 'nowhere'"),
        (("online:piece/cuont:write", "--", "true"), 1, "did you mean 'count'? (known: "),
        (("online:piece/count:write", "--", "no-such-command"), 2, "cannot run 'no-such-command'"),
    ],
)
def test_hold_is_refused_before_anything_runs(at, words, status, reason):
    """What cannot be held or run is named, and nothing is left held."""
    result = at("hold", *words)

    assert result.status == status
    assert reason in result.err
    assert [lock for lock in at("ls", "--json").json if lock["kept"] != "unused"] == []


def test_hold_times_out_with_the_holders_name(at, cell):
    """A lock that is not granted in time ends with status 1 and says who has it."""
    with Lock(slot(cell)):
        result = at("hold", "--wait", "0.3", "online:piece/count:write", "--", "true")

    assert result.status == 1
    assert "painter@" in result.err


def test_break_of_an_unknown_lock_is_refused(at):
    """A number that nobody knows is named."""
    assert "no shard knows a lock 999999" in at("break", 999_999).err
    assert at("break", 999_999, "--shard", "left").status == 1
    assert "no shard 'middle'" in at("break", 1, "--shard", "middle").err
