"""A disk of a few megabytes in a mount namespace, which a test fills."""

import shutil
import subprocess
from contextlib import contextmanager

import postgres_nodes

SIZE_MB = 24


class SmallDisk:
    """A file system of its own at a folder, which only programs run by `before` see.

    Attributes:
        before: A command that runs the one that follows it where the disk is.
    """

    def __init__(self, folder):
        self.folder = folder
        folder.mkdir()
        mount = f"mount -t tmpfs -o size={SIZE_MB}m,mode=0777 small {folder} && echo there && cat"
        self._keeper = subprocess.Popen(
            ["unshare", "--mount", "sh", "-c", mount],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        if self._keeper.stdout.readline() != "there\n":
            error = self._keeper.communicate()[1]
            raise OSError(f"no file system of its own: {error}")
        self.before = ("nsenter", f"--target={self._keeper.pid}", "--mount", "--")

    def fill(self):
        """Leave no room."""
        self._run("dd", "if=/dev/zero", f"of={self.folder}/ballast", "bs=64k", check=False)

    def make_room(self):
        self._run("rm", f"{self.folder}/ballast")

    def _run(self, *words, check=True):
        subprocess.run([*self.before, *words], check=check, capture_output=True, timeout=60)

    def close(self):
        self._keeper.communicate()


def why_missing():
    """Return why there can be no such disk here, "" where there can."""
    done = subprocess.run(
        ["unshare", "--mount", "mount", "-t", "tmpfs", "small", "/mnt"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return f"no mount namespace: {done.stderr.strip()}" if done.returncode else ""


@contextmanager
def small_server(holds):
    """Give a server and the small disk on which its log (`wal`) or its tables (`tables`) are."""
    folder = postgres_nodes.make_folder()
    disk = SmallDisk(folder / "small")
    node = postgres_nodes.Node(folder, "alone", before=disk.before)
    try:
        place = disk.folder / "here"
        if holds == "wal":
            node.init("-X", place, "--wal-segsize=1")
            node.start()
        else:
            node.init()
            node.start()
            disk._run("install", "-d", "-o", postgres_nodes.USER, str(place))
            node.execute(f"CREATE TABLESPACE small LOCATION '{place}'")
            node.execute("ALTER SYSTEM SET default_tablespace = 'small'")
            node.execute("SELECT pg_reload_conf()")
        yield node, disk
    finally:
        node.close()
        disk.close()
        shutil.rmtree(folder)
