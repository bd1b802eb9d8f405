"""Static check of a cell's actors: their reads and writes, before any actor runs.

Reported are (error: `enact up` refuses; warning: it says so and starts; advice: it starts):

=======  ===================  ===================================================================
level    kind                 what
=======  ===================  ===================================================================
error    no such actor        a class, option or period of `cell.toml` that cannot be used
error    broken module        a module that raises at its import, and where
error    unbound role         a role that no world context is bound to
error    unknown role         a binding for a role that the actor does not have
error    unknown world        a world context that the cell does not list
error    unknown aspect       an aspect that the cell does not list
error    no such entity       the one `entity` of an actor does not match what it declares
error    two types            one aspect name with two datum types
error    impossible type      an aspect whose type no datum can have
error    own trigger          an actor that, as bound, writes what triggers it
error    two writers          two actors that write one slot, not both declaring it as `shared`
error    rights stale         `rights.toml` differs from what the actors declare, or is missing
error    right missing        an actor declares what no rule gives to it (`default = "none"`)
warning  entity unsaid        an actor without triggers names a pattern, and neither `cell.toml` nor
                              its class says for which entity: its `__init__` has to
warning  unwritten trigger    a trigger that no actor writes: only a write from outside runs it
warning  unwritten read       a reading request for data that no actor writes
warning  set not retained     an aspect of a `Together` has no history (retention = 1): a set is
                              gone as soon as one of its slots moves on
warning  set without stamps   a datum of a `Together` that no actor writes with a capture stamp
warning  right unused         a rule gives actors what none of them declares
warning  unused aspect        `cell.toml` configures an aspect that no actor names: misspelt?
advice   durable stream       data that are written ten times a second or more, each forced to the
                              disk as nothing says how durable they are
=======  ===================  ===================================================================

World contexts and aspects are checked against the given list only, types against each other.  The
check contacts no shard; an actor whose datum type differs from the one that a shard knows is
refused when it starts.  A write of a pattern without `Each` is assumed to reach all that the
pattern matches, whatever triggers its actor.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

from enact_dist.actor.rights_check import differences
from enact_dist.actor.running.doing import raised
from enact_dist.actor.running.load import check_every_s, load_class, read_options
from enact_dist.actor.uses import ActorDeclaration, Use, declared_rights, uses_of
from enact_dist.config.rights import text_of_declared
from enact_dist.config.table import suggestion
from enact_dist.core.protocol.datum_types import newest, type_conflict
from enact_dist.core.protocol.messages import AspectEntry
from enact_dist.core.state.retention import limits_of, stated_limits, with_larger
from enact_dist.errors import ConfigError, DatumTypeError, MisuseError
from enact_dist.retention import checked_retention
from enact_dist.terms import Entity

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from enact_dist.actor.actor import Actor
    from enact_dist.config.types import CellConfig


STREAM_S: Final = 0.1
"""Data that are written this often, or more often, are a stream."""

WRITERS_SHOWN_MAX: Final = 4
"""Writers of one slot that an error shows with their requests."""

Level = Literal["error", "warning", "advice"]


@dataclass(frozen=True, slots=True)
class ActorFinding:
    """One thing that is wrong, or likely so, with the actors of a cell.

    Attributes:
        kind: As in the table of this module.
    """

    level: Level
    kind: str
    actors: tuple[str, ...]
    text: str

    def __str__(self) -> str:
        return f"{self.level}: {self.kind}: {self.text}"


def check_actors(
    actors: Sequence[ActorDeclaration],
    *,
    worlds: Collection[str] = (),
    initial: Collection[str] = (),
) -> tuple[ActorFinding, ...]:
    """Check all declared reads and writes of a cell against each other.

    Args:
        actors: Every actor that runs in the cell.
        worlds: World contexts of the cell; empty: any.
        initial: Names of aspects that are written from outside (`init`, other programs).

    Returns:
        Errors first, each kind in the order of `actors`.
    """
    uses = list(uses_of(actors))
    findings = [
        *_roles(actors, worlds),
        *_entities(actors),
        *_types(uses),
        *_own_triggers(uses),
        *_writers(uses),
        *_unwritten(uses, initial),
        *_unstamped_sets(uses),
    ]
    return _ordered(findings)


def check_cell(config: CellConfig, *, initial: Collection[str] = ()) -> tuple[ActorFinding, ...]:
    """Check all actors that a `cell.toml` configures: that they load, and `check_actors`.

    No actor is made; only its module is imported.  An actor without `worlds` in the file has each
    role bound to the world context of its name, as running it does.  A `cell.toml` lists only
    aspects that differ from what the actors declare, so an aspect that it does not list is no
    finding.

    Args:
        config: The cell.
        initial: Names of aspects that are written from outside (`init`, other programs).
    """
    actors, findings = declarations_of(config)
    findings += check_actors(actors, worlds=config.worlds, initial=initial)
    findings += _streams(
        list(uses_of(actors)), {one.name for one in config.aspects if one.durability}
    )
    findings += _sets(actors, {entry.name: entry for entry in config.aspect_entries()})
    if len(actors) == len(config.actors):
        for kind, actor, text in differences(config, actors):
            level: Level = "warning" if kind == "right unused" else "error"
            findings.append(ActorFinding(level, kind, (actor,) if actor else (), text))
    named = {
        request.aspect.name
        for actor in actors
        for request in actor.actor_class.declaration.requests.values()
    }
    for entry in config.aspects if len(actors) == len(config.actors) and actors else ():
        if entry.name not in named:
            findings.append(
                ActorFinding(
                    "warning",
                    "unused aspect",
                    (),
                    f"{config.path} configures the aspect {entry.name}, which no actor of the cell"
                    f" reads or writes{suggestion(entry.name, named)}",
                )
            )
    return _ordered(findings)


def declarations_of(config: CellConfig) -> tuple[list[ActorDeclaration], list[ActorFinding]]:
    """Return the actors of a `cell.toml` that load, and what is wrong with those that do not."""
    findings: list[ActorFinding] = []
    actors: list[ActorDeclaration] = []
    for actor in config.actors:
        try:
            actor_class = load_class(actor.class_path)
            only = Entity(actor.entity) if actor.entity else actor_class.only_entity
            declared = ActorDeclaration(
                actor.name, actor_class, actor.worlds or None, only, actor.every_s
            )
            actors.append(declared)
            chosen = _of_options(actor_class, read_options(actor_class, actor.options))
            actors[-1] = replace(declared, actor_class=chosen)
            if actor.every_s is not None:
                check_every_s(actor_class, actor.every_s)
        except MisuseError as error:
            if type(error) is ConfigError:
                text = f"actor {actor.name}: {error}"
                findings.append(ActorFinding("error", "no such actor", (actor.name,), text))
                continue
            text = f"actor {actor.name} ({actor.class_path}): {raised(error.__cause__ or error)}"
            findings.append(ActorFinding("error", "broken module", (actor.name,), text))
    return actors, findings


def rights_text(config: CellConfig) -> str:
    """Return `rights.toml` as it follows from the declarations of a cell's actors.

    Raises:
        ConfigError: An actor cannot be loaded.
    """
    actors, findings = declarations_of(config)
    if findings:
        raise ConfigError(findings[0].text, path=str(config.path))
    return text_of_declared(declared_rights(actors))


def _of_options(actor_class: type[Actor], options: Mapping[str, object]) -> type[Actor]:
    """Return the class that options make of one.

    Raises:
        ConfigError: It refuses them.
    """
    try:
        return actor_class.of_options(options)
    except ValueError as error:
        raise ConfigError(f"{actor_class.__name__} refuses its options: {error}") from error


def _sets(
    actors: Iterable[ActorDeclaration], configured: Mapping[str, AspectEntry]
) -> Iterator[ActorFinding]:
    """Find sets of data without history, as `cell.toml` or the actor declares their retention."""
    for actor in actors:
        together = actor.actor_class.declaration.together
        for request in together.requests if together is not None else ():
            aspect = request.aspect
            entry = AspectEntry(
                aspect.name, "", "", *stated_limits(checked_retention(aspect.retention))
            )
            entry = with_larger(entry, configured.get(aspect.name, entry))
            if limits_of(entry).versions == 1:
                yield ActorFinding(
                    "warning",
                    "set not retained",
                    (actor.name,),
                    f"{request!r} of {actor.name} is part of a set, and {aspect.name} has no"
                    " history: the set is gone as soon as this datum is written again; give"
                    f" [aspects.{aspect.name}] or Aspect(…) a retention of as many versions as"
                    " are under way at once",
                )


def _ordered(findings: Iterable[ActorFinding]) -> tuple[ActorFinding, ...]:
    levels = ("error", "warning", "advice")
    return tuple(sorted(findings, key=lambda finding: levels.index(finding.level)))


def _roles(actors: Iterable[ActorDeclaration], worlds: Collection[str]) -> Iterator[ActorFinding]:
    for actor in actors:
        roles = actor.actor_class.declaration.roles
        for role in roles:
            world = actor.world_of(role)
            if world is None:
                yield ActorFinding(
                    "error",
                    "unbound role",
                    (actor.name,),
                    f"role {role} of actor {actor.name} is bound to no world context; bind it"
                    f" with worlds = {{ {role} = NAME }}, or --world {role}=NAME",
                )
            elif worlds and world not in worlds:
                yield ActorFinding(
                    "error",
                    "unknown world",
                    (actor.name,),
                    f"role {role} of actor {actor.name} is bound to {world}, which the cell does"
                    f" not have; it has {', '.join(sorted(worlds))}",
                )
        for role in actor.worlds or ():
            if role not in roles:
                yield ActorFinding(
                    "error",
                    "unknown role",
                    (actor.name,),
                    f"actor {actor.name} has no role {role}; it has {', '.join(roles)}",
                )


def _entities(actors: Iterable[ActorDeclaration]) -> Iterator[ActorFinding]:
    for actor in actors:
        unsaid = actor.unsaid
        try:
            actor.actor_class.declaration.check_entity(actor.entity)
        except MisuseError as error:
            kind = "entity unsaid" if unsaid else "no such entity"
            text = f"actor {actor.name}: {error}"
            yield ActorFinding("warning" if unsaid else "error", kind, (actor.name,), text)


def _types(uses: Sequence[Use]) -> Iterator[ActorFinding]:
    """Yield the uses of an aspect with a type that does not go with the newest one written."""
    from enact_dist.wire.fingerprint import fingerprint

    known: dict[str, tuple[Use, AspectEntry]] = {}
    entries: list[tuple[Use, AspectEntry]] = []
    for use in uses:
        aspect, reads = use.request.aspect, not use.request.access.writes
        try:
            entry = AspectEntry(aspect.name, fingerprint(aspect.datum_type), "", reads=reads)
        except DatumTypeError as error:
            yield ActorFinding("error", "impossible type", (use.actor.name,), f"{use}: {error}")
        else:
            entries.append((use, entry))
    for use, entry in sorted(entries, key=lambda each: each[1].reads):  # first those that write
        _, before = known.setdefault(entry.name, (use, entry))
        if not entry.reads and newest(before, entry) == entry:
            known[entry.name] = (use, entry)
    for use, entry in entries:
        other, registered = known[entry.name]
        if use is not other and type_conflict(registered, entry):
            yield ActorFinding(
                "error",
                "two types",
                (other.actor.name, use.actor.name),
                f"aspect {entry.name} is {registered.fingerprint} for {other}, but"
                f" {entry.fingerprint} for {use}",
            )


def _own_triggers(uses: Sequence[Use]) -> Iterator[ActorFinding]:
    for use in uses:
        if use.request not in use.actor.actor_class.declaration.triggers:
            continue
        for other in uses:
            if other.actor is use.actor and other.request.access.writes and other.meets(use):
                yield ActorFinding(
                    "error",
                    "own trigger",
                    (use.actor.name,),
                    f"{other} writes what {use} triggers on, so each update causes the next one;"
                    " bind the roles to different world contexts",
                )


def _writers(uses: Sequence[Use]) -> Iterator[ActorFinding]:
    """Find slots of several writers; eight copies of an actor are one mistake, not 28."""
    # The slot that an unsaid one writes is not known.
    writes = [use for use in uses if use.request.access.writes and not use.unsaid]
    told: set[int] = set()
    for index, one in enumerate(writes):
        later = range(index + 1, len(writes)) if index not in told else ()
        rivals = {at: writes[at] for at in later if _are_rivals(one, writes[at])}
        if not rivals:
            continue
        told |= {at for at, other in rivals.items() if other.named.address == one.named.address}
        *first, last = [str(use) for use in (one, *rivals.values())][:WRITERS_SHOWN_MAX]
        more = len(rivals) + 1 - WRITERS_SHOWN_MAX
        first, last = ([*first, last], f"{more} more") if more > 0 else (first, last)
        yield ActorFinding(
            "error",
            "two writers",
            tuple(dict.fromkeys(use.actor.name for use in (one, *rivals.values()))),
            f"{', '.join(first)} and {last} can write one slot, and the later one hides the other's"
            " datum; give each its own, or list the request in `shared` of all their classes if"
            " each keeps what the other wrote",
        )


def _are_rivals(one: Use, other: Use) -> bool:
    both = one.shared and other.shared
    return one.actor is not other.actor and not both and one.meets(other)


def _unwritten(uses: Sequence[Use], initial: Collection[str]) -> Iterator[ActorFinding]:
    writes = [use for use in uses if use.request.access.writes]
    for use in uses:
        request = use.request
        if request.access.writes or request.aspect.name in initial:
            continue
        if any(write.meets(use) for write in writes):
            continue
        triggers = request in use.actor.actor_class.declaration.triggers
        yield ActorFinding(
            "warning",
            "unwritten trigger" if triggers else "unwritten read",
            (use.actor.name,),
            f"no actor of the cell writes what {use} {'waits for' if triggers else 'reads'};"
            " it stays null unless something outside writes it",
        )


# ---------------------------------------------------------------- what flows from actor to actor
# A source stamps its data with its tick.  Actors that it triggers write with the same stamp, and so
# do the actors that these trigger.  A declaration does not show how often a triggered actor writes.


def _unstamped_sets(uses: Sequence[Use]) -> Iterator[ActorFinding]:
    """Find data of a `Together` whose known writers set no capture stamp."""
    stamping = _stamping(uses)
    for use in uses:
        together = use.actor.actor_class.declaration.together
        if together is None or use.request not in together.requests:
            continue
        writers = _writers_of(use, uses)
        if not writers or any(writer.actor.name in stamping for writer in writers):
            continue
        writer = writers[0]
        why = (
            "runs once" if not writer.actor.actor_class.declaration.triggers
            else "is triggered by data without one"
        )  # fmt: skip
        yield ActorFinding(
            "warning",
            "set without stamps",
            (use.actor.name, writer.actor.name),
            f"{use} waits for data with equal capture stamps, but {writer} writes them without one:"
            f" {writer.actor.name} {why}, and its module never uses stamp_ns; call"
            " lock.put(…, stamp_ns=…), or let a source or stamped data trigger it",
        )


def _streams(uses: Sequence[Use], said: Collection[str]) -> Iterator[ActorFinding]:
    """Find aspects written often that are durable by default alone; `said` are set in the file."""
    told = {use.request.aspect.name for use in uses if use.request.aspect.durability} | set(said)
    for use in uses:
        period_s, aspect = use.actor.period_s, use.request.aspect.name
        if period_s is None or period_s > STREAM_S:
            continue
        if not use.request.access.writes or aspect in told:
            continue
        told.add(aspect)
        yield ActorFinding(
            "advice",
            "durable stream",
            (use.actor.name,),
            f"{use} may be written {1 / period_s:.3g} times a second, and each write is forced to"
            " the disk, because no durability is set; if each datum replaces the one before, write"
            f' [aspects.{aspect}] durability = "volatile" in cell.toml (or in Aspect(…)), else'
            ' "os" or "durable" to confirm that this is intended',
        )


def _stamping(uses: Sequence[Use]) -> set[str]:
    """Return the names of the actors whose data have a capture stamp, or may have one."""
    found = {
        use.actor.name for use in uses if use.actor.period_s is not None or _says_stamps(use.actor)
    }
    while True:
        more = {
            use.actor.name
            for use in uses
            if _triggers(use) and use.actor.name not in found and _is_stamped(use, uses, found)
        }
        if not more:
            return found
        found |= more


def _is_stamped(use: Use, uses: Sequence[Use], stamping: Collection[str]) -> bool:
    """Whether what triggers through a request has a stamp; of outside writers it may."""
    writers = _writers_of(use, uses)
    return not writers or any(writer.actor.name in stamping for writer in writers)


def _says_stamps(actor: ActorDeclaration) -> bool:
    module = inspect.getmodule(actor.actor_class)
    try:
        return "stamp_ns" in inspect.getsource(module or actor.actor_class)
    except (OSError, TypeError):
        return True  # its source is not here: assume that it does


def _triggers(use: Use) -> bool:
    return use.request in use.actor.actor_class.declaration.triggers


def _writers_of(use: Use, uses: Sequence[Use]) -> list[Use]:
    return [one for one in uses if one.request.access.writes and one.meets(use)]
