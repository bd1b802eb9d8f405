"""Slices that come late, twice or without those before them: no half payload, no draft of the past."""

from __future__ import annotations

import pytest

from enact_dist.core.protocol.datum import Datum, LockId, Slot, Token
from enact_dist.core.protocol.messages import Commit, Stage, Staged, WriteItem
from enact_dist.link.memory.names import NUMBERS_MAX
from enact_dist.link.memory.payload_handler import PayloadHandler
from enact_dist.link.memory.shared_folder import SharedFolder

SIZE = 100_000
SESSION = "a1b2c3"
FILE = f"{SESSION}-1"
HALF = bytes(range(250)) * (SIZE // 500)


@pytest.fixture
def folder(tmp_path):
    """A shared folder of one shard."""
    made = SharedFolder("cell", "s0", root=tmp_path)
    yield made
    made.close()


def staged(handler, offset, body, *, file=FILE, total=SIZE):
    """Bring one slice."""
    answer = handler.stage(Stage(SESSION, file, offset, total, Datum(b"", body, len(body))))
    assert isinstance(answer, Staged), answer
    return answer


def adopted(handler, file=FILE):
    """Return the bytes that a commit of this payload gets."""
    write = WriteItem(Slot("online", "arm", "cloud"), Datum(b"\x01", b"", SIZE, 7, file))
    (found,) = handler.with_bodies(Commit(LockId(SESSION, 0, 1), Token(1, 1), (write,), 0)).writes
    return bytes(found.datum.body)


def test_second_slice_alone_is_no_payload_that_its_client_has_filled(folder):
    """The draft was given up, then a late slice of it came: before it there is a hole."""
    handler = PayloadHandler(folder, 10 * SIZE)
    assert staged(handler, len(HALF), HALF).shared

    assert adopted(handler) == b""

    staged(handler, 0, HALF)
    assert adopted(handler) == HALF + HALF


def test_draft_that_no_slice_came_for_is_that_of_its_client(folder):
    """A client of this host fills the file by itself."""
    handler = PayloadHandler(folder, 10 * SIZE)
    staged(handler, 0, b"")
    with (folder.path / FILE).open("r+b") as opened:
        opened.write(HALF + HALF)

    assert adopted(handler) == HALF + HALF


@pytest.mark.parametrize("kept", [True, False], ids=["held", "released"])
def test_late_slice_makes_no_draft_of_what_was_adopted(folder, kept):
    """A copy of a slice comes when the payload is shown, or gone already."""
    for handler in (PayloadHandler(folder, 2 * SIZE), PayloadHandler(None, 2 * SIZE)):
        staged(handler, 0, HALF)
        staged(handler, len(HALF), HALF)
        write = WriteItem(Slot("online", "arm", "cloud"), Datum(b"\x01", b"", SIZE, 7, FILE))
        commit = handler.with_bodies(Commit(LockId(SESSION, 0, 1), Token(1, 1), (write,), 0))
        if not kept:
            del commit

        staged(handler, len(HALF), HALF)

        assert handler.drafts() == {}
        assert adopted(handler) == (HALF + HALF if kept else b"")


@pytest.mark.parametrize("shared", [True, False], ids=["file", "memory"])
def test_late_slice_that_opens_what_was_adopted_leaves_it_adopted(folder, shared):
    """The draft came, whole, and was adopted after the look at its name: a commit may repeat."""
    handler = PayloadHandler(folder if shared else None, 10 * SIZE)
    commits = []

    class Drafts(dict):
        def get(self, file):
            if not commits:
                commits.append(None)
                staged(handler, 0, HALF)
                staged(handler, len(HALF), HALF)
                write = WriteItem(Slot("online", "arm", "cloud"), Datum(b"", b"", SIZE, 7, FILE))
                commit = Commit(LockId(SESSION, 0, 1), Token(1, 1), (write,), 0)
                commits[:] = [handler.with_bodies(commit)]
            return super().get(file)

    handler._drafts = Drafts()
    staged(handler, 0, HALF)

    assert adopted(handler) == HALF + HALF
    commits.clear()
    assert adopted(handler) == b""


def test_late_slice_makes_no_draft_of_what_was_given_up():
    """Nor of what its client has dropped; of very old names nothing is kept."""
    handler = PayloadHandler(None, 10 * SIZE)
    staged(handler, 0, HALF)
    staged(handler, 0, b"", total=0)
    staged(handler, 0, HALF)
    assert handler.drafts() == {}

    for number in range(NUMBERS_MAX):
        staged(handler, 0, b"", file=f"{SESSION}-{number + 16:x}", total=0)
    staged(handler, 0, HALF)
    assert handler.drafts() == {FILE: SESSION}
