"""What an actor's own code is doing at this moment, and where it stands or raised.

An update that never returns cannot report anything.  `Doing` therefore records which method of the
actor runs, since when and under which lock.  If a method calls `sys.exit`, `Doing` raises an error
that names the place of the call.
"""

from __future__ import annotations

import contextlib
import os
import sys
import sysconfig
import threading
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.errors import MisuseError
from enact_dist.link.clock import monotonic_ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.access.lock import Lock

_BASE: Final = ("<", f"{Path(__file__).parents[2]}{os.sep}", sysconfig.get_path("stdlib") + os.sep)
"""How names of files begin that import a user's code, or that it calls."""
_LIBRARIES: Final = (*_BASE, sysconfig.get_path("purelib") + os.sep)


@dataclass(frozen=True, slots=True)
class MethodCall:
    """One call of a method of an actor that has not returned yet.

    Attributes:
        method: "start", "update" or "stop".
        about: " for ENTITY", or nothing.
        since_ns: When it began, by the monotonic clock.
        remains: What becomes of its result if the process is ended now.
    """

    method: str
    about: str
    since_ns: int
    thread: int
    lock: Lock | None
    remains: str

    @property
    def lock_lost(self) -> bool:
        """Whether it runs on after its lock was lost, so that nothing of it can be committed."""
        return self.lock is not None and self.lock.running and not self.lock.valid()

    def __str__(self) -> str:
        lasted_s = (monotonic_ns() - self.since_ns) / 1e9
        lost = " (lock lost)" if self.lock_lost else ""
        return f"{lasted_s:.1f} s in {self.method}{self.about}{lost}"


class Doing:
    """Which method of an actor runs.  The actor's thread enters and leaves; any thread looks.

    Args:
        actor: Name of the actor's class.

    Attributes:
        call: What runs now; None between the calls.
        between: Held while a method runs; a thread that holds it may change the actor.
    """

    __slots__ = ("_actor", "between", "call")

    def __init__(self, actor: str) -> None:
        self._actor = actor
        self.call: MethodCall | None = None
        self.between = threading.Lock()

    @contextlib.contextmanager
    def inside(
        self, method: str, *, about: str = "", lock: Lock | None = None, remains: str = ""
    ) -> Iterator[None]:
        """Note that the block calls a method of the actor; arguments as for `MethodCall`.

        Raises:
            MisuseError: The method called `sys.exit`, which would end the actor silently.
        """
        self.call = MethodCall(method, about, monotonic_ns(), threading.get_ident(), lock, remains)
        try:
            with self.between:
                yield
        except SystemExit as error:
            raise MisuseError(
                f"{self._actor}.{method} called sys.exit({error.code!r}) at {place_of(error)};"
                " raise an exception if the actor cannot do its work, or return if it is done"
            ) from None
        finally:
            self.call = None

    def cut_off(self) -> str:
        """Return what would be cut off if the process ended now, and where the code stands."""
        call = self.call
        if call is None:
            return "between updates"
        remains = f"; {call.remains}" if call.remains else ""
        return f"{call}, at {place_of_thread(call.thread)}{remains}"


# ---------------------------------------------------------------- places in a user's code


def own_frames(frames: Iterable[traceback.FrameSummary]) -> list[traceback.FrameSummary]:
    """Return the frames of a user's own files; without any, of libraries; otherwise all."""
    every = list(frames)
    for others in (_LIBRARIES, _BASE):
        if own := [frame for frame in every if not frame.filename.startswith(others)]:
            return own
    return every


def own_lines(error: BaseException) -> list[str]:
    """Return the lines of an error's traceback that are a user's own, outermost first."""
    frames = own_frames(traceback.extract_tb(error.__traceback__))
    shown = [
        traceback.FrameSummary(
            short_path(frame.filename), frame.lineno, frame.name, line=frame.line or ""
        )
        for frame in frames
        if not frame.filename.startswith(_BASE)
    ]
    if isinstance(error, SyntaxError) and error.filename:
        line = (error.text or "").strip()
        name = "<module>"
        shown.append(
            traceback.FrameSummary(short_path(error.filename), error.lineno, name, line=line)
        )
    return "".join(traceback.format_list(shown)).splitlines()


def raised(error: BaseException) -> str:
    """Return what an error is and where the user's code raised it."""
    kind = type(error).__name__
    if isinstance(error, SyntaxError) and error.filename:
        return f"{kind} at {short_path(error.filename)}:{error.lineno}: {error.msg}"
    return f"{kind} at {place_of(error)}: {error}"


def place_of(error: BaseException) -> str:
    """Return ``file:line`` of the user's innermost frame that an error came through."""
    frames = traceback.extract_tb(error.__traceback__)
    return _place(own_frames(frames)[-1]) if frames else "a place that is not known"


def place_of_thread(thread: int) -> str:
    """Return ``file:line (function)`` where the user's code of a running thread stands now."""
    frame = sys._current_frames().get(thread)  # noqa: SLF001 (there is no other way to ask)
    if frame is None:
        return "a place that is not known"
    innermost = own_frames(traceback.extract_stack(frame))[-1]
    return f"{_place(innermost)} ({innermost.name})"


def short_path(file: str) -> str:
    """Return a file's name as seen from the working folder."""
    return file.removeprefix(f"{Path.cwd()}{os.sep}")


def _place(frame: traceback.FrameSummary) -> str:
    return f"{short_path(frame.filename)}:{frame.lineno}"
