"""Payloads at a shard: drafts, their adoption by a commit, and when the files go."""

import errno
import os
import stat
from types import SimpleNamespace

import pytest
from payload_drafts import (
    FILE,
    NOTHING,
    SESSION,
    SIZE,
    adopted,
    commit_of,
    fill,
    names,
    stage,
)

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import NO_ROOM, Refused, Stage, Staged
from enact_dist.link.memory import payload_files, payload_handler
from enact_dist.link.memory.maps import leftovers
from enact_dist.link.memory.payload_handler import PayloadHandler
from enact_dist.testing import ManualClock


@pytest.fixture(params=["file", "memory"])
def handler(request, folder):
    """A handler with a shared folder, and one without."""
    return PayloadHandler(folder if request.param == "file" else None, 10 * SIZE)


# ---------------------------------------------------------------- drafts


def test_draft_is_a_whole_file_that_clients_may_fill(folder):
    """Its blocks are there before anybody maps it, and only its user gets at it."""
    handler = PayloadHandler(folder, 10 * SIZE)

    assert stage(handler) == Staged(FILE, 0, True)

    found = (folder.path / FILE).stat()
    assert (found.st_size, stat.S_IMODE(found.st_mode)) == (SIZE, 0o600)
    assert found.st_blocks * 512 >= SIZE


@pytest.mark.parametrize("where", ["file", "memory"])
def test_client_beyond_its_share_gives_way_to_one_within(folder, where):
    """Staged on and on and never committed: the oldest drafts go, and their commits are told."""
    handler = PayloadHandler(folder if where == "file" else None, 8 * SIZE)
    for number in range(8):
        assert isinstance(stage(handler, f"hog-{number:x}", body=bytes(SIZE)), Staged)
    beyond = stage(handler, "hog-8")
    modest = [stage(handler, f"modest-{number:x}", body=bytes(SIZE)) for number in range(3)]

    assert isinstance(beyond, Refused)
    assert [type(answer) for answer in modest] == [Staged, Staged, Refused]
    assert handler.figures()["drafts_displaced"] == 2
    assert not adopted(handler, "hog-0", session="hog").body
    assert len(adopted(handler, "hog-7", session="hog").body) == SIZE
    assert len(adopted(handler, "modest-1", session="modest").body) == SIZE


def test_share_is_that_of_the_client_and_not_of_each_of_its_sessions(folder):
    """Many sessions of one client take one share."""
    handler = PayloadHandler(folder, 8 * SIZE)
    for number in range(8):
        file = f"s{number}-1"
        message = Stage(f"s{number}", file, 0, SIZE, Datum(b"", bytes(SIZE), SIZE))
        assert isinstance(handler.stage(message, "hog@h:1"), Staged)
    more = Stage("s9", "s9-1", 0, SIZE, NOTHING)

    assert isinstance(handler.stage(more, "hog@h:1"), Refused)
    assert isinstance(handler.stage(more, "modest@h:2"), Staged)


def test_draft_that_is_asked_for_again_is_the_same(handler):
    """The answer to the first request may be lost."""
    stage(handler, body=b"x" * 1000)

    assert stage(handler) == stage(handler)
    assert stage(handler).have == 1000
    assert handler.figures()["payload_drafts"] == 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"session": "other"}, "no payload of session other"),
        ({"file": "../up-1", "session": "../up"}, "no payload"),
        ({"file": "nonce"}, "no payload"),
        ({"total": (1 << 30) + 1}, "at most 1073741824"),
        ({"total": -1}, "at most 1073741824"),
        ({"offset": SIZE, "body": b"x"}, "a slice up to 100001"),
        ({"offset": -1, "body": b"x"}, "a slice up to 0"),
    ],
)
def test_draft_that_cannot_be_is_refused(handler, options, said):
    """Names of other sessions or files, lengths below the limit, bytes outside."""
    answer = stage(handler, **options)

    assert isinstance(answer, Refused)
    assert said in answer.text


def test_draft_has_one_length(handler):
    """A second opinion about it is a mistake of the client."""
    stage(handler)

    assert "has 100000 bytes, not 100001" in stage(handler, total=SIZE + 1).text


def test_slices_may_be_repeated_and_tell_how_far_they_came(handler):
    """A slice whose answer was lost comes again; one beyond a hole counts when the hole closes."""
    half = SIZE // 2
    assert stage(handler, body=b"a" * half).have == half
    assert stage(handler, body=b"a" * half).have == half
    assert stage(handler, offset=half + 100, body=b"c" * 100).have == half

    assert adopted(handler).body == b"", "there is a hole in it"
    assert stage(handler, offset=half, body=b"b" * half).have == SIZE
    assert bytes(adopted(handler).body) == b"a" * half + b"b" * half


def test_slice_that_came_before_the_first_makes_no_whole(handler):
    """Nothing at its begin looks like a file that its client has filled."""
    stage(handler, offset=SIZE // 2, body=b"b" * (SIZE // 2))

    assert adopted(handler).body == b""


def test_draft_that_is_given_up_leaves_nothing(folder):
    """Neither file nor count; its name is not used again."""
    handler = PayloadHandler(folder, 10 * SIZE)
    stage(handler)

    assert stage(handler, total=0) == Staged(FILE, 0, False)

    assert names(folder) == []
    assert handler.figures()["payload_bytes"] == 0


def test_drafts_end_with_their_session(folder):
    """A client that is gone commits no more."""
    handler = PayloadHandler(folder, 10 * SIZE)
    stage(handler, "gone-1")
    stage(handler, "idle-1")

    handler.sweep({"idle"}.__contains__, {"idle"}.__contains__)

    assert names(folder) == ["idle-1"]
    assert handler.figures()["drafts_swept"] == 1


def test_drafts_end_after_a_time_without_a_slice(folder):
    """To the nanosecond, by the clock that the handler was given; one that works takes its time."""
    clock = ManualClock()
    handler = PayloadHandler(folder, 10 * SIZE, clock=clock)
    for file in ("idle-1", "late-1", "busy-1"):
        stage(handler, file)
    live, works = {"idle", "late", "busy"}.__contains__, {"busy"}.__contains__
    clock.advance(20.0)
    stage(handler, "late-1", offset=0, body=b"s" * (SIZE // 2))
    clock.advance(10.0)

    handler.sweep(live, works)
    assert names(folder) == ["busy-1", "idle-1", "late-1"]

    clock.advance(1e-9)
    handler.sweep(live, works)
    assert names(folder) == ["busy-1", "late-1"]

    clock.advance(20.0)
    handler.sweep(live, works)
    assert names(folder) == ["busy-1"]
    assert handler.figures()["drafts_swept"] == 2


def test_draft_that_was_given_up_and_comes_again_is_not_counted_for_ever(folder, monkeypatch):
    """Its file is gone and its bytes are still counted when its client sends the next slice."""
    handler, ended = PayloadHandler(folder, 10 * SIZE), []

    def unlink(file, *, dir_fd):
        os.unlink(file, dir_fd=dir_fd)
        ended.append(file)
        if len(ended) == 1:
            stage(handler)

    monkeypatch.setattr(payload_files, "os", SimpleNamespace(**{**vars(os), "unlink": unlink}))
    stage(handler)
    for _ in range(2):
        handler.sweep(lambda _: False, lambda _: False)
        assert leftovers().wait(5.0)

    figures = handler.figures()
    assert ended
    assert names(folder) == []
    assert (figures["payload_bytes"], figures["payload_files"]) == (0, 0)


def test_slice_of_a_payload_that_is_dropped_meanwhile_makes_no_draft(handler):
    """Its client gives it up between the look at its name and the opening."""
    given_up = []

    class Drafts(dict):
        def get(self, file):
            if not given_up:
                given_up.append(file)
                stage(handler, total=0)
            return super().get(file)

    handler._drafts = Drafts()

    assert stage(handler) == Staged(FILE, SIZE, False)

    assert handler.drafts() == {}
    assert leftovers().wait(5.0)
    assert handler.figures()["payload_bytes"] == 0


# ---------------------------------------------------------------- adoption


def test_commit_gets_the_bytes_that_its_client_has_filled(folder):
    """The body is the file itself, which nobody may write any more."""
    handler = PayloadHandler(folder, 10 * SIZE)
    stage(handler)
    fill(folder, b"x" * SIZE)

    datum = adopted(handler)

    assert (datum.file, datum.size, datum.stamp_ns) == (FILE, SIZE, 7)
    assert bytes(datum.body) == b"x" * SIZE
    assert datum.body.readonly
    assert stat.S_IMODE((folder.path / FILE).stat().st_mode) == 0o400


def test_payload_in_plain_memory_has_no_name_for_others():
    """Nobody could map it: readers fetch it."""
    handler = PayloadHandler(None, 10 * SIZE)
    stage(handler, body=b"x" * SIZE)

    datum = adopted(handler)

    assert (datum.file, bytes(datum.body)) == ("", b"x" * SIZE)


def test_repeated_commit_gets_the_same_bytes(folder):
    """The first copy's answer may be lost."""
    handler = PayloadHandler(folder, 10 * SIZE)
    stage(handler)
    fill(folder, b"x" * SIZE)
    first = adopted(handler)

    again = adopted(handler)

    assert (again, bytes(again.body[:3])) == (first, b"xxx")


@pytest.mark.parametrize(
    "options",
    [{"file": f"{SESSION}-2"}, {"size": SIZE - 1}, {"size": SIZE + 1}, {"session": "other"}],
)
def test_commit_of_what_is_not_there_stays_without_bytes(handler, options):
    """Another name, another length or somebody else's: the shard then asks for the bytes."""
    stage(handler, body=b"x" * SIZE)

    assert adopted(handler, **options).body == b""
    assert handler.figures()["payloads_missing"] == 1


def test_commit_that_brings_its_bytes_is_left_alone(handler):
    """In one process the datum has a name and its bytes."""
    commit = commit_of(body=b"x" * SIZE)

    assert handler.with_bodies(commit).writes == commit.writes


def test_file_goes_with_the_last_datum_and_reader(folder):
    """Slices of a body, such as arrays, keep it; a map of another process keeps the content."""
    handler = PayloadHandler(folder, 10 * SIZE)
    stage(handler)
    fill(folder, b"x" * SIZE)
    datum = adopted(handler)
    part = datum.body[10:20]

    del datum
    assert names(folder) == [FILE]
    assert handler.figures()["payload_bytes"] == SIZE
    del part
    assert names(folder) == []
    assert handler.figures()["payload_bytes"] == handler.figures()["payload_files"] == 0
    assert adopted(handler).body == b"", "a late copy finds nothing"


def test_draft_whose_file_somebody_has_removed_is_no_payload(folder):
    """Its bytes come again with the commit; whoever serves all clients does not fail of it."""
    handler = PayloadHandler(folder, 10 * SIZE)
    stage(handler)
    (folder.path / FILE).unlink()

    assert adopted(handler).body == b""

    assert leftovers().wait(30)
    assert handler.figures()["payloads_missing"] == 1
    assert handler.figures()["payload_bytes"] == 0


def test_system_without_memory_refuses_a_payload_by_name(monkeypatch):
    """It is an answer, not the end of the thread that takes the slices."""

    def none_left(*_, **__):
        raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))

    monkeypatch.setattr(payload_handler, "plain_memory", none_left)

    answer = stage(PayloadHandler(None, 10 * SIZE))

    assert (answer.code, "Cannot allocate memory" in answer.text) == (NO_ROOM, True)


def test_payload_never_changes_once_a_commit_has_it(handler, monkeypatch):
    """While a second copy of a slice, with other bytes, is being taken, a commit gets nothing."""
    stage(handler, body=b"a" * (SIZE - 1))
    seen, inside = [], payload_handler.body_of

    def body_of(memory):
        if not seen:  # the second copy is about to be written
            seen.append(None)
            stage(handler, offset=SIZE - 1, body=b"a")
            found = adopted(handler)
            seen[:] = [found, bytes(found.body)]
        return inside(memory)

    monkeypatch.setattr(payload_handler, "body_of", body_of)
    stage(handler, offset=SIZE - 1, body=b"b")

    assert bytes(seen[0].body) == seen[1]
    found = adopted(handler)
    whole = bytes(found.body)
    assert len(whole) == SIZE
    stage(handler, offset=1, body=b"d" * 10)
    assert bytes(found.body) == whole


def test_slice_that_is_here_already_is_not_written_again(handler):
    """The first copy counts: a later one with other bytes changes nothing."""
    stage(handler, body=b"a" * (SIZE - 1))
    stage(handler, body=b"b" * 10)
    stage(handler, offset=SIZE - 1, body=b"a")

    assert bytes(adopted(handler).body) == b"a" * SIZE
