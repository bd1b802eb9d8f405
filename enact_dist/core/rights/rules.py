"""Rights of a cell: rules that allow, compiled once, and their decisions.

A rule gives a right on what a path pattern covers.  A request is allowed if one pattern of
one rule contains all that it asks for (`enact_dist.patterns.container`).  There is nothing else: no
rule denies, so their order means nothing and what several give adds up.

===========  ====================================  ===============================================
right        path                                  gives
===========  ====================================  ===============================================
`read`       ``WORLD/ASPECT/ENTITY``               to see data
`change`     ``WORLD/ASPECT/ENTITY``               to replace a datum that is there
`init`       ``WORLD/ASPECT/ENTITY``               to write where there is none
`delete`     ``WORLD/ASPECT/ENTITY``               to write null
`fork`       ``SOURCE/WORLD``                      to fork `SOURCE`, all of which must be readable
`drop`       ``WORLD``                             to drop a world context
`register`   ``WORLD``                             to make a new world context
`keep`       ``LABEL``                             to pin versions under a label, and to unpin them
`break`      anything                              to break locks
`resolve`    anything                              to abort prepared locks, to settle alarms
`observe`    anything                              to list who is there and holds what, and causes
===========  ====================================  ===============================================

`write` is not in the table: it stands for `change`, `init` and `delete` together, and a request for
a lock that may write needs any one of them; which one, the commit shows.

Whose rights a request uses is its *subject*: a name for which the transport vouches, such as that
of an actor, ``@GROUP``, or ``uid:1000``.  The subject "" is this process, which may do everything.
`UNPROVEN` is a client whose name is only its own word; it may do nothing.

Decisions are kept, up to `DECISIONS_MAX`.  Rights never change: new ones are a new object, with no
old decision in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import NOT_PROVEN, PERMISSION, Refused
from enact_dist.patterns import contained, container, pattern_matches, patterns_overlap

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping

    from enact_dist.core.protocol.datum import Slot

    _Ends = tuple[str, str, Callable[[str], object]]

DECISIONS_MAX: Final = 65_536
"""Decisions that are kept; with one more, all of them are forgotten."""
WRITING: Final = ("change", "init", "delete")
"""What `write` stands for."""
DATA_RIGHTS: Final = ("read", *WRITING)
PLAIN_RIGHTS: Final = ("break", "resolve", "observe")
"""Rights on the cell as a whole: their path is `ALL`."""
ALL: Final = "**"
WRITE: Final = "write"
UNPROVEN: Final = "-"
"""The subject of a client that only says its own name; no name starts with a hyphen."""


@dataclass(frozen=True, slots=True)
class Rule:
    """What some subjects may do.

    Attributes:
        who: Names, names with stars, or groups (``@vision``).
        gives: Each right with the path pattern on which it is given.
    """

    who: tuple[str, ...]
    gives: tuple[tuple[str, str], ...]


def data_path(text: str) -> str:
    """Return the path pattern of ``WORLD:ENTITIES/ASPECT``; ``**`` at the end means all aspects.

    Raises:
        ValueError: It has another form.
    """
    world, _, rest = text.partition(":")
    entities, _, aspect = rest.rpartition("/")
    if aspect == ALL:
        entities, aspect = rest, "*"
    if not world or not entities or not aspect or "/" in world or ALL in (world, aspect):
        raise ValueError(
            f"{text!r} names no data; write WORLD:ENTITIES/ASPECT, such as online:plan/*/joints, or"
            " WORLD:ENTITIES/** for all aspects"
        )
    return f"{world}/{aspect}/{entities}"


def fork_path(text: str) -> str:
    """Return the path pattern of ``SOURCE -> WORLD``.

    Raises:
        ValueError: It has another form.
    """
    names = [name.strip() for name in text.split("->")]
    if len(names) != 2 or not all(names) or "/" in text:
        raise ValueError(
            f"{text!r} names no fork; write SOURCE -> WORLD, such as online -> what_if*"
        )
    return "/".join(names)


class Rights:
    """The rights of a cell.

    Args:
        rules: Everything that is allowed.
        groups: Names, or names with stars, of each group.
        operators: Subjects that may do everything.
        users: The subject of each user of a host, by the user's number.
        known: Names of actors and programs, beside those in rules and groups.
        hint: Where to add a rule, for refusals ("cell.toml, line 41").
    """

    __slots__ = ("_compiled", "_decided", "_groups", "_of", "hint", "known", "operators", "users")

    def __init__(
        self,
        rules: Iterable[Rule],
        *,
        groups: Mapping[str, Collection[str]] | None = None,
        operators: Collection[str] = (),
        users: Mapping[int, str] | None = None,
        known: Collection[str] = (),
        hint: str = "cell.toml",
    ) -> None:
        self._groups = dict(groups or {})
        # Each pattern is compiled once, whatever the number of those that it is given to.
        self._compiled = tuple(
            (rule.who, tuple((right, path, container(path)) for right, path in rule.gives))
            for rule in rules
        )
        self._of: dict[str, dict[str, _Given]] = {}
        self._decided: dict[tuple[str, str, str], bool] = {}
        self.operators = frozenset(operators)
        self.users = dict(users or {})
        self.hint = hint
        named = [name for who, _ in self._compiled for name in who]
        named += [name for members in self._groups.values() for name in members]
        self.known = frozenset((*known, *named, *operators))

    # ---------------------------------------------------------------- decisions

    def may(self, subject: str, right: str, path: str) -> bool:
        """Say whether a subject has a right on everything that a path, or path pattern, covers."""
        key = (subject, right, path)
        found = self._decided.get(key)
        return self._decide(key) if found is None else found

    def may_write_some(self, subject: str, path: str) -> bool:
        """Say whether a subject may write anything at all of what a path pattern covers."""
        if subject == "" or subject in self.operators:
            return True
        given = self._given(subject) if subject != UNPROVEN else {}
        return any(
            patterns_overlap(pattern, path)
            for right in WRITING
            for pattern in (given[right].patterns if right in given else ())
        )

    def _decide(self, key: tuple[str, str, str]) -> bool:
        subject, right, path = key
        if subject == "" or subject in self.operators:
            decision = True
        elif subject == UNPROVEN:
            decision = False
        elif right == WRITE:
            decision = any(self.may(subject, each, path) for each in WRITING)
        else:
            found = self._given(subject).get(right)
            decision = found is not None and found.covers(path)
        if len(self._decided) >= DECISIONS_MAX:
            self._decided.clear()
        self._decided[key] = decision
        return decision

    def _given(self, subject: str) -> Mapping[str, _Given]:
        """Return what the rules give to a subject, by right."""
        found = self._of.get(subject)
        if found is None:
            found = {}
            for who, gives in self._compiled:
                if any(self.means(name, subject) for name in who):
                    for right, path, contains in gives:
                        found.setdefault(right, _Given()).add(path, contains)
            if len(self._of) >= DECISIONS_MAX // 64:
                self._of.clear()
            self._of[subject] = found
        return found

    def means(self, who: str, subject: str) -> bool:
        """Say whether a name of a rule, a name with stars, or a group stands for a subject."""
        if who == subject:
            return True
        if who.startswith("@"):
            return any(self.means(name, subject) for name in self._groups.get(who[1:], ()))
        return "*" in who and pattern_matches(who, subject)

    # ---------------------------------------------------------------- people

    def subject_of(self, user: int, name: str, *, trusted: bool) -> str:
        """Return the subject of a process; "" if its user has none.

        Args:
            user: Its user on this host.
            name: What it calls itself.
            trusted: Whether this user may speak under any name.  A name that no rule knows is
                then that of the user, so that an operator's tools need no names.
        """
        own = f"uid:{user}"
        if trusted:
            return own if own in self.operators and name not in self.known else name
        return self.users.get(user) or (own if own in self.operators else "")

    def refuse(self, subject: str, asker: str, right: str, what: Slot | str) -> Refused:
        """Refuse a request of `asker` that would have used the rights of `subject`."""
        on = f" {shown(what)}" if what else ""
        if subject == UNPROVEN:
            return Refused(
                NOT_PROVEN,
                f"{asker} asked to {right}{on} over Zenoh, where its name is only its own word;"
                " with [rights] and without keys a shard serves its socket alone; run on the"
                " shard's host, or try again if the socket was busy",
            )
        does = "declares no such request" if right in (*DATA_RIGHTS, WRITE) else "has no such right"
        return Refused(
            PERMISSION,
            f"{subject} may not {right}{on}: it {does} and no [[rights.allow]] gives it; `enact"
            f" actor check --rights`, or add it ({self.hint})",
            (subject, right, self.hint, *(() if isinstance(what, str) else what)),
        )


def shown(what: Slot | str) -> str:
    """Return what a request is about as rules and refusals name it."""
    return what if isinstance(what, str) else f"{what.context}:{what.entity}/{what.aspect}"


class _Given:
    """The patterns on which one subject has one right.

    Most decisions only compare the text before the first star of each, and behind the last one.
    """

    __slots__ = ("_by_first", "_starred", "patterns")

    def __init__(self) -> None:
        self.patterns: list[str] = []
        self._by_first: dict[str, list[_Ends]] = {}
        self._starred: list[_Ends] = []

    def add(self, pattern: str, contains: Callable[[str], object]) -> None:
        """Add a pattern, with the function that its text compiles to."""
        first = pattern.partition("/")[0]
        self.patterns.append(pattern)
        where = self._starred if "*" in first else self._by_first.setdefault(first, [])
        head, tail = pattern.partition("*")[0], pattern.rpartition("*")[2]
        if pattern.endswith(f"**{tail}"):  # it may stand for no segment at all
            tail = tail.removeprefix("/")
        where.append((head, f"{tail}/", contains))

    def covers(self, path: str) -> bool:
        """Say whether one of the patterns contains all that a path pattern covers."""
        text = contained(path)
        for some in (self._by_first.get(path.partition("/")[0], ()), self._starred):
            for head, tail, contains in some:
                if text.startswith(head) and text.endswith(tail) and contains(text) is not None:
                    return True
        return False


def path_of(slot: Slot) -> str:
    """Return the path of a slot, or of the slots of a pattern of entities."""
    return f"{slot.context}/{slot.aspect}/{slot.entity}"
