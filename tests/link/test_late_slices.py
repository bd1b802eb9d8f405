"""Slices that come late, twice or without those before them: no half payload, no draft of the past."""

from __future__ import annotations

import pytest

from enact_dist.core.protocol.datum import Datum, LockId, Slot, Token
from enact_dist.core.protocol.messages import Commit, Stage, Staged, WriteItem
from enact_dist.link.memory.names import NUMBERS_MAX
from enact_dist.link.memory.payload_desk import PayloadDesk
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


def staged(desk, offset, body, *, file=FILE, total=SIZE):
    """Bring one slice."""
    answer = desk.stage(Stage(SESSION, file, offset, total, Datum(b"", body, len(body))))
    assert isinstance(answer, Staged), answer
    return answer


def adopted(desk, file=FILE):
    """Return the bytes that a commit of this payload gets."""
    write = WriteItem(Slot("online", "arm", "cloud"), Datum(b"\x01", b"", SIZE, 7, file))
    (found,) = desk.with_bodies(Commit(LockId(SESSION, 0, 1), Token(1, 1), (write,), 0)).writes
    return bytes(found.datum.body)


def test_second_slice_alone_is_no_payload_that_its_client_has_filled(folder):
    """The draft was given up, then a late slice of it came: before it there is a hole."""
    desk = PayloadDesk(folder, 10 * SIZE)
    assert staged(desk, len(HALF), HALF).shared

    assert adopted(desk) == b""

    staged(desk, 0, HALF)
    assert adopted(desk) == HALF + HALF


def test_draft_that_no_slice_came_for_is_that_of_its_client(folder):
    """A client of this host fills the file by itself."""
    desk = PayloadDesk(folder, 10 * SIZE)
    staged(desk, 0, b"")
    with (folder.path / FILE).open("r+b") as opened:
        opened.write(HALF + HALF)

    assert adopted(desk) == HALF + HALF


@pytest.mark.parametrize("kept", [True, False], ids=["held", "released"])
def test_late_slice_makes_no_draft_of_what_was_adopted(folder, kept):
    """A copy of a slice comes when the payload is shown, or gone already."""
    for desk in (PayloadDesk(folder, 2 * SIZE), PayloadDesk(None, 2 * SIZE)):
        staged(desk, 0, HALF)
        staged(desk, len(HALF), HALF)
        write = WriteItem(Slot("online", "arm", "cloud"), Datum(b"\x01", b"", SIZE, 7, FILE))
        commit = desk.with_bodies(Commit(LockId(SESSION, 0, 1), Token(1, 1), (write,), 0))
        if not kept:
            del commit

        staged(desk, len(HALF), HALF)

        assert desk.drafts() == {}
        assert adopted(desk) == (HALF + HALF if kept else b"")


@pytest.mark.parametrize("shared", [True, False], ids=["file", "memory"])
def test_late_slice_that_opens_what_was_adopted_leaves_it_adopted(folder, shared):
    """The draft came, whole, and was adopted after the look at its name: a commit may repeat."""
    desk = PayloadDesk(folder if shared else None, 10 * SIZE)
    commits = []

    class Drafts(dict):
        def get(self, file):
            if not commits:
                commits.append(None)
                staged(desk, 0, HALF)
                staged(desk, len(HALF), HALF)
                write = WriteItem(Slot("online", "arm", "cloud"), Datum(b"", b"", SIZE, 7, FILE))
                commit = Commit(LockId(SESSION, 0, 1), Token(1, 1), (write,), 0)
                commits[:] = [desk.with_bodies(commit)]
            return super().get(file)

    desk._drafts = Drafts()
    staged(desk, 0, HALF)

    assert adopted(desk) == HALF + HALF
    commits.clear()
    assert adopted(desk) == b""


def test_late_slice_makes_no_draft_of_what_was_given_up():
    """Nor of what its client has dropped; of very old names nothing is kept."""
    desk = PayloadDesk(None, 10 * SIZE)
    staged(desk, 0, HALF)
    staged(desk, 0, b"", total=0)
    staged(desk, 0, HALF)
    assert desk.drafts() == {}

    for number in range(NUMBERS_MAX):
        staged(desk, 0, b"", file=f"{SESSION}-{number + 16:x}", total=0)
    staged(desk, 0, HALF)
    assert desk.drafts() == {FILE: SESSION}
