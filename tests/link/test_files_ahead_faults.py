"""Files ahead under faults, at the handler alone: what is removed, late, full, or asked for wrongly."""

import errno
import itertools
import os
import random
import threading
from types import SimpleNamespace

import pytest
from payload_drafts import NOTHING, SIZE, adopted, names
from test_files_ahead import asked, committed

from enact_dist.core.protocol.messages import Stage, Staged
from enact_dist.link.memory import payload_files
from enact_dist.link.memory.ahead import BYTES_MAX, FILES_MAX, ROW_BITS, NamesAhead
from enact_dist.link.memory.maps import leftovers
from enact_dist.link.memory.names import UsedNames
from enact_dist.link.memory.payload_handler import PayloadHandler
from enact_dist.testing import ManualClock

LIVE = frozenset({"ann", "eve"}).__contains__


def took_back_for_room(handler):
    """Another client asks for most of the room, and gives it up."""
    asked(handler, "eve-1", ahead=0, total=19 * SIZE)
    handler.drop("eve-1")
    assert leftovers().wait(30)


def took_back_after_a_time(handler):
    """No lock was seen when the shard looked."""
    handler._clock.advance(30.1)
    handler.sweep(LIVE, lambda _: False)
    assert leftovers().wait(30)


@pytest.mark.parametrize("took_back", [took_back_for_room, took_back_after_a_time])
def test_file_that_its_client_fills_does_not_come_again_empty(folder, took_back):
    """Of two threads one still fills a file that the shard takes back; the other one commits."""
    handler = PayloadHandler(folder, 20 * SIZE, clock=ManualClock())
    asked(handler, "ann-1", ahead=FILES_MAX)
    with (folder.path / "ann-3").open("r+b") as opened:
        took_back(handler)
        asked(handler, "ann-2", ahead=FILES_MAX)
        shown = committed(handler, 2)
        opened.write(b"x" * SIZE)

        found = committed(handler, 3)

    assert len(shown.body) == SIZE
    assert found.body == b"", "the file of this name has none of its bytes"
    assert asked(handler, "ann-3", ahead=0) == Staged("ann-3", 0, True), "its client may ask for it"


class AskedFor:
    """A lock that says when somebody waits for it."""

    def __init__(self):
        self.lock, self.waited = threading.Lock(), threading.Event()
        self.acquire, self.release = self.lock.acquire, self.lock.release

    def __enter__(self):
        self.waited.set()
        self.lock.acquire()

    def __exit__(self, *_):
        self.lock.release()


def test_file_is_adopted_that_its_client_found_before_the_handler_knew_it(folder, monkeypatch):
    """A file has a name as soon as it is made, and a client of another process may be quick."""
    handler, made, go_on, shown = (
        PayloadHandler(folder, 60 * SIZE),
        threading.Event(),
        threading.Event(),
        [],
    )
    handler.stage(Stage("ann", "ann-1", 0, SIZE, NOTHING, ahead=1))
    handler._opening = (opening,) = (AskedFor(),)
    make = payload_files.PayloadFiles.make

    def slowly(*arguments):
        memory = make(*arguments)
        made.set()
        assert go_on.wait(30)
        return memory

    monkeypatch.setattr(payload_files.PayloadFiles, "make", slowly)
    maker = threading.Thread(target=handler.make_ahead)
    maker.start()
    assert made.wait(30)
    with (folder.path / "ann-2").open("r+b") as opened:
        opened.write(b"x" * SIZE)
    client = threading.Thread(target=lambda: shown.append(committed(handler, 2)))
    client.start()
    assert opening.waited.wait(30)
    go_on.set()
    client.join(30)
    maker.join(30)

    assert bytes(shown[0].body) == b"x" * SIZE
    assert "payloads_missing" not in handler.figures()


def test_files_end_with_their_row(folder):
    """Behind it are the payloads of another length, which would find files of the wrong one."""
    handler = PayloadHandler(folder, 60 * SIZE)
    last = (1 << ROW_BITS) - 3
    asked(handler, f"ann-{last:x}", ahead=FILES_MAX)
    asked(handler, f"eve-{(1 << 64) - 1:x}", ahead=FILES_MAX)

    assert names(folder) == [f"ann-{last + n:x}" for n in range(3)] + [f"eve-{(1 << 64) - 1:x}"]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_files_ahead_go_before_a_full_folder_costs_a_datum_its_place(folder, monkeypatch, code):
    """Others fill the file system, whatever this shard's own limit says."""
    handler = PayloadHandler(folder, 60 * SIZE)
    asked(handler, "ann-1", ahead=3)

    def fallocate(*arguments):
        if len(list(folder.path.glob("*-*"))) > 4:
            raise OSError(code, os.strerror(code))
        os.posix_fallocate(*arguments)

    full = SimpleNamespace(**{**vars(os), "posix_fallocate": fallocate})
    monkeypatch.setattr(payload_files, "os", full)

    assert asked(handler, "eve-1", ahead=0) == Staged("eve-1", 0, True)
    figures = handler.figures()
    assert (figures["files_ahead"], figures["files_ahead_removed"]) == (2, 1)
    assert (figures["payload_bytes"], figures.get("payload_fallbacks", 0)) == (4 * SIZE, 0)


def test_nearly_full_file_system_gets_no_files_ahead(folder, monkeypatch):
    """Several shards share it, and each may have less than its limit."""
    handler = PayloadHandler(folder, 60 * SIZE)
    left = {"f_bavail": 249, "f_blocks": 1000}
    near = SimpleNamespace(**{**vars(os), "fstatvfs": lambda _: SimpleNamespace(**left)})
    monkeypatch.setattr(payload_files, "os", near)
    asked(handler, "ann-1", ahead=1)
    assert names(folder) == ["ann-1"]

    left["f_bavail"] = 250
    asked(handler, "ann-1", ahead=2)
    assert names(folder) == ["ann-1", "ann-2", "ann-3"]


def test_file_that_has_yet_to_disappear_is_asked_for(folder):
    """It is large, so that another thread frees it: who asks in that moment waits for it."""
    size = 1 << 20
    handler = PayloadHandler(folder, 60 * size)
    asked(handler, "ann-1", ahead=1, total=size)
    assert leftovers().wait(30)
    go_on = threading.Event()
    leftovers().later(go_on.wait, 30.0)
    handler.sweep({"eve"}.__contains__, lambda _: False)
    assert (folder.path / "ann-2").exists()
    threading.Timer(0.05, go_on.set).start()

    assert asked(handler, "ann-2", ahead=0, total=size) == Staged("ann-2", 0, True)
    assert "payload_fallbacks" not in handler.figures()


def test_client_that_waits_for_room_holds_up_no_files_of_another(folder):
    """The names of the two fall under one mutex; the files are made behind the next commit."""
    waits, go_on = threading.Event(), threading.Event()

    def make_room(_):
        waits.set()
        assert go_on.wait(30)

    handler = PayloadHandler(folder, 20 * SIZE, make_room=make_room)
    pairs = ((f"ann-{number:x}", f"ann-{number + 1:x}") for number in range(1, 1000))
    first, behind = next(pair for pair in pairs if (hash(pair[0]) - hash(pair[1])) % 16)
    numbers = (f"eve-{number:x}" for number in range(1, 1000))
    slow = next(name for name in numbers if (hash(name) - hash(behind)) % 16 == 0)
    waiter = threading.Thread(target=asked, args=(handler, slow, 0, 21 * SIZE))
    waiter.start()
    assert waits.wait(30)
    asked(handler, first, ahead=1)
    assert not (folder.path / behind).exists()
    go_on.set()
    waiter.join()

    asked(handler, first, ahead=2)
    assert (folder.path / behind).exists()


def test_file_that_is_given_up_is_followed_by_another(folder):
    """A block that fails after it has filled one costs the next no call."""
    handler = PayloadHandler(folder, 60 * SIZE)
    asked(handler, "ann-1", ahead=1)
    for number in range(2, 5):
        handler.stage(Stage("ann", f"ann-{number:x}", 0, 0, NOTHING))
        handler.make_ahead()

    assert names(folder) == ["ann-1", "ann-5"]


def test_client_that_cannot_open_its_files_asks_for_no_more():
    """Its folder is read-only: files made ahead would be made for nobody."""
    ahead, asks = NamesAhead(iter(range(1, 100)).__next__), []
    for _ in range(5):
        ahead.take(SIZE, 0.0)
        asks.append(ahead.asks(SIZE))
        ahead.unusable(SIZE)

    assert asks == [0] * 5


@pytest.mark.parametrize("size", [1, 65_536, 65_537, BYTES_MAX // FILES_MAX, BYTES_MAX, 1 << 26])
def test_length_at_each_limit_leaves_nothing(folder, size):
    """Small ones lie in memory and have none ahead; the largest are alone."""
    handler = PayloadHandler(folder, 1 << 30)
    answer = asked(handler, "ann-1", ahead=FILES_MAX, total=size)
    ahead = min(FILES_MAX, BYTES_MAX // size - 1) if size > 65_536 and size < BYTES_MAX else 0
    assert (answer.shared, handler.figures()["files_ahead"]) == (size > 65_536, ahead)
    assert asked(handler, "ann-1", ahead=FILES_MAX, total=0) == Staged("ann-1", 0, False)

    handler.sweep(lambda _: False, lambda _: False)
    figures = (
        names(folder),
        *(handler.figures()[f"payload_{name}"] for name in ("bytes", "files")),
    )
    assert figures == ([], 0, 0)


class Threads:
    """The threads of a client: each opens its file, or asks for it, fills it, and commits late."""

    def __init__(self, handler, folder, rng):
        self.handler, self.folder, self.rng = handler, folder, rng
        self.ahead, self.filled = NamesAhead(iter(range(1, 1000)).__next__), {}
        self.own = self.missing = 0

    def fill(self):
        number, ready = self.ahead.take(SIZE, 0.0)
        file = f"ann-{number:x}"
        if not (ready and (self.folder.path / file).exists()):
            answer = asked(self.handler, file, ahead=self.ahead.asks(SIZE))
            if not isinstance(answer, Staged) or not answer.shared:
                return
        self.filled[file] = (self.folder.path / file).open("r+b")

    def commit(self):
        """Fill the rest of any file, and see that a commit has these bytes or none."""
        file = self.rng.choice(sorted(self.filled))
        content = file.encode().ljust(SIZE, b".")
        with self.filled.pop(file) as opened:
            opened.write(content)
        found = bytes(committed(self.handler, int(file[4:], 16)).body)
        assert found in (b"", content), f"{file} has bytes of its own"
        self.own, self.missing = self.own + bool(found), self.missing + (not found)


def commits_have_their_own_bytes(folder, seed):
    """Four threads at once, others that need the room, and a shard that looks for idle ones."""
    rng, clock = random.Random(seed), ManualClock()
    handler = PayloadHandler(folder, 20 * SIZE, clock=clock)
    threads, others = Threads(handler, folder, rng), itertools.count(1)
    for _ in range(600):
        act = rng.randrange(10)
        if act < 4 and len(threads.filled) < 4:
            threads.fill()
        elif act < 8 and threads.filled:
            threads.commit()
        elif act == 8:
            file = f"eve-{next(others):x}"
            asked(handler, file, ahead=0, total=rng.randrange(8, 19) * SIZE)
            handler.drop(file)
            assert leftovers().wait(30)
        elif rng.random() < 0.2:
            clock.advance(31.0)
            handler.sweep(LIVE, lambda _: False)
            assert leftovers().wait(30)
        handler.make_ahead()
    for opened in threads.filled.values():
        opened.close()
    assert min(threads.own, threads.missing, handler.figures()["files_ahead_used"]) > 5


@pytest.mark.parametrize("seed", range(3))
def test_commit_has_the_bytes_of_its_client_or_none(folder, seed):
    """Whatever is taken back meanwhile; without bytes they come with the commit."""
    commits_have_their_own_bytes(folder, seed)


def test_wrong_edit_that_makes_a_file_again_is_found(folder, monkeypatch):
    """What was taken back is forgotten at once."""
    remove = PayloadHandler._remove

    def wrong(handler, files):
        gone = remove(handler, files)
        handler._taken_back = UsedNames()
        return gone

    monkeypatch.setattr(PayloadHandler, "_remove", wrong)
    with pytest.raises(AssertionError, match="has bytes of its own"):
        for seed in range(3):
            commits_have_their_own_bytes(folder, seed)


def _step(handler, folder, rng, clock, numbers, shown):
    """Do one thing that a client, the shard or the system might do."""
    session = rng.choice(("ann", "bob", "eve"))
    number = numbers[session]
    file, size = f"{session}-{number:x}", rng.choice((SIZE, SIZE, 70_000, 300_000))
    act = rng.randrange(9)
    if act < 3:
        asked(handler, file, ahead=rng.randrange(9), total=size)
    elif act < 6 and (folder.path / file).exists():
        numbers[session] += 1
        length = (folder.path / file).stat().st_size
        shown.append(adopted(handler, file, size=length, session=session))
        del shown[: rng.randrange(len(shown) + 1)]
    elif act == 6:
        numbers[session] += 1
        handler.stage(Stage(session, file, 0, 0, NOTHING))
    elif act == 7:
        clock.advance(rng.choice((1.0, 40.0)))
        handler.sweep({"ann", "bob"}.__contains__, {"ann"}.__contains__)
    else:
        (folder.path / file).unlink(missing_ok=True)  # somebody has cleared the folder
    if rng.random() < 0.8:
        handler.make_ahead()


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_left_after_a_thousand_rounds_of_faults(folder, monkeypatch, seed):
    """No file, no byte of the share, no draft; and the counts agree with the folder all along."""
    rng, clock, shown = random.Random(seed), ManualClock(), []

    def fallocate(*arguments):
        if rng.random() < 0.1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.posix_fallocate(*arguments)

    full = SimpleNamespace(**{**vars(os), "posix_fallocate": fallocate})
    monkeypatch.setattr(payload_files, "os", full)
    handler = PayloadHandler(folder, 30 * SIZE, make_room=lambda _: shown.clear(), clock=clock)
    numbers = dict.fromkeys(("ann", "bob", "eve"), 1)
    for _ in range(1000):
        _step(handler, folder, rng, clock, numbers, shown)
        figures = handler.figures()
        assert 0 <= figures["files_ahead_bytes"] <= figures["payload_bytes"] <= 30 * SIZE
    counted = handler.figures()
    for counter in ("files_ahead_used", "files_ahead_removed", "payload_fallbacks"):
        assert counted[counter] > 0

    shown.clear()
    handler.sweep(lambda _: False, lambda _: False)
    left = names(folder)
    figures = handler.figures()
    assert (left, figures["payload_bytes"], figures["payload_files"]) == ([], 0, 0)
    assert (figures["payload_drafts"], figures["files_ahead"]) == (0, 0)
