"""Files that a shard makes before a client asks for them: both ends, and wrong edits of the rules."""

import os
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from payload_drafts import NOTHING, SIZE, adopted, names

from enact_dist import Aspect, Durability, Entity, Lock, View, Write, connect
from enact_dist.core.protocol.messages import Stage, Staged
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.link.memory import payload_files, payload_handler
from enact_dist.link.memory.ahead import (
    BYTES_MAX,
    FILES_MAX,
    IDLE_S,
    ROW_BITS,
    ROWS_MAX,
    AheadOf,
    NamesAhead,
)
from enact_dist.link.memory.maps import leftovers
from enact_dist.link.memory.payload_handler import PayloadHandler
from enact_dist.testing import ManualClock

IMAGE = Aspect("image", np.ndarray, Durability.VOLATILE)
CAMERA = Entity("camera")
ROW = 1 << ROW_BITS


def asked(handler, file="ann-1", ahead=1, total=SIZE):
    """Ask for a payload and files behind it; return the answer once they are made."""
    answer = handler.stage(Stage(file.partition("-")[0], file, 0, total, NOTHING, ahead))
    handler.make_ahead()
    return answer


def committed(handler, number, size=SIZE):
    """Let a commit name a payload; return its datum once further files are made."""
    datum = adopted(handler, f"ann-{number:x}", size=size, session="ann")
    handler.make_ahead()
    return datum


# ---------------------------------------------------------------- the shard's rules


def files_appear_after_the_answer_and_can_be_committed_at_once(folder):
    """No answer waits for them; they are as good as those that were asked for."""
    handler = PayloadHandler(folder, 20 * SIZE)
    answer = handler.stage(Stage("ann", "ann-1", 0, SIZE, NOTHING, 2))
    assert (answer, names(folder)) == (Staged("ann-1", 0, True), ["ann-1"])
    handler.make_ahead()

    assert names(folder) == ["ann-1", "ann-2", "ann-3"]
    assert [(folder.path / file).stat().st_size for file in names(folder)] == [SIZE] * 3
    assert [(folder.path / file).stat().st_mode & 0o777 for file in names(folder)] == [0o600] * 3
    (folder.path / "ann-2").write_bytes(b"x" * SIZE)
    assert bytes(committed(handler, 2).body) == b"x" * SIZE


def commits_bring_further_files_and_never_one_again(folder):
    """One behind each, or several once more than half are taken, in whatever order."""
    handler = PayloadHandler(folder, 60 * SIZE)
    asked(handler, ahead=1)
    shown = [committed(handler, 1)]
    assert names(folder) == ["ann-1", "ann-2"]
    shown.append(committed(handler, 2))
    assert names(folder) == ["ann-1", "ann-2", "ann-3"]

    asked(handler, "ann-a", ahead=3)
    shown += [committed(handler, 0xC), committed(handler, 0xB)]
    wanted = ["ann-a", "ann-b", "ann-c", "ann-d", "ann-e", "ann-f"]
    assert [file for file in names(folder) if file >= "ann-a"] == wanted
    del shown
    assert names(folder) == ["ann-3", "ann-a", "ann-d", "ann-e", "ann-f"]


def one_session_has_few_of_them(folder):
    """By number and by bytes, whatever it asks for; others have theirs all the same."""
    handler = PayloadHandler(folder, 1 << 30)
    asked(handler, ahead=1000)
    asked(handler, "ann-1000", ahead=1000)
    figures = handler.figures()
    assert (figures["payload_drafts"], figures["files_ahead"]) == (2, FILES_MAX)

    large = BYTES_MAX // 2
    asked(handler, "eve-1", ahead=5, total=large)
    assert [file for file in names(folder) if file.startswith("eve")] == ["eve-1", "eve-2"]


def shard_that_runs_short_makes_none(folder):
    """More than half of its room is left to what is asked for."""
    handler = PayloadHandler(folder, 6 * SIZE)
    asked(handler, ahead=5)

    assert names(folder) == ["ann-1", "ann-2", "ann-3"]
    assert handler.figures()["payload_bytes"] == 3 * SIZE


def files_ahead_go_before_history(folder):
    """What nobody has asked for is no reason to remove versions, or to refuse."""
    made = []
    handler = PayloadHandler(folder, 6 * SIZE, make_room=made.append)
    asked(handler, ahead=2)
    answers = [asked(handler, f"eve-{number}", ahead=0) for number in range(1, 6)]

    assert all(isinstance(answer, Staged) and answer.shared for answer in answers)
    assert (made, handler.figures()["files_ahead_removed"]) == ([], 2)
    assert names(folder) == ["ann-1", *(f"eve-{number}" for number in range(1, 6))]


def file_that_was_taken_back_may_be_asked_for(folder):
    """Its client does not know; it gets one, of that name, once there is room."""
    handler = PayloadHandler(folder, 4 * SIZE)
    asked(handler, ahead=1)
    asked(handler, "eve-1", ahead=0, total=3 * SIZE)
    assert names(folder) == ["ann-1", "eve-1"]
    handler.drop("eve-1")
    assert leftovers().wait(30)

    assert asked(handler, "ann-2", ahead=0) == Staged("ann-2", 0, True)


def files_end_with_their_session_or_after_a_time(folder):
    """They are no drafts of a client that died, so those have a counter of their own."""
    clock = ManualClock()
    handler = PayloadHandler(folder, 60 * SIZE, clock=clock)
    asked(handler, "gone-1", ahead=2)
    asked(handler, "idle-1", ahead=2)
    handler.drop("gone-1")
    handler.drop("idle-1")
    handler.sweep({"idle"}.__contains__, lambda _: False)
    assert names(folder) == ["idle-2", "idle-3"]

    clock.advance(30.1)
    handler.sweep({"idle"}.__contains__, {"idle"}.__contains__)
    assert names(folder) == ["idle-2", "idle-3"]
    handler.sweep({"idle"}.__contains__, lambda _: False)
    figures = handler.figures()
    assert names(folder) == []
    assert (figures["files_ahead_removed"], figures.get("drafts_swept", 0)) == (4, 0)
    assert (figures["payload_bytes"], figures["payload_files"]) == (0, 0)


def what_was_given_up_does_not_come_again(folder):
    """Nor does it by a late copy of the request that asked for it."""
    handler = PayloadHandler(folder, 60 * SIZE)
    asked(handler, ahead=2)
    for file in ("ann-1", "ann-2"):
        handler.stage(Stage("ann", file, 0, 0, NOTHING))
    asked(handler, ahead=2)

    assert names(folder) == ["ann-3", "ann-4"]  # in their place


RULES = (
    files_appear_after_the_answer_and_can_be_committed_at_once,
    commits_bring_further_files_and_never_one_again,
    one_session_has_few_of_them,
    shard_that_runs_short_makes_none,
    files_ahead_go_before_history,
    file_that_was_taken_back_may_be_asked_for,
    files_end_with_their_session_or_after_a_time,
    what_was_given_up_does_not_come_again,
)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_shard_keeps_the_rules(folder, rule):
    """Each is said where it stands."""
    rule(folder)


def _answers_late(patch):
    stage = PayloadHandler.stage

    def wrong(handler, message, owner=""):
        answer = stage(handler, message, owner)
        handler.make_ahead()
        return answer

    patch(PayloadHandler, "stage", wrong)


def _forgets_to_count(patch):
    made = PayloadHandler._made_ahead

    def wrong(handler, file, wanted):
        before = handler._bytes
        found = made(handler, file, wanted)
        handler._bytes = before
        return found

    patch(PayloadHandler, "_made_ahead", wrong)


def _drops_for_good(patch):
    gave_back = PayloadHandler._gave_back

    def wrong(handler, total):
        before = set(handler._drafts)
        found = gave_back(handler, total)
        for file in before - set(handler._drafts):
            handler.drop(file)
        return found

    patch(PayloadHandler, "_gave_back", wrong)


WRONG = {
    "answers once all are made": (_answers_late, 0),
    "makes none behind a commit": (
        lambda patch: patch(PayloadHandler, "_adopt", _without_want(PayloadHandler._adopt)),
        1,
    ),
    "makes as many as are asked for": (
        lambda patch: patch(payload_handler, "FILES_MAX", 1 << 30),
        2,
    ),
    "looks at no bytes": (lambda patch: patch(payload_handler, "BYTES_MAX", 1 << 60), 2),
    "counts none": (_forgets_to_count, 3),
    "keeps them before history": (
        lambda patch: patch(PayloadHandler, "_gave_back", lambda _handler, _total: False),
        4,
    ),
    "ends a name that its client may use": (_drops_for_good, 5),
    "keeps them for ever": (
        lambda patch: patch(PayloadHandler, "sweep", lambda _handler, _lives, _works: None),
        6,
    ),
    "makes again what was given up": (
        lambda patch: patch(payload_handler.UsedNames, "add", lambda _names, _name: None),
        7,
    ),
}


def _without_want(adopt):
    def wrong(handler, file, size):
        found = adopt(handler, file, size)
        handler.wants_ahead.clear()
        return found

    return wrong


@pytest.mark.parametrize("edit", WRONG)
def test_wrong_edit_of_a_rule_is_found(folder, monkeypatch, edit):
    """By the rule that it breaks."""
    wrong, rule = WRONG[edit]
    wrong(monkeypatch.setattr)

    with pytest.raises(AssertionError):
        RULES[rule](folder)


def test_folder_that_takes_no_file_makes_none_and_says_nothing(folder, monkeypatch):
    """Nobody has asked for it; whoever does hears why."""
    handler = PayloadHandler(folder, 20 * SIZE)
    handler.stage(Stage("ann", "ann-1", 0, SIZE, NOTHING, 2))
    full = SimpleNamespace(**{**vars(os), "posix_fallocate": _no_space})
    monkeypatch.setattr(payload_files, "os", full)
    handler.make_ahead()

    figures = handler.figures()
    assert names(folder) == ["ann-1"]
    assert (figures["payload_bytes"], figures.get("payload_fallbacks", 0)) == (SIZE, 0)
    assert asked(handler, "ann-2").shared is False
    assert handler.figures()["payload_fallbacks"] == 1


def _no_space(*_):
    raise OSError(28, "No space left on device")


def test_request_for_a_file_that_is_being_made_waits_for_it(folder, monkeypatch):
    """Otherwise it would find the name taken, and its data would travel in messages."""
    handler = PayloadHandler(folder, 20 * SIZE)
    begun, go_on = threading.Event(), threading.Event()

    def fallocate(*arguments):
        begun.set()
        assert go_on.wait(30)
        os.posix_fallocate(*arguments)

    handler.stage(Stage("ann", "ann-1", 0, SIZE, NOTHING, 1))
    slow = SimpleNamespace(**{**vars(os), "posix_fallocate": fallocate})
    monkeypatch.setattr(payload_files, "os", slow)
    maker = threading.Thread(target=handler.make_ahead)
    maker.start()
    assert begun.wait(30)
    threading.Timer(0.05, go_on.set).start()

    assert asked(handler, "ann-2", ahead=0) == Staged("ann-2", 0, True)
    maker.join()
    assert "payload_fallbacks" not in handler.figures()


def test_shard_without_a_folder_makes_none():
    """Its clients fill no files."""
    handler = PayloadHandler(None, 20 * SIZE)

    assert asked(handler, ahead=3).shared is False
    assert handler.figures()["payload_drafts"] == 1


# ---------------------------------------------------------------- the client's names


def test_names_rise_in_a_row_for_each_length():
    """Another length has other numbers; the oldest of many lengths is forgotten, not used again."""
    rows = iter(range(1, 100))
    ahead = NamesAhead(rows.__next__)

    assert [ahead.take(size, 0.0)[0] for size in (7, 8, 7)] == [ROW, 2 * ROW, ROW + 1]
    for size in range(100, 100 + ROWS_MAX):
        ahead.take(size, 0.0)
    assert ahead.take(7, 0.0)[0] == (3 + ROWS_MAX) * ROW


def test_client_asks_for_more_when_a_file_is_late_and_starts_afresh_after_a_pause():
    """None for the first of a length, one for the second, and all that it may where that is late."""
    ahead = NamesAhead(iter(range(1, 100)).__next__)
    found = []
    for _ in range(3):
        ready = ahead.take(SIZE, 0.0)[1]
        found.append((ready, ahead.asks(SIZE)))
    assert found == [(False, 0), (False, 1), (True, FILES_MAX)]
    assert ahead.take(SIZE, IDLE_S)[1]
    assert not ahead.take(SIZE, 2 * IDLE_S + 0.1)[1]
    assert ahead.asks(SIZE) == 0

    large = BYTES_MAX // FILES_MAX
    for size, last in ((large, FILES_MAX), (large + 1, 0)):
        assert [(ahead.take(size, 0.0), ahead.asks(size))[1] for _ in range(3)][-1] == last
    assert AheadOf("ann-f", "ann", SIZE, 2).names() == ["ann-10", "ann-11"]


# ---------------------------------------------------------------- a cell


@pytest.fixture(params=["socket", "zenoh"])
def cell(request, make_settings, endpoint, monkeypatch):
    """A cell of one shard; `cell.staged` lists what its client asked for, `cell.restart()`."""
    monkeypatch.setenv("ENACT_CARRIER", request.param)
    settings = DaemonSettings("cell", make_settings("s0", endpoints=(endpoint,)), (endpoint,))
    shard = start_shard(settings)
    found = connect(endpoint)
    payloads, found.staged = found._client.payloads, []
    call = payloads._call

    def noted(name, message):
        found.staged.append(message)
        return call(name, message)

    def restart():
        found.shard.stop(drain_s=0.0)
        found.shard = start_shard(settings)

    payloads._call, found.shard, found.restart = noted, shard, restart
    yield found
    found.close()
    found.shard.stop(drain_s=0.0)


def files_ahead(cell):
    return cell.shard.host.payloads.figures()["files_ahead"]


def published(cell, until, number, *, size=SIZE, settled=True):
    """Commit an image that says which one it is, and read it back."""
    world = cell.world("online")
    write, view = Write(world, CAMERA, IMAGE), View(world, CAMERA, IMAGE)
    with Lock(write) as lock:
        lock[write] = np.full(size, number % 256, np.uint8)
    image = world.view(view)[view]
    assert image.size == size
    assert (image == number % 256).all()
    if settled:
        until(lambda: not cell.shard.host.payloads.wants_ahead)


def test_steps_of_a_camera_need_no_call_for_their_files(cell, until):
    """Two ask; whatever is published then, each has its own content."""
    for number in range(20):
        published(cell, until, number)
        ready = min(number, 1)
        until(lambda ready=ready: files_ahead(cell) == ready)

    assert [message.ahead for message in cell.staged] == [0, 1]
    figures = {one.name: one for one in cell.shards()}["s0"].counters
    assert (figures["payloads_adopted"], figures["files_ahead_used"]) == (20, 18)
    assert (figures["files_ahead"], figures["files_ahead_bytes"]) == (1, SIZE)
    assert "payload_fallbacks" not in cell.statistics()


def test_file_that_is_gone_is_asked_for(cell, until):
    """The shard has given them up; the client finds none, and goes on."""
    for number in range(3):
        published(cell, until, number)
    cell.shard.host.payloads.sweep(lambda _: False, lambda _: False)
    assert leftovers().wait(30)
    published(cell, until, 3)

    assert len(cell.staged) == 3
    assert "payload_fallbacks" not in cell.statistics()


@pytest.mark.parametrize("lengths", [2, ROWS_MAX + 1, 30])
def test_datum_of_ever_other_lengths_has_its_own_bytes(cell, until, lengths):
    """Some are used again soon, some are forgotten meanwhile, some never come again."""
    for number in range(30):
        published(cell, until, number, size=SIZE + 64 * (number % lengths))

    assert cell.shard.host.payloads.figures()["payloads_adopted"] == 30
    assert "payload_fallbacks" not in cell.statistics()


@pytest.mark.parametrize("size", [SIZE, BYTES_MAX // FILES_MAX])
def test_file_that_goes_while_it_is_filled_costs_no_datum(cell, until, size):
    """The commit names what is not there any more; then its bytes come, apart where they are many."""
    for number in range(3):
        published(cell, until, number, size=size)
    world = cell.world("online")
    write, view = Write(world, CAMERA, IMAGE), View(world, CAMERA, IMAGE)
    with Lock(write) as lock:
        lock[write] = np.full(size, 77, np.uint8)
        cell.shard.host.payloads.sweep(lambda _: False, lambda _: False)

    assert (world.view(view)[view] == 77).all()
    assert cell.shard.host.payloads.figures()["payloads_missing"] == 1


def test_restart_of_the_shard_ends_all_files_ahead(cell, until):
    """The next start has a folder of its own, and numbers that no start has seen."""
    for number in range(3):
        published(cell, until, number)
    before = {message.file for message in cell.staged}
    cell.restart()
    cell.create_world("online")
    for number in range(3, 6):
        published(cell, until, number)

    assert [message.ahead for message in cell.staged] == [0, 1, 0, 1]
    assert len({message.file for message in cell.staged} - before) == 2


def test_threads_that_publish_at_once_share_no_file(cell, until):
    """Each has its own name, whoever commits first."""
    world, failed = cell.world("online"), []

    def publish(mine):
        write = Write(world, Entity(f"camera/{mine}"), IMAGE)
        view = View(world, Entity(f"camera/{mine}"), IMAGE)
        for number in range(20):
            with Lock(write) as lock:
                lock[write] = np.full(SIZE, mine * 40 + number, np.uint8)
            if not (world.view(view)[view] == mine * 40 + number).all():
                failed.append((mine, number))

    threads = [threading.Thread(target=publish, args=(mine,)) for mine in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert failed == []
    assert cell.shard.host.payloads.figures()["payloads_adopted"] == 80
    assert "payloads_missing" not in cell.shard.host.payloads.figures()


def test_session_that_ends_leaves_no_file(cell, until):
    """Unused ones go with it, and are no sign of a client that died."""
    for number in range(3):
        published(cell, until, number)
    until(lambda: files_ahead(cell) == 1)
    cell.close()

    until(lambda: files_ahead(cell) == 0)
    figures = cell.shard.host.payloads.figures()
    assert (figures["files_ahead_removed"], figures.get("drafts_swept", 0)) == (1, 0)
