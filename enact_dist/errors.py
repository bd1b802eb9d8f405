"""The exception tree: the class says who must act, the message what was asked and found.

::

    EnactError
    ├─ MisuseError             your code must change
    │  ├─ LockHeldError        a second lock in a thread, or a blocking call inside a lock
    │  ├─ LockReleasedError    a lock used outside its `with` block
    │  ├─ NotRequestedError    a datum that the lock did not ask for
    │  ├─ ReadonlyError        a write through Read or View
    │  ├─ DatumTypeError       a datum that is not of its aspect's type
    │  ├─ UnknownWorldError    a world context that the cell does not have     .known
    │  └─ ConfigError          a cell.toml, folder or option that cannot be used   .line
    ├─ PermissionDeniedError   not allowed: no right, or another's session    .identity .right
    ├─ NullDatumError          the world context does not know this datum      .reason
    ├─ ForgottenError          a past state that has left its retention        .oldest_ns
    ├─ ChangedError            an expected view moved on; nothing written
    ├─ LockTimeoutError        not granted within wait_s; nothing held         .holders .waited_s
    ├─ NoRoomError             a shard's cap of shared memory is reached; nothing written
    ├─ LeaseLostError          granted, then lost; nothing written             .cause
    ├─ CommitUnknownError      sent, not answered; may stand                   .lock_id
    ├─ StoreError              a shard's folder is in use, unreadable or corrupt   .path
    └─ LinkError               the network or the peer must be looked at
       ├─ ShardUnreachableError   no answer                                    .shard .endpoint
       ├─ ProtocolError        the peer sent an unreadable message
       └─ ClockSkewError       two hosts' wall clocks are too far apart        .ahead_s

A delivered array is read-only: numpy itself refuses to change it, by `ValueError`.
"""

from __future__ import annotations

from typing import Final

SHARD_RESTARTED: Final = "its shard restarted"
"""How the cause of a lock begins that was lost because its shard restarted."""


class EnactError(Exception):
    """Base of all errors of enact_dist; raised only through its subclasses."""


class MisuseError(EnactError):
    """The calling code must change."""


class LockHeldError(MisuseError):
    """A thread that holds a lock asked for another or called something that waits (ENACT 3.3)."""


class LockReleasedError(MisuseError):
    """A lock was used outside its `with` block."""


class NotRequestedError(MisuseError):
    """A datum was accessed that the lock did not request."""


class ReadonlyError(MisuseError):
    """A datum was assigned through a request that does not allow it."""


class DatumTypeError(MisuseError):
    """A datum, or an aspect's type, is not what the aspect was registered with."""


class UnknownWorldError(MisuseError):
    """The cell has no world context of that name.

    Attributes:
        known: Names of those that exist.
    """

    def __init__(self, message: str, *, known: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.known = known


class ConfigError(MisuseError):
    """A `cell.toml` or an option cannot be used.

    Attributes:
        path: The file, or the empty string.
        line: Line number in it from 1, or 0 if none applies.
    """

    def __init__(self, message: str, *, path: str = "", line: int = 0) -> None:
        super().__init__(message)
        self.path = path
        self.line = line


class PermissionDeniedError(EnactError):
    """The caller may not do that; the message names the caller and what it lacks.

    Repeating the request does not help, so an actor that gets this error ends at once.  The
    attributes are empty where another client's session was named, or where they do not apply.

    Attributes:
        identity: Whose right is missing.
        right: Which one: "read", "write", "change", "init", "delete", "fork", …
        world: The world context of the slot.
        entity: Its entity, or the requested pattern.
        aspect: Its aspect.
        rule: Where a rule would give it, such as "cell.toml, line 41".
    """

    def __init__(
        self,
        message: str,
        *,
        identity: str = "",
        right: str = "",
        world: str = "",
        entity: str = "",
        aspect: str = "",
        rule: str = "",
    ) -> None:
        super().__init__(message)
        self.identity, self.right = identity, right
        self.world, self.entity, self.aspect = world, entity, aspect
        self.rule = rule


class NullDatumError(EnactError):
    """The world context does not know the datum.

    Attributes:
        reason: Why, as `enact_dist.types.NullReason` words it.
    """

    def __init__(self, message: str, *, reason: str = "") -> None:
        super().__init__(message)
        self.reason = reason


class ForgottenError(EnactError):
    """A past state of a datum has left its retention; what came after it may be known.

    Attributes:
        oldest_ns: Timestamp from which on the requested data are known, nanoseconds since 1970; 0
            if unknown.
    """

    def __init__(self, message: str, *, oldest_ns: int = 0) -> None:
        super().__init__(message)
        self.oldest_ns = oldest_ns


class ChangedError(EnactError):
    """A viewed datum that the commit depended on has moved on; nothing was written."""


class LockTimeoutError(EnactError):
    """The lock was not granted in time; nothing is held.

    Attributes:
        holders: Who held the data when last asked, one line each.
        waited_s: How long the lock waited, in seconds.
    """

    def __init__(
        self, message: str, *, holders: tuple[str, ...] = (), waited_s: float = 0.0
    ) -> None:
        super().__init__(message)
        self.holders = holders
        self.waited_s = waited_s


class NoRoomError(EnactError):
    """A shard has no room for a large datum: its cap is reached, and no history is left to free."""


class LeaseLostError(EnactError):
    """The lock was granted and then lost; nothing was written.

    Attributes:
        cause: Why, as the shard words it ("lease expired", "held too long", …).
    """

    def __init__(self, message: str, *, cause: str = "") -> None:
        super().__init__(message)
        self.cause = cause

    @property
    def restarted(self) -> bool:
        """Whether its shard restarted; the lock can then be taken again as before."""
        return self.cause.startswith(SHARD_RESTARTED)


class CommitUnknownError(EnactError):
    """The commit was sent and never answered; whether it took effect is unknown.

    Its shard stayed away, or has lost its record of the commit in a restart (`volatile` data).
    The only error after which a write may be visible.

    Attributes:
        lock_id: Identity of the lock, to ask for the outcome later (`Cell.outcome`).
    """

    def __init__(self, message: str, *, lock_id: str = "") -> None:
        super().__init__(message)
        self.lock_id = lock_id


class StoreError(EnactError):
    """A shard's data folder is in use, unreadable or corrupt.

    Attributes:
        path: The file or folder.
    """

    def __init__(self, message: str, *, path: str = "") -> None:
        super().__init__(message)
        self.path = path


class LinkError(EnactError):
    """The network or the peer must be looked at."""


class ShardUnreachableError(LinkError):
    """A shard did not answer.

    Attributes:
        shard: Its name.
        endpoint: Where it was expected.
    """

    def __init__(self, message: str, *, shard: str = "", endpoint: str = "") -> None:
        super().__init__(message)
        self.shard = shard
        self.endpoint = endpoint


class ProtocolError(LinkError):
    """A peer sent what this version cannot read."""


class ClockSkewError(LinkError):
    """A stamp lies too far ahead of this host's wall clock.

    Attributes:
        ahead_s: How far, in seconds.
    """

    def __init__(self, message: str, *, ahead_s: float = 0.0) -> None:
        super().__init__(message)
        self.ahead_s = ahead_s
