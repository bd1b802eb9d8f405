"""`enact actor set|restart`: change or restart a running actor on any host."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any, Final

from enact_dist.actor.running.commands import reports_of, send_to
from enact_dist.cli.arguments import pairs
from enact_dist.cli.target import open_cell
from enact_dist.cli.verbs import DONE, FAILED
from enact_dist.errors import MisuseError

if TYPE_CHECKING:
    import argparse

    from enact_dist.world.cell import Cell
    from enact_dist.world.listings import ActorInfo

LOOK_S: Final = 0.1
REPORTED_S: Final = 3.0
"""How long a ready actor may take to report that it receives commands."""
ANSWER_S: Final = 10.0
"""How long an actor may take to answer: it first finishes its update."""
RETURN_S: Final = 60.0
"""How long an actor may take to end and to run again."""


def set_values(options: argparse.Namespace) -> int:
    """Change every actor of the name; fail if one refuses."""
    values = pairs(options.values, "set")
    with open_cell(options, observer=False, actor="enact actor set") as cell:
        status = DONE
        for info, row in _found(cell, options.name):
            token = send_to(cell, info, row, {"set": values})
            answer = _answer(cell, info.session, options.name, token)
            if answer != "done":
                where = f"{info.host} pid {info.pid}"
                print(f"enact: actor {options.name} at {where}: {answer}", file=sys.stderr)
                status = FAILED
                continue
            told = ", ".join(f"{key} = {value}" for key, value in values.items())
            print(f"actor {options.name} at {info.host} pid {info.pid}: {told}")
    return status


def restart_actor(options: argparse.Namespace) -> int:
    """Ask every actor of the name to restart, and wait until as many new ones run."""
    with open_cell(options, observer=False, actor="enact actor restart") as cell:
        before = _found(cell, options.name)
        for info, row in before:
            send_to(cell, info, row, {"restart": True})
        old = {info.session for info, _ in before}
        end_s = time.monotonic() + RETURN_S
        while time.monotonic() < end_s:
            rows = reports_of(cell, options.name)
            back = [info for info, row in rows if info.session not in old and _runs(row)]
            if len(back) >= len(before) and not old & {info.session for info, _ in rows}:
                for info in back:
                    print(f"actor {options.name} restarted at {info.host} pid {info.pid}")
                return DONE
            time.sleep(LOOK_S)
    print(
        f"enact: actor {options.name} did not restart within {RETURN_S:g} s; check that its"
        " update ends, and that enact up, systemd or docker runs it and so starts it again",
        file=sys.stderr,
    )
    return FAILED


def _runs(row: dict[str, Any]) -> bool:
    return row.get("state") in ("running", "stuck")


def _found(cell: Cell, name: str) -> list[tuple[ActorInfo, dict[str, Any]]]:
    """Return the running actors of a name.

    An actor reports a moment after it is ready, so this looks for up to `REPORTED_S`.

    Raises:
        MisuseError: There is no such actor, or one accepts no commands.
    """
    end_s = time.monotonic() + REPORTED_S
    while not (found := reports_of(cell, name)) or not all(row.get("words_in") for _, row in found):
        if time.monotonic() >= end_s:
            break
        time.sleep(LOOK_S)
    if not found:
        known = sorted({one for info in cell.actors() for one in info.names()})
        raise MisuseError(f"no actor {name!r} runs (running: {', '.join(known) or 'none'})")
    for info, row in found:
        if not row.get("words_in"):
            raise MisuseError(
                f"actor {name} at {info.host} pid {info.pid} accepts no commands: it is not ready"
                " yet, or it runs inside another program, not under enact actor run or enact up"
            )
    return found


def _answer(cell: Cell, session: str, name: str, token: str) -> str:
    """Return the answer of an actor to a command."""
    end_s = time.monotonic() + ANSWER_S
    while time.monotonic() < end_s:
        for info, row in reports_of(cell, name):
            told, _, answer = str(row.get("word", "")).partition(" ")
            if info.session == session and told == token:
                return answer
        time.sleep(LOOK_S)
    return f"no answer within {ANSWER_S:g} s; an actor reads commands between two updates"
