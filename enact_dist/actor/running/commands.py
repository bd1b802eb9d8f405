"""Commands to a running actor: change its attributes, or restart it.

Commands are kept in one volatile datum of the entity `actor`, in one of the actor's world contexts,
by the session of the actor's process.  One slot serves all sessions, because a shard never deletes
a slot.  The actor's process watches the slot, removes its command from the datum, executes it
between two updates, and answers in its report.  Each writer drops the commands of sessions that
have ended.  Changed values last until the process ends; an actor starts with the values of
`cell.toml`.
"""

from __future__ import annotations

import logging
import secrets
import threading
from typing import TYPE_CHECKING, Any, Final

from enact_dist.access.lock import Lock
from enact_dist.actor.running.load import attributes_of, read_option
from enact_dist.errors import ConfigError, EnactError
from enact_dist.terms import Aspect, Durability, Entity, View, Write

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from enact_dist.access.watch import Watch
    from enact_dist.actor.actor import Actor
    from enact_dist.actor.running.runner import ActorRun
    from enact_dist.world.cell import Cell
    from enact_dist.world.context import WorldContext
    from enact_dist.world.listings import ActorInfo

ACTOR: Final = Entity("actor")
COMMANDS: Final = Aspect("actor_words", dict, Durability.VOLATILE, retention=1)
DONE: Final = "done"
"""Follows the token of an executed command in a report; otherwise the reason follows."""
ENDS: Final = "ends, to begin anew"

log = logging.getLogger("enact.actor")


def commands_of(world: WorldContext) -> Write[dict[str, Any]]:
    """Return the request for the commands to actors, by the session of each."""
    return Write(world, ACTOR, COMMANDS)


def send(
    world: WorldContext, command: dict[str, Any], *, session: str, live: Iterable[str]
) -> None:
    """Give the actor of a session a command; drop those of sessions that are not live.

    Raises:
        EnactError: The lock was not granted, or its commit failed.
    """
    request = commands_of(world)
    with Lock(request) as lock:
        kept = {one: its for one, its in lock.get(request, {}).items() if one in {*live}}
        lock[request] = {**kept, session: command}


def reports_of(cell: Cell, name: str) -> list[tuple[ActorInfo, dict[str, Any]]]:
    """Return the reports of the actors of a name, each with its session."""
    return [
        (info, row)
        for info in cell.actors()
        if not info.silent
        for row in info.rows()
        if row["name"] == name
    ]


def send_to(cell: Cell, info: ActorInfo, row: dict[str, Any], command: dict[str, Any]) -> str:
    """Give a command to an actor that reports; return the token that its answer begins with.

    The command is `{"set": values}` or `{"restart": True}`.

    Raises:
        EnactError: The lock was not granted, or its commit failed.
    """
    token = secrets.token_hex(4)
    live = [one.session for one in cell.actors() if not one.silent]
    world = cell.world(str(row["words_in"]))
    send(world, {"token": token, **command}, session=info.session, live=live)
    return token


def set_attributes(actor: Actor, values: dict[str, str]) -> None:
    """Change attributes of an actor, all or none.

    Raises:
        ConfigError: One is no attribute that can be changed, or the text is no value of its type.
    """
    hints = attributes_of(type(actor))
    name = type(actor).__name__
    read = {}
    for key, text in values.items():
        if key not in hints:
            raise ConfigError(
                f"{key} of actor {name} cannot be changed while it runs; these can:"
                f" {', '.join(hints) or 'none'} (attributes with an annotation and a value in the"
                " class)"
            )
        read[key] = read_option(f"option {key} of actor {name}", text, hints[key])
    for key, value in read.items():
        setattr(actor, key, value)


class CommandListener:
    """Listens for commands to one actor of this process, in a thread; a context manager."""

    def __init__(
        self, actor: Actor, run: ActorRun, cell: Cell, restart: Callable[[], object]
    ) -> None:
        self._actor, self._run, self._restart = actor, run, restart
        self._world = cell.world(run.words_in)
        self._session = self._world.session.client.core.session
        self._watch: Watch | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="enact-commands", daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        watch = self._watch
        if watch is not None:
            watch.close()
        self._thread.join(timeout=5.0)

    def _listen(self) -> None:
        while not self._closing.is_set():
            try:
                self._follow()
            except EnactError as error:
                log.info("%s: cannot receive commands for now: %s", self._run.name, error)
                self._closing.wait(5.0)

    def _follow(self) -> None:
        with self._world.watch(ACTOR, COMMANDS) as watch:
            self._watch = watch
            while not self._closing.is_set():
                change = watch.next()
                if change is None:
                    return
                if not change.null:
                    self._take()

    def _take(self) -> None:
        request = commands_of(self._world)
        seen = View(self._world, ACTOR, COMMANDS)
        if self._session not in self._world.view(seen).get(seen, {}):
            return
        with Lock(request, wait_s=5.0) as lock:
            commands = dict(lock.get(request, {}))
            command = commands.pop(self._session, None)
            if commands:
                lock[request] = commands
            else:
                del lock[request]
        if not isinstance(command, dict):
            if command is not None:
                log.warning("%s: an invalid command was ignored", self._run.name)
            return
        token = str(command.get("token", ""))
        if command.get("restart"):
            self._run.answer(f"{token} {ENDS}")
            self._restart()
            return
        try:
            values = {str(key): str(value) for key, value in dict(command.get("set", {})).items()}
            with self._run.doing.between:
                set_attributes(self._actor, values)
        except (ConfigError, ValueError, TypeError, AttributeError) as error:
            self._run.answer(f"{token} {error}")
            return
        shown = ", ".join(f"{key} = {value}" for key, value in values.items())
        log.info("%s: %s, as commanded", self._run.name, shown)
        self._run.answer(f"{token} {DONE}")
