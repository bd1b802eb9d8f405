"""Small wrong edits of how the type of an aspect grows, the last one of the client; all are caught."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.core.shard.on_lock import LockHandler
from enact_dist.core.state.catalogue import Catalogue
from enact_dist.link.client.catalogue import KnownCatalogue

if TYPE_CHECKING:
    from collections.abc import Callable

    Patch = Callable[[Any, str, Any], None]


def lets_older_writers_in_after_a_restart(patch: Patch) -> None:
    """A restarted shard lets a client write the older type of an aspect that it has recovered."""
    init, register = Catalogue.__init__, Catalogue.register
    recovered_by: dict[int, set[str]] = {}

    def start(self: Catalogue, **options: Any) -> None:
        options["recovered"] = list(options["recovered"])
        init(self, **options)
        recovered_by[id(self)] = {entry.name for entry in options["recovered"]}

    def wrong(self: Catalogue, entry: Any, **how: Any) -> Any:
        answer = register(self, entry, **how)
        if isinstance(answer, str) and entry.name in recovered_by[id(self)]:
            return self.aspects[entry.name], False
        return answer

    patch(Catalogue, "__init__", start)
    patch(Catalogue, "register", wrong)


def lets_in_who_missed_a_newer_type(patch: Patch) -> None:
    """A client that has not seen that a type has grown goes on writing the older one."""
    patch(LockHandler, "_missed_type", lambda _handler, _message: None)


def keeps_no_newer_type(patch: Patch) -> None:
    """A newer type is acknowledged, but no record of it goes to the disk."""
    register = Catalogue.register

    def wrong(self: Catalogue, entry: Any, **how: Any) -> Any:
        before = self.aspects.get(entry.name)
        answer = register(self, entry, **how)
        grown = before is not None and before.older != self.aspects[entry.name].older
        return (answer[0], False) if grown else answer

    patch(Catalogue, "register", wrong)


def does_not_notice_that_a_catalogue_changed(patch: Patch) -> None:
    """A client that learns of a newer type while it asks for a lock takes its own for compared."""
    learn = KnownCatalogue.learn

    def wrong(self: KnownCatalogue, *args: Any, **options: Any) -> None:
        learn(self, *args, **options)
        self.lapses = 0

    patch(KnownCatalogue, "learn", wrong)
