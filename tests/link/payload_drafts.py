"""Drafts of payloads, and commits that adopt them."""

from enact_dist.core.protocol.datum import Datum, LockId, Slot, Token
from enact_dist.core.protocol.messages import Commit, Stage, WriteItem
from enact_dist.link.memory.maps import leftovers

SIZE = 100_000
SESSION = "a1b2c3"
FILE = f"{SESSION}-1"
NOTHING = Datum(b"", b"", 0)
SLOT = Slot("online", "arm", "cloud")


def stage(handler, file=FILE, offset=0, total=SIZE, body=b"", session=None):
    session = session or file.partition("-")[0]
    return handler.stage(Stage(session, file, offset, total, Datum(b"", body, len(body))))


def commit_of(file=FILE, size=SIZE, session=SESSION, body=b""):
    write = WriteItem(SLOT, Datum(b"\x01", body, size, 7, file))
    return Commit(LockId(session, 0, 1), Token(1, 1), (write,), 0)


def adopted(handler, *arguments, **options):
    """Return the datum that the shard would see."""
    return handler.with_bodies(commit_of(*arguments, **options)).writes[0].datum


def fill(folder, content, file=FILE):
    with (folder.path / file).open("r+b") as opened:
        opened.write(content)


def names(folder):
    """Return the payloads in a folder once nothing is on its way out."""
    assert leftovers().wait(30)
    return sorted(file.name for file in folder.path.iterdir() if file.name != "nonce")
