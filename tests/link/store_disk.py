"""A folder as a sequence of system calls leaves it on a disk, and every way a crash may cut it short.

`record` runs a program under strace and returns what it did to a folder; `Disk` replays that and
knows what was forced to the disk and what was not.  What a crash leaves:

- `kill -9`: everything that was called, the last write perhaps in part.
- A power cut: everything that was forced, and of the rest any subset of writes, each whole or some
  of its sectors.  Entries of a folder (names made, moved, removed) keep their order among
  themselves, as in every file system with a journal, and need a sync of the folder: that a file's
  own sync keeps its name is no promise of POSIX.
"""

import contextlib
import itertools
import os
import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import NamedTuple

EXHAUSTIVE_MAX = 1 << 6
"""Up to so many subsets of unforced writes all are tried, beyond a sample."""

CALLS = (
    "openat,open,creat,close,write,pwrite64,writev,pwritev,pwritev2,ftruncate,truncate,fallocate,"
    "fsync,fdatasync,rename,renameat,renameat2,unlink,unlinkat,mkdir,mkdirat,link,linkat,symlink,"
    "dup,dup2,dup3,sendfile,copy_file_range,rmdir"
)
_CALL = re.compile(r"(\w+)\((.*)\) += (-?\d+)")
_TEXT = re.compile(r'"((?:\\x[0-9a-f]{2})*)"')
_DESCRIPTOR = re.compile(r"(\d+)<")


class Call(NamedTuple):
    """One system call that changed the folder; `kind` "said" is a word to the test."""

    kind: str
    path: str = ""
    to: str = ""
    offset: int = 0
    data: bytes = b""


def record(command, *, folder, said, trace, environment):
    """Run a program under strace; return its calls on `folder` and its writes to `said`."""
    ended = subprocess.run(
        ["strace", "-xx", "-y", "-s", "1000000", "-o", trace, "-e", f"trace={CALLS}", *command],
        check=False,
        capture_output=True,
        text=True,
        env=environment,
    )
    assert ended.returncode in {0, -9}, ended.stderr
    return list(_calls(trace, str(folder), str(said)))


def _calls(trace, folder, said):
    """Yield the calls of a trace that matter."""
    opened = {}
    with trace.open(encoding="ascii") as lines:
        for line in lines:
            found = _CALL.match(line)
            if found and int(found[3]) >= 0:
                texts = [bytes.fromhex(text.replace("\\x", "")) for text in _TEXT.findall(found[2])]
                descriptor = _DESCRIPTOR.match(found[2])
                if found[1] == "openat":
                    yield from _open(found, texts[0].decode(), opened, folder, said)
                elif descriptor is None:
                    yield from _on_paths(found, texts, folder)
                elif int(descriptor[1]) in opened:
                    yield from _on_file(found, texts, opened, int(descriptor[1]))


def _inside(path, folder):
    """Return a path from the folder on, None where it is elsewhere."""
    if path == folder:
        return ""
    return path[len(folder) + 1 :] if path.startswith(folder + "/") else None


def _open(found, path, opened, folder, said):
    opened.pop(int(found[3]), None)
    inside = _inside(path, folder)
    if path == said or inside is not None:
        opened[int(found[3])] = inside
    if inside is not None and "O_CREAT" in found[2]:
        yield Call("make", inside)
    if inside is not None and "O_TRUNC" in found[2]:
        yield Call("cut", inside)


def _on_file(found, texts, opened, number):
    name, path, last = found[1], opened[number], found[2].rpartition(",")[2]
    if name == "close":
        del opened[number]
    elif path is None:
        yield Call("said")
    elif name in {"write", "pwrite64"}:
        assert int(found[3]) == len(texts[0])
        yield Call("write", path, offset=int(last) if name == "pwrite64" else -1, data=texts[0])
    elif name == "ftruncate":
        yield Call("cut", path, offset=int(last))
    elif name in {"fsync", "fdatasync"}:
        yield Call("sync", path)
    else:
        raise AssertionError(f"a call that this recorder does not know: {found[0][:200]}")


def _on_paths(found, texts, folder):
    paths = [_inside(text.decode(), folder) for text in texts]
    if paths and paths[0] is not None:
        if found[1] not in {"rename", "unlink", "mkdir", "link"}:
            raise AssertionError(f"a call that this recorder does not know: {found[0][:200]}")
        yield Call(found[1], *paths[:2])


# ---------------------------------------------------------------- what is on the disk


@dataclass(eq=False)
class File:
    """Content that was forced, and the writes since: (number, offset, bytes; None cuts)."""

    synced: bytes = b""
    pending: list = field(default_factory=list)

    def content(self, choice=None):
        """Return the content with the chosen writes: by number True, or the ranges of it."""
        content = bytearray(self.synced)
        for number, offset, data in self.pending:
            chosen = True if choice is None else choice.get(number, False)
            if not chosen:
                continue
            if data is None:
                del content[offset:]
                content.extend(bytes(offset - len(content)))
                continue
            for begin, end in [(0, len(data))] if chosen is True else chosen:
                if len(content) < offset + begin:
                    content.extend(bytes(offset + begin - len(content)))
                content[offset + begin : offset + end] = data[begin:end]
        return bytes(content)


@dataclass(eq=False)
class Folder:
    """Entries that were forced, and the changes since: (number, name gone, name new, node)."""

    synced: dict = field(default_factory=dict)
    pending: list = field(default_factory=list)

    def entries(self, length=None):
        """Return the entries with the first `length` changes."""
        entries = dict(self.synced)
        for _, gone, new, node in self.pending[:length]:
            entries.pop(gone, None)
            if new is not None:
                entries[new] = node
        return entries


class Disk:
    """A folder on a disk, call by call."""

    def __init__(self, image=()):
        self.number = 0
        self.root = Folder()
        for path, content in dict(image).items():
            folder = self.root
            for name in PurePath(path).parts[:-1]:
                folder = folder.synced.setdefault(name, Folder())
            if content is None:
                folder.synced.setdefault(PurePath(path).name, Folder())
            else:
                folder.synced[PurePath(path).name] = File(content)

    def _find(self, path):
        node = self.root
        for name in PurePath(path).parts:
            node = node.entries().get(name) if isinstance(node, Folder) else None
        return node

    def _around(self, path):
        return self._find(str(PurePath(path).parent)), PurePath(path).name

    def do(self, call):
        """Take one call."""
        self.number += 1
        if call.kind in {"make", "mkdir"}:
            folder, name = self._around(call.path)
            if name not in folder.entries():
                node = File() if call.kind == "make" else Folder()
                folder.pending.append((self.number, None, name, node))
        elif call.kind == "write":
            file = self._find(call.path)
            offset = call.offset if call.offset >= 0 else len(file.content())
            file.pending.append((self.number, offset, call.data))
        elif call.kind == "cut":
            self._find(call.path).pending.append((self.number, call.offset, None))
        elif call.kind == "sync":
            node = self._find(call.path)
            node.synced = node.content() if isinstance(node, File) else node.entries()
            node.pending.clear()
        elif call.kind == "unlink":
            folder, name = self._around(call.path)
            folder.pending.append((self.number, name, None, None))
        elif call.kind == "rename":
            folder, name = self._around(call.path)
            other, new = self._around(call.to)
            assert folder is other
            folder.pending.append((self.number, name, new, folder.entries()[name]))
        elif call.kind == "link":
            folder, new = self._around(call.to)
            folder.pending.append((self.number, None, new, self._find(call.path)))

    # ---------------------------------------------------------------- what a crash leaves

    def killed(self, torn=None):
        """Return what `kill -9` leaves; `torn` is a write that had come so far: (file, bytes)."""
        return _image(self.root, lambda _: None, torn=torn)

    def unforced(self):
        """Return the nodes with something that is not forced, and their changes in order."""
        found, todo = [], [self.root]
        while todo:
            node = todo.pop()
            if node in [one for one, _ in found]:
                continue
            found.append((node, list(node.pending)))
            if isinstance(node, Folder):
                todo += [*node.synced.values(), *(p[3] for p in node.pending if p[3] is not None)]
        return [(node, pending) for node, pending in found if pending]

    def power_cuts(self, rng, samples):
        """Yield (image, all of them?) of what a power cut may leave, writes whole or not at all."""
        variables = [
            one for node, pending in self.unforced() for one in _variables(node, pending, rng)
        ]
        total = 1
        for alternatives in variables:
            total *= len(alternatives)
        if total <= EXHAUSTIVE_MAX:
            for chosen in itertools.product(*variables):
                yield self._left(chosen), True
            return
        last = [alternatives[-1] for alternatives in variables]
        first = [alternatives[0] for alternatives in variables]
        for index, alternatives in enumerate(variables):
            # All but this one, and this one alone: the likeliest to matter.
            yield self._left([*last[:index], alternatives[0], *last[index + 1 :]]), False
            yield self._left([*first[:index], alternatives[-1], *first[index + 1 :]]), False
        for _ in range(samples):
            kept = rng.choice((0.05, 0.3, 0.5, 0.7, 0.95))
            yield (
                self._left(
                    [
                        rng.choice(alternatives[1:]) if rng.random() < kept else alternatives[0]
                        for alternatives in variables
                    ]
                ),
                False,
            )

    def torn(self, rng, sector_bytes, samples):
        """Yield images in which some sectors of unforced writes are on the disk, others not."""
        unforced = self.unforced()
        for _ in range(samples):
            kept = rng.choice((0.2, 0.5, 0.8, 1.0))
            choice, lengths = {}, {}
            for node, pending in unforced:
                if isinstance(node, Folder):
                    lengths[node] = rng.randrange(len(pending) + 1)
                    continue
                for number, offset, data in pending:
                    if data is None or rng.random() < 0.3:
                        choice[number] = rng.random() < kept
                    else:
                        pieces = _sectors(offset, len(data), sector_bytes)
                        choice[number] = [piece for piece in pieces if rng.random() < kept]
            yield _image(self.root, lambda node, lengths=lengths: lengths.get(node, 0), choice)

    def _left(self, chosen):
        choice, lengths = {}, {}
        for node, what in chosen:
            if isinstance(node, Folder):
                lengths[node] = what
            elif what is not None:
                choice[what] = True
        return _image(self.root, lambda node: lengths.get(node, 0), choice)


def _variables(node, pending, rng):
    """Yield the alternatives of one node: (node, which), the first one being *nothing of it*."""
    if isinstance(node, Folder):
        yield [(node, length) for length in range(len(pending) + 1)]
        return
    places = {}
    for number, offset, data in pending:
        places.setdefault((offset, None if data is None else len(data)), []).append(number)
    for numbers in places.values():
        # Of many writes to one place any may be the newest on the disk: first, last, and one else.
        some = {numbers[0], numbers[-1], rng.choice(numbers)}
        yield [(node, None), *((node, number) for number in sorted(some))]


def _sectors(offset, length, sector_bytes):
    """Return the ranges of a write by the sectors that it touches."""
    edges = range(-(offset % sector_bytes), length, sector_bytes)
    return [(max(0, edge), min(length, edge + sector_bytes)) for edge in edges]


def _image(folder, length_of, choice=None, torn=None, prefix=""):
    """Return path → content (None for an empty folder's sake), with the chosen changes."""
    image = {}
    for name, node in folder.entries(length_of(folder)).items():
        path = prefix + name
        if isinstance(node, Folder):
            image[path] = None
            image |= _image(node, length_of, choice, torn, path + "/")
        else:
            image[path] = node.content(choice)
    if torn is not None and not prefix:
        path, offset, data = torn
        content = bytearray(image[path])
        offset = len(content) if offset < 0 else offset
        content.extend(bytes(max(0, offset - len(content))))
        content[offset : offset + len(data)] = data
        image[path] = bytes(content)
    return image


def put(image, folder):
    """Make the folder of an image."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for path, content in image.items():
        if content is None:
            (folder / path).mkdir(exist_ok=True)
        else:
            (folder / path).write_bytes(content)


@contextlib.contextmanager
def memory_folder(tmp_path):
    """Yield a folder in memory where there is one: thousands of images are written and synced."""
    shared = Path("/dev/shm")
    if not os.access(shared, os.W_OK):
        yield tmp_path
        return
    with tempfile.TemporaryDirectory(prefix="enact-store-", dir=shared) as folder:
        yield Path(folder)
