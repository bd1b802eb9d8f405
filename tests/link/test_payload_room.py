"""The cap of a shard's payloads: who gives way, and what a full folder or no memory costs."""

import errno
import os

import pytest
from payload_drafts import (
    FILE,
    SESSION,
    SIZE,
    adopted,
    names,
    stage,
)

from enact_dist.core.protocol.messages import NO_ROOM, Refused, Staged
from enact_dist.link.memory.maps import leftovers
from enact_dist.link.memory.payload_handler import PayloadHandler
from enact_dist.testing import ManualClock


def test_payload_over_the_cap_is_refused_by_name(folder):
    """Nothing is made; the text says what was asked, what is there, who has it, what to do."""
    handler = PayloadHandler(
        folder, 2 * SIZE, biggest=lambda: "; the largest: online:arm/cloud 100000"
    )
    stage(handler, "a-1")
    stage(handler, "a-2")

    answer = stage(handler, "b-1")

    assert isinstance(answer, Refused)
    assert answer.code == NO_ROOM
    for part in (
        "100000 bytes",
        "200000 of at most 200000",
        "online:arm/cloud",
        "shared_bytes_max",
    ):
        assert part in answer.text
    assert names(folder) == ["a-1", "a-2"]
    assert handler.figures()["payloads_refused"] == 1


def test_history_goes_before_a_payload_is_refused(folder):
    """The shard is asked for room once, and its files are waited for."""
    kept = []
    handler = PayloadHandler(folder, 2 * SIZE, make_room=lambda _: kept.pop(0))
    for number in (1, 2):
        stage(handler, f"{SESSION}-{number}", body=b"x" * SIZE)
        kept.append(adopted(handler, f"{SESSION}-{number}"))

    assert stage(handler, f"{SESSION}-3") == Staged(f"{SESSION}-3", 0, True)
    assert names(folder) == [f"{SESSION}-2", f"{SESSION}-3"]


def test_room_that_another_payload_takes_first_is_made_again(folder):
    """Cameras come at one moment: what goes for one of them may be had by the next."""
    kept, asked = [], []

    def make_room(size):
        asked.append(size)
        kept.pop(0)
        if len(asked) == 1:
            assert stage(handler, next_one) == Staged(next_one, 0, True)

    handler = PayloadHandler(folder, 2 * SIZE, make_room=make_room)
    # One that is opened under the same mutex would wait, here for its own thread.
    mutexes = len(handler._opening)
    others = (f"{SESSION}-{number}" for number in range(4, 1000))
    next_one = next(o for o in others if (hash(o) - hash(f"{SESSION}-3")) % mutexes)
    for number in (1, 2):
        stage(handler, f"{SESSION}-{number}", body=b"x" * SIZE)
        kept.append(adopted(handler, f"{SESSION}-{number}"))

    assert stage(handler, f"{SESSION}-3") == Staged(f"{SESSION}-3", 0, True)
    assert asked == [SIZE, 2 * SIZE]
    assert names(folder) == sorted([f"{SESSION}-3", next_one])


def test_room_that_comes_and_goes_by_itself_ends_no_search_for_more(folder, monkeypatch):
    """Nothing had to go for it then, which does not mean that history has nothing to give."""
    kept, asked = [], []

    def make_room(size):
        asked.append(size)
        kept.clear()

    handler = PayloadHandler(folder, 2 * SIZE, make_room=make_room)
    stage(handler, f"{SESSION}-1", body=b"x" * SIZE)
    kept.append(adopted(handler, f"{SESSION}-1"))
    stage(handler, f"{SESSION}-2")
    take, looks = handler._reserved, []

    def reserved(total):
        looks.append(total)
        if len(looks) == 2:
            assert take(total)  # another payload is faster
        found = take(total)
        if len(looks) == 1:
            handler.drop(f"{SESSION}-2")
            assert leftovers().wait(30)
        return found

    monkeypatch.setattr(handler, "_reserved", reserved)
    assert stage(handler, f"{SESSION}-3") == Staged(f"{SESSION}-3", 0, True)
    assert (asked, len(looks)) == ([SIZE], 3)


def test_client_that_asks_again_and_again_delays_nobody(folder):
    """History is looked through once for what cannot fit; what is smaller is another matter."""
    asked = []
    handler = PayloadHandler(folder, SIZE, make_room=asked.append)
    for number in range(5):
        assert stage(handler, f"a-{number}", total=2 * SIZE).code == NO_ROOM

    assert asked == [SIZE]
    stage(handler, "b-1")
    assert stage(handler, "b-2").code == NO_ROOM
    assert asked == [SIZE, SIZE]


def test_cap_that_nobody_has_set_refuses_nothing(folder):
    """What is beyond half of a small folder lies in plain memory, and the next small one there."""
    handler = PayloadHandler(folder, 2 * SIZE, firm=False)

    assert stage(handler, "a-1", total=3 * SIZE) == Staged("a-1", 0, False)
    assert stage(handler, "a-2") == Staged("a-2", 0, True)
    assert names(folder) == ["a-2"]


def test_drafts_in_plain_memory_are_bounded():
    """A client that stages and never commits cannot fill the shard."""
    handler = PayloadHandler(None, 2 * SIZE)
    for number in (1, 2):
        assert isinstance(stage(handler, f"a-{number}"), Staged)

    assert stage(handler, "a-3").code == NO_ROOM
    stage(handler, "a-2", total=0)
    assert isinstance(stage(handler, "a-3"), Staged)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES])
def test_folder_that_takes_no_file_costs_no_commit(folder, monkeypatch, code):
    """The bytes then come in slices and lie in plain memory; it is counted."""

    def refuse(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    handler = PayloadHandler(folder, 10 * SIZE)

    assert stage(handler, body=b"x" * SIZE) == Staged(FILE, SIZE, False)

    assert bytes(adopted(handler).body) == b"x" * SIZE
    assert names(folder) == []
    assert handler.figures()["payload_fallbacks"] == 1


def test_full_folder_is_told_once_a_minute(folder, monkeypatch, caplog):
    """A camera would fill the log with it; each payload is counted all the same."""

    def refuse(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    clock = ManualClock()
    handler = PayloadHandler(folder, 10 * SIZE, clock=clock)
    said = (
        f"large data go over the network because the shared folder {folder.path} takes none:"
        " No space left on device"
    )

    for number in (1, 2, 3):
        stage(handler, f"a-{number}")
    assert caplog.messages == [said]

    clock.advance(61.0)
    stage(handler, "a-4")
    assert caplog.messages == [said, said]
    assert handler.figures()["payload_fallbacks"] == 4
