"""Makes the folders, the recording and the facts that `test_stored_before.py` opens.

    PYTHONPATH= /venv/of/that/version/bin/python tests/e2e/make_stored.py FOLDER

Run it with the virtual environment of the version whose data are to stay readable; it takes no part
of the present one but `stored_facts.py` beside it.  The files in `stored_before` were made by commit
96d3c70 (2026-11-23), the state before the folders of the package were laid out anew.
"""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from stored_facts import COUNT, PARTS, REPLAYED, facts_of, fill, replayed

from enact_dist import Lock, Write, connect

SHARDS = ("left", "right")


def cell_file(folder):
    """Write the file of a cell of two shards on free ports; return it."""
    with contextlib.ExitStack() as stack:
        taken = [stack.enter_context(socket.socket()) for _ in SHARDS]
        for one in taken:
            one.bind(("127.0.0.1", 0))
        ports = [one.getsockname()[1] for one in taken]
    lines = ['name = "stored"', 'worlds = ["online"]', 'data_folder = "data"']
    for name, port in zip(SHARDS, ports, strict=True):
        lines += [f"[shards.{name}]", f'listen = "tcp/127.0.0.1:{port}"']
    file = folder / "cell.toml"
    file.write_text("\n".join(lines) + "\n")
    return file


def enact(*words):
    """Start a verb of the command line."""
    command = "import sys; from enact_dist.cli.main import main; sys.exit(main())"
    return subprocess.Popen(
        [sys.executable, "-c", command, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )


def ended(process):
    """Wait for the end of a verb that succeeds."""
    text, _ = process.communicate(timeout=60)
    if process.returncode:
        raise SystemExit(text)


@contextlib.contextmanager
def shard(name, file):
    """Run a daemon until the block ends."""
    process = enact("shard", "run", name, "--cell", file)
    try:
        while "ready" not in (line := process.stdout.readline()):
            if not line:
                raise SystemExit(f"shard {name} ended with {process.wait()}")
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        ended(process)


def record(file, recording, cell):
    """Record the cell for a while, during which one datum changes."""
    words = (
        "--world",
        "online",
        "--aspect",
        "count",
        "--aspect",
        "pose",
        "--aspect",
        "flags",
        "--seconds",
        "3",
    )
    process = enact("record", file, "--out", str(recording), *words)
    write = Write(cell.world("online"), PARTS[0], COUNT)
    while process.poll() is None:
        with Lock(write) as lock:
            lock[write] += 1
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.1)
    ended(process)


def main(target):
    """Make the three files in `target`."""
    target.mkdir(parents=True, exist_ok=True)
    recording = target / "recording.mcap"
    recording.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        file = str(cell_file(folder))
        with contextlib.ExitStack() as stack:
            for name in SHARDS:
                stack.enter_context(shard(name, file))
            cell = stack.enter_context(connect(file, actor="stored-before"))
            fill(cell)
            record(file, recording, cell)
            cell.create_world("replayed")
            ended(enact("replay", str(recording), "--into", file, "--speed", "0", *REPLAYED))
            facts = facts_of(cell)
            facts["replayed"] = replayed(cell.world("replayed"))
        with tarfile.open(target / "shards.tar.xz", "w:xz") as archive:
            archive.add(folder / "data", "data")
    (target / "facts.json").write_text(json.dumps(facts, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
