"""Child processes of one machine: started, restarted with back-off, drained in order, one log.

Rules a change must keep
  * Shards are up before actors start, and actors end before shards stop: an actor that stops
    can still commit, and a shard that stops has no clients left to wait for.
  * A child ends when its process ends: processes that it started may keep its output open.
  * A child never outlives its supervisor, even one that was killed: the kernel sends it SIGTERM.
  * A child is restarted unless it ended normally (an actor: 0) or can never run (2: usage or
    configuration); pauses double up to `PAUSE_S_MAX` and start again after a good while.
"""

from __future__ import annotations

import codecs
import contextlib
import fcntl
import io
import os
import queue
import select
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from enact_dist.errors import EnactError

PAUSE_S_MIN: Final = 0.2
PAUSE_S_MAX: Final = 10.0
"""Pauses between restarts: a shard with a damaged store must not fill the log."""
GOOD_S: Final = 10.0
"""A child that ran this long counts as well again."""
READY_S: Final = 20.0
"""How long actors wait for the shards at the start; then they try by themselves."""
END_S: Final = {"actor": 10.0, "shard": 5.0}
"""How long a child may take to end after SIGTERM, beside its own drain; then it is killed."""
SUPERVISOR_VARIABLE: Final = "ENACT_SUPERVISOR_PID"
PIPE_BYTES: Final = 64 << 10
NEVER_AGAIN: Final = 2
"""Exit status of wrong usage or configuration: the same command would fail the same way."""

Say = Callable[[str, str], None]
"""Takes the name of a child, or the empty string, and one line of its output."""


@dataclass(frozen=True, slots=True)
class Task:
    """One child process.

    Attributes:
        name: How the log names it.
        kind: "shard" or "actor"; decides the order of start and end.
        drain_s: How long it may wait for others before it ends.
        env: Environment variables that it has beside those of the supervisor.
    """

    name: str
    kind: str
    command: tuple[str, ...]
    drain_s: float = 0.0
    env: Mapping[str, str] = field(default_factory=dict)

    @property
    def end_s(self) -> float:
        """How long it may take to end after SIGTERM."""
        return END_S[self.kind] + self.drain_s


@dataclass(frozen=True, slots=True)
class _Ended:
    child: _Child
    status: int


@dataclass(frozen=True, slots=True)
class _Ready:
    child: _Child


class RestartPauses:
    """How long what ends waits for its next start: doubled each time, short after a good while."""

    __slots__ = ("_next_s", "_started_s")

    def __init__(self) -> None:
        self._next_s = PAUSE_S_MIN
        self._started_s = 0.0

    def started(self) -> None:
        """Note a start."""
        self._started_s = time.monotonic()

    def ended(self) -> float:
        """Note an end; return the pause until the next start, seconds."""
        if time.monotonic() - self._started_s > GOOD_S:
            self._next_s = PAUSE_S_MIN
        pause_s, self._next_s = self._next_s, min(2 * self._next_s, PAUSE_S_MAX)
        return pause_s


class _Child:
    """One task with its process; used by the supervisor's thread only, but for `_read`.

    Attributes:
        pause_s: How long it pauses, or paused, between its last end and the start after that.
    """

    def __init__(self, task: Task, say: Say, events: queue.SimpleQueue[_Ended | _Ready]) -> None:
        self.task = task
        self.ready = False
        self.over = False
        self.restart_at_s = 0.0
        self.pause_s = 0.0
        self._say, self._events = say, events
        self._process: subprocess.Popen[bytes] | None = None
        self._pauses = RestartPauses()

    @property
    def running(self) -> bool:
        return self._process is not None

    @property
    def pid(self) -> int:
        return self._process.pid if self._process is not None else 0

    def start(self) -> None:
        self._pauses.started()
        self._process = subprocess.Popen(
            self.task.command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            bufsize=0,
            env={
                **os.environ,
                **self.task.env,
                SUPERVISOR_VARIABLE: str(os.getpid()),
                "PYTHONUNBUFFERED": "1",
            },
            process_group=0,  # Ctrl-C on the terminal is the supervisor's to pass on, in order
        )
        threading.Thread(target=self._read, args=(self._process,), daemon=True).start()

    def ended(self) -> None:
        """Note that the process is gone and when it may be started again."""
        self._process = None
        self.pause_s = self._pauses.ended()
        self.restart_at_s = time.monotonic() + self.pause_s

    def send(self, number: signal.Signals) -> None:
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(number)

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        """Follow a child to its end, and report that end even if reading its output fails."""
        told = threading.Event()
        try:
            self._follow(process, told)
        except Exception as error:  # noqa: BLE001 - its end must be noticed all the same
            self._say(self.task.name, f"cannot read its output any more: {error}")
        if not told.is_set():
            self._events.put(_Ended(self, process.wait()))

    def _follow(self, process: subprocess.Popen[bytes], told: threading.Event) -> None:
        """Pass on what the child writes, and tell of its end before that of its output.

        Whatever the child has started may hold the output for as long as it likes.
        """
        assert process.stdout is not None
        lines = _Lines()
        with process.stdout as output, select.epoll() as poll:
            poll.register(output, select.EPOLLIN)
            with _end_of(process, poll) as end:
                while True:
                    ready = [number for number, _ in poll.poll()]
                    if end in ready:
                        poll.unregister(end)
                        last = lines.take(_what_is_left(output.fileno())) + lines.rest()
                        self._pass_on(last, alive=True)
                        self._events.put(_Ended(self, process.wait()))
                        told.set()
                    elif not (some := os.read(output.fileno(), PIPE_BYTES)):
                        break
                    else:
                        self._pass_on(lines.take(some), alive=not told.is_set())
        self._pass_on(lines.rest(), alive=not told.is_set())

    def _pass_on(self, lines: list[str], *, alive: bool) -> None:
        from enact_dist.link.log import says_ready  # each command imports this module

        for line in lines:
            if alive and says_ready(line):
                self._events.put(_Ready(self))
            self._say(self.task.name, line)


class _Lines:
    """Makes lines of pieces of output."""

    def __init__(self) -> None:
        text = codecs.getincrementaldecoder("utf-8")(errors="replace")
        self._decoder = io.IncrementalNewlineDecoder(text, translate=True)
        self._begun = ""

    def take(self, some: bytes) -> list[str]:
        """Add a piece; return the lines that are whole now."""
        *whole, self._begun = (self._begun + self._decoder.decode(some)).split("\n")
        return whole

    def rest(self) -> list[str]:
        """Return the last line if it has no line end."""
        rest = self._begun + self._decoder.decode(b"", final=True)
        self._begun = ""
        return [rest.rstrip("\n")] if rest else []


@contextlib.contextmanager
def _end_of(process: subprocess.Popen[bytes], poll: select.epoll) -> Iterator[int]:
    """Let `poll` tell of the end of a process; yield its number there, -1 where it cannot."""
    try:
        end = os.pidfd_open(process.pid)
    except OSError:  # a kernel, or a container, without it: the end of the output has to do
        yield -1
        return
    try:
        poll.register(end, select.EPOLLIN)
        yield end
    finally:
        os.close(end)


def _what_is_left(output: int) -> bytes:
    """Return what is in a pipe now, and not what others write while it is read."""
    left = int.from_bytes(fcntl.ioctl(output, termios.FIONREAD, bytes(4)), sys.byteorder)
    found = b""
    while len(found) < left and (some := os.read(output, left - len(found))):
        found += some
    return found


class Supervisor:
    """Runs tasks until it is stopped.  One thread calls `run`.

    Args:
        tasks: What to run; shards start first.
        say: Takes every line; called from several threads, one call at a time.
    """

    def __init__(self, tasks: Sequence[Task], say: Say) -> None:
        self._mutex = threading.Lock()
        self._sink = say
        self._events: queue.SimpleQueue[_Ended | _Ready] = queue.SimpleQueue()
        self._children = [_Child(task, self._say, self._events) for task in tasks]
        self._actors_started = False
        self._failed = ""
        self._lost = 0

    def run(self, stop: threading.Event, *, count: Callable[[], int] = lambda: 1) -> int:
        """Run everything until `stop` is set; return 0, or 1 if a shard can never run.

        Args:
            stop: Ends the run; children are drained before this returns.
            count: How many times the stop was asked for; the second time, children are killed.
        """
        started_s = time.monotonic()
        self._start("shard")
        try:
            while not stop.is_set() and not self._failed:
                up = all(child.ready for child in self._of("shard"))
                if not self._actors_started and (up or time.monotonic() - started_s > READY_S):
                    self._actors_started = True
                    self._start("actor")
                self._take_event(0.1)
                self._restart_due()
        finally:
            for kind in ("actor", "shard"):
                self._drain(kind, count)
        if self._failed:
            self._say("", f"stopped: {self._failed}")
        return 1 if self._failed else 0

    def pids(self) -> dict[str, int]:
        """Return the process ids of running children by name."""
        return {child.task.name: child.pid for child in self._children if child.pid}

    def _say(self, name: str, line: str) -> None:
        with self._mutex:
            try:
                if self._lost:
                    self._sink("", f"{self._lost} lines of this log were lost")
                    self._lost = 0
                self._sink(name, line)
            except BrokenPipeError:
                # The reader of the log is gone; that is no reason to stop a robot.
                self._sink = lambda _name, _line: None
            except (OSError, ValueError):  # a full disk, a character that it does not have
                self._lost += 1

    def _of(self, kind: str) -> list[_Child]:
        return [child for child in self._children if child.task.kind == kind]

    def _start(self, kind: str) -> None:
        for child in self._of(kind):
            child.start()

    def _take_event(self, timeout_s: float) -> None:
        try:
            event = self._events.get(timeout=timeout_s)
        except queue.Empty:
            return
        if isinstance(event, _Ready):
            event.child.ready = True
        else:
            event.child.ended()
            self._judge(event.child, event.status)

    def _judge(self, child: _Child, status: int) -> None:
        """Decide what the unexpected end of a child means."""
        how = ended_how(status)
        if child.task.kind == "actor" and status == 0:
            child.over = True
            self._say(child.task.name, "done; it is not started again")
        elif status == NEVER_AGAIN:
            child.over = True
            self._say(child.task.name, f"{how}; it cannot run like this and is not started again")
            if child.task.kind == "shard":
                self._failed = f"shard {child.task.name} cannot run"
        else:
            self._say(child.task.name, f"{how}; started again in {child.pause_s:.1f} s")

    def _restart_due(self) -> None:
        for child in self._children:
            if (
                child.over
                or child.running
                or (child.task.kind == "actor" and not self._actors_started)
            ):
                continue
            if time.monotonic() >= child.restart_at_s:
                child.start()

    def _drain(self, kind: str, count: Callable[[], int]) -> None:
        asked = [child for child in self._of(kind) if child.running]
        asked_s = time.monotonic()
        for child in asked:
            child.send(signal.SIGTERM)
        killed: list[_Child] = []
        while any(child.running for child in asked):
            past_s = time.monotonic() - asked_s
            for child in asked:
                late = past_s > child.task.end_s or count() > 1
                if late and child.running and child not in killed:
                    self._say(child.task.name, "did not end in time and is killed")
                    child.send(signal.SIGKILL)
                    killed.append(child)
            self._take_end(0.1)

    def _take_end(self, timeout_s: float) -> None:
        with contextlib.suppress(queue.Empty):
            event = self._events.get(timeout=timeout_s)
            if isinstance(event, _Ended):
                event.child.ended()
                if event.status:
                    self._say(event.child.task.name, ended_how(event.status))


def ended_how(status: int) -> str:
    """Return how a process ended: its exit status, or the signal by its name."""
    if status >= 0:
        return f"exit status {status}"
    try:
        return f"ended by {signal.Signals(-status).name}"
    except ValueError:  # one of those for programs' own use
        return f"ended by signal {-status}"


def end_with_supervisor() -> None:
    """Ask the kernel for SIGTERM when the supervisor that started this process is gone.

    Does nothing where no supervisor did, or the system has no such service (it is Linux's).

    Raises:
        EnactError: The supervisor is gone already.
    """
    supervisor = os.environ.pop(SUPERVISOR_VARIABLE, "")
    if not supervisor:
        return
    import ctypes

    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, int(signal.SIGTERM), 0, 0, 0)  # PR_SET_PDEATHSIG
    if str(os.getppid()) != supervisor:
        raise EnactError(f"the supervisor (pid {supervisor}) that started this process is gone")
