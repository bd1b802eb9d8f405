"""Where a user's code raised, or stands: lines neither of ours nor of Python nor of a library."""

from __future__ import annotations

import os
import sys
import sysconfig
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable

_BASE: Final = ("<", f"{Path(__file__).parents[2]}{os.sep}", sysconfig.get_path("stdlib") + os.sep)
"""How names of files begin that import a user's code, or that it calls."""
_LIBRARIES: Final = (*_BASE, sysconfig.get_path("purelib") + os.sep)


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
