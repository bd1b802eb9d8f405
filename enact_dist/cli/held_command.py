"""A command that runs only as long as a lock is held: its own process group, ended as one."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from typing import TYPE_CHECKING, Final, Self

from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from enact_dist.link.signals import StopSignals

_START: Final = """\
import ctypes, os, signal, sys
parent, *command = sys.argv[1:]
ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)
if os.getppid() != int(parent):
    sys.exit(1)
signal.signal(signal.SIGPIPE, signal.SIG_DFL)
signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
os.execvp(command[0], command)
"""
"""Runs the command so that it dies with us: the kernel keeps PR_SET_PDEATHSIG (1) over exec.

A `preexec_fn` would do the same without 20 ms for an interpreter, but must not be used here, where
Zenoh's threads run.
"""

GRACE_S: Final = 2.0
"""How long a command may react to SIGTERM once its lock is lost."""


class HeldCommand:
    """A running command; leaving the block ends it and everything it has started.

    The command leads a process group of its own, so that a shell's children end with it.  On a
    terminal that group is put into the foreground: Ctrl-C goes to the command, as if it had been
    typed alone.  It ends with this process, however that ends.  Only while this process itself is
    stopped (SIGSTOP) can it run on past the lease, since nothing detects the loss.

    Raises:
        ConfigError: The command does not exist.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self._foreground = sys.stdin.isatty()
        self._passed = 0
        if shutil.which(command[0]) is None:
            raise ConfigError(f"cannot run {command[0]!r}: no such command")
        start = [sys.executable, "-I", "-S", "-c", _START, str(os.getpid())]
        self._process = subprocess.Popen([*start, *command], process_group=0)

    @property
    def status(self) -> int:
        """Exit status as a shell gives it: 128 and the number where a signal ended it."""
        code = self._process.returncode
        return code if code >= 0 else 128 - code

    def wait(self, timeout_s: float) -> bool:
        """Wait for the command's end; False after `timeout_s`."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def pass_on(self, stop: StopSignals) -> None:
        """Send the command each signal that came to us as SIGTERM, once."""
        if stop.count > self._passed:
            self._passed = stop.count
            self._signal(signal.SIGTERM)

    def pause(self) -> None:
        """Stop the command where it stands."""
        self._signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Let a stopped command go on."""
        self._signal(signal.SIGCONT)

    def __enter__(self) -> Self:
        self._to_foreground(self._process.pid)
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._signal(signal.SIGTERM)
            self.resume()  # a paused command could not react
            if not self.wait(GRACE_S):
                self._signal(signal.SIGKILL)
                self._process.wait()
        self._signal(signal.SIGKILL)  # whatever it left behind in its group
        self._to_foreground(os.getpgrp())

    def _signal(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):  # it has ended
            os.killpg(self._process.pid, number)

    def _to_foreground(self, group: int) -> None:
        if not self._foreground:
            return
        # Coming back from the background would stop us with SIGTTOU.
        before = signal.signal(signal.SIGTTOU, signal.SIG_IGN)
        try:
            os.tcsetpgrp(sys.stdin.fileno(), group)
        except OSError:
            self._foreground = False
        finally:
            signal.signal(signal.SIGTTOU, before)
