"""`Actor`: declares what it reads and writes; the framework locks, triggers, commits, retries.

The class attributes that are lock requests form the declared lock.  Everything that can be wrong
with a declaration is found when the class is made, not when it runs: see `Declaration.of`.

What a run promises to `update(self, lock)`:

- All declared requests are granted together; leaving `update` normally publishes all writes at
  once, an exception publishes nothing.
- It is called with the newest data, by one thread at a time.
- It may be called again for a datum that it has seen: at each start (once per existing entity),
  after its lock was lost (`hold_s` has passed, or the shard was away for long), and after a commit
  whose answer was lost.  So an update computes its results from its inputs; it neither counts calls
  nor moves anything.  An actor that moves something sets `once = True`.
- Attributes that it sets stay set if its commit then fails.  What must not be ahead of the data is
  an aspect, or is kept with the stamp of its input, or with the version that its output then has
  (`lock.version(output) + 1`), and counts when the next update sees that one.

Departure from ENACT 3.1: the paper's actor owns a fixed set of entities E_a; here E_a is a name
pattern, because its own 4.2 meets new entities at run time.
"""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final, Self

from enact_dist.access.together import Together
from enact_dist.errors import MisuseError
from enact_dist.outcome import Outcome, outcome_of
from enact_dist.patterns import patterns_overlap
from enact_dist.terms import (
    Entities,
    Entity,
    LockRequest,
    Read,
    ReadEach,
    View,
    ViewEach,
    World,
    Write,
    refuse_duplicates,
)

if TYPE_CHECKING:
    from enact_dist.access.lock import Lock

Declared = LockRequest[Any]
"""A lock request of an actor class, of whatever datum type."""

_READING: Final = "Read, View, ReadEach or ViewEach"
_METHODS: Final = {"update": ("self", "lock"), "start": ("self",), "stop": ("self",)}
"""What a user writes, and what each is called with."""
_NEVER_RUN: Final = (
    (inspect.iscoroutinefunction, "an `async def`", "write asyncio.run(…)"),
    (inspect.isasyncgenfunction, "an asynchronous generator", "write asyncio.run(…)"),
    (inspect.isgeneratorfunction, "a generator, for it has a `yield`", "do all of it"),
)
"""Functions whose calls only make an object."""


class Actor:
    """Base of all actors: what it needs as class attributes, what it does in `update`.

    ::

        class DeviationDetection(Actor):
            '''Flag a product whose observed surface deviates from its trained one.'''

            training, online = World("training"), World("online")
            reference = View(training, PRODUCTS, SURFACE)      # PRODUCTS = Entities("product/*")
            observed = View(online, PRODUCTS, SURFACE)
            flags = Write(online, SYSTEM, DEVIATIONS)          # SYSTEM = Entity("system")
            triggers = (observed,)

            def __init__(self, tolerance_m: float = 0.003) -> None:
                self.tolerance_m = tolerance_m

            def update(self, lock: Lock) -> None:
                found = deviation(lock[self.reference], lock[self.observed], self.tolerance_m)
                lock[self.flags] = {**lock.get(self.flags, {}), lock.entity.name: found}

    The worlds are roles, bound to world contexts when the actor runs.  A pattern in a request
    without ``Each`` stands for the triggering entity; ``…Each`` always means all that match.

    `only_entity` makes an actor one of several alike: every pattern without ``Each`` stands for
    that entity, and only its data trigger.  So one class serves eight cameras, and each of them
    has a process, a lock and a slot of its own.

    When `update` runs:

    - with `triggers`: once per existing entity at the start, then once per entity whose trigger
      datum changed, for the newest datum; changes that came faster are counted as skipped.  Where
      no request stands for the triggering entity (only single entities and ``…Each``), one update
      sees everything: all changes share one run, and `lock.entity` is the one that changed last.
      A datum that became null triggers only through ``…Each``: there the set has changed.
    - with one `Together` as the only trigger: once per complete set of data that bear the same
      capture stamp, in the order of their stamps; at the start for the newest one.  `lock[…]` of
      the `Together`, or of a `View` in it, shows the data of that stamp, whatever came later.
      Sets that stay incomplete are counted and named, see `enact actor ls`.
    - with `every_s`: at that rate, at the multiples of the period since 1970, so that sources of
      one period tick together; late ticks are counted as missed.
      A tick whose lock was refused is over: the next one takes a newer measurement.
    - with neither: once, then the actor is done.

    What an update writes bears the capture stamp of what caused it, unless `lock.put(…, stamp_ns=)`
    says another (0: none): of a set its stamp; of other triggers the newest stamp among their data
    of `lock.entity`; of a source `lock.tick_ns`.  So a camera's stamp goes on to what is made of
    its images, and a `Together` behind that finds its sets.

    An update that raises is reported and counted and not run again before its entity changes: an
    update is a function of what it reads, so the same data would fail again.  Hence every datum
    whose arrival makes an update possible belongs into `triggers`.  Refusals that are not its
    fault (lock not granted in time, lease lost, viewed datum changed, shard away) are tried again
    with growing pauses until they succeed.

    Attributes:
        triggers: Declared reading requests; the actor must not write what triggers it.
        every_s: Period of a source in seconds; may be set per instance.
        once: True for an actor that moves something: each version of its only trigger is acted on
            at most once, under no lock, whatever dies.  See *Actuators* in `enact_dist/docs`.
        in_phase: False lets the ticks of `every_s` begin when the actor is ready, in place of
            the multiples of the period: for sources that would disturb each other.
        only_entity: The one entity that an instance works on, of those that its patterns match; a
            source needs it where it names a pattern.  `entity` in `cell.toml`, ``--entity``; of
            what `__init__` sets, `enact actor check` knows nothing.  A `Together` names its
            entities itself and cannot be narrowed.
        wait_s: How long one attempt waits for its lock.
        hold_s: How long an update may hold its lock; a longer one loses it and commits nothing.
        shared: Declared writes whose slots other actors write too, on purpose; any two other
            writers of one slot are reported by `enact actor check`.
        declaration: What the class declares, checked.
    """

    triggers: ClassVar[
        Sequence[Read[Any] | View[Any] | ReadEach[Any] | ViewEach[Any] | Together[Any]]
    ] = ()
    shared: ClassVar[Sequence[LockRequest[Any]]] = ()
    every_s: float | None = None
    in_phase: bool = True
    once: ClassVar[bool] = False
    only_entity: Entity | None = None
    wait_s: float = 10.0
    hold_s: float = 60.0
    declaration: ClassVar[Declaration]

    def __init_subclass__(cls, **options: object) -> None:
        """Check the declaration.

        Raises:
            MisuseError: Something in it cannot work; names the class and the attribute.
        """
        super().__init_subclass__(**options)
        cls.declaration = Declaration.of(cls)

    @classmethod
    def of_options(cls, options: Mapping[str, object]) -> type[Self]:  # noqa: ARG003
        """Return the class whose declaration follows from options; an actor is made of that one.

        A class overrides it where an option decides what it declares, such as the number of views.

        Args:
            options: As of `__init__`, as `cell.toml` or a command line gives them, converted.

        Raises:
            ValueError: There is no such class for these options.
        """
        return cls

    def update(self, lock: Lock) -> None:
        """Do what this actor is for, once; the only method that must be overridden.

        Args:
            lock: Holds all declared requests; `lock.entity` is the triggering entity.
        """
        raise NotImplementedError(f"{type(self).__name__} defines no update(self, lock)")

    def start(self) -> None:
        """Open what updates need (a camera, a model file).  Called once, before any lock."""

    def stop(self) -> None:
        """Close what `start` opened.  Called once, also after an error; no lock is held."""


@dataclass(frozen=True, slots=True)
class Declaration:
    """What an actor class reads, writes and is triggered by.

    Attributes:
        actor: Name of the class.
        requests: The declared requests by attribute name.
        triggers: Those that trigger.
        shared: Writes that declare other writers.
        roles: Names of the world roles that the requests use, in order of appearance.
        per_entity: Whether some request refers to the triggering entity.
        together: The set that triggers, whose views are the `triggers`; None without one.
        outcome: Where an actor with `once` records the outcome of each version; None without.
    """

    actor: str
    requests: Mapping[str, Declared]
    triggers: tuple[Declared, ...]
    shared: tuple[Declared, ...]
    roles: tuple[str, ...]
    per_entity: bool
    together: Together[Any] | None = None
    outcome: Write[Outcome] | None = None

    @staticmethod
    def of(actor_class: type[Actor]) -> Declaration:
        """Read and check what an actor class declares.

        Raises:
            MisuseError: A request without a `World` role, two accesses to one datum, a trigger
                that is not declared or not a reading request or written by the actor itself, both
                `triggers` and `every_s`, a pattern that no triggering entity can match, a method
                that is `async`, a generator or takes other arguments, an `update` without any
                request, a `Together` that is not the only trigger, a `once` that does not go with
                the triggers or has no request for its outcomes.
        """
        requests = _requests_of(actor_class)
        together = _together_of(actor_class, requests)
        chosen = () if together is not None else _chosen(actor_class, "triggers", requests)
        triggers = together.requests if together is not None else chosen
        declaration = Declaration(
            actor=actor_class.__name__,
            requests=requests,
            triggers=triggers,
            outcome=outcome_of(actor_class.__name__, actor_class.once, requests, triggers),
            together=together,
            shared=_chosen(actor_class, "shared", requests),
            roles=tuple(dict.fromkeys(request.world.name for request in requests.values())),
            per_entity=any(stands_for_trigger(request) for request in requests.values()),
        )
        if actor_class.update is not Actor.update:
            _check_methods(actor_class)
            _check_schedule(actor_class, declaration)
            _check_accesses(declaration)
            _check_patterns(declaration)
        return declaration

    def name_of(self, request: Declared) -> str:
        """Return `Class.attribute` of a declared request, for messages."""
        for name, declared in self.requests.items():
            if declared == request:
                return f"{self.actor}.{name}"
        return f"{self.actor}: {request!r}"

    def covers(self, entity: Entity) -> bool:
        """Return whether all requests for the triggering entity can refer to `entity`."""
        return all(
            request.entity.matches(entity)
            for request in self.requests.values()
            if stands_for_trigger(request) and isinstance(request.entity, Entities)
        )

    def check_entity(self, only: Entity | None) -> None:
        """Check which one entity an instance works on.

        Raises:
            MisuseError: It is none though a pattern without a trigger needs one, or it is one that
                a pattern does not match or that cannot trigger.
        """
        patterned = [one for one in self.requests.values() if stands_for_trigger(one)]
        if only is None:
            if patterned and not self.triggers:
                raise MisuseError(
                    f"{self.name_of(patterned[0])} is {patterned[0]!r}: its pattern stands for one"
                    f" entity, but {self.actor} has no triggers and no only_entity; say which one"
                    " (entity in cell.toml, --entity, actor.only_entity), or use"
                    f" {type(patterned[0]).__name__}Each for all that match"
                )
            return
        if not isinstance(only, Entity):
            raise MisuseError(f"{self.actor}.only_entity is {only!r}; it must be an Entity")
        if not patterned:
            raise MisuseError(
                f"{self.actor} has no request whose pattern could stand for {only}; leave"
                " only_entity out"
            )
        for request in (*patterned, *self.triggers):
            if not patterns_overlap(str(request.entity), only.name):
                raise MisuseError(
                    f"{self.name_of(request)} is {request!r}, which {only} does not match; give"
                    f" {self.actor} another only_entity"
                )


def stands_for_trigger(request: Declared) -> bool:
    """Say whether a request's entity is the triggering one: a pattern without `Each`."""
    return isinstance(request.entity, Entities) and not request.access.each


def narrowed(request: Declared, only: Entity | None) -> Declared:
    """Return the bound form of a request in an actor that works on only one entity."""
    if not isinstance(only, Entity) or not stands_for_trigger(request):
        return request
    return type(request)(request.world, only, request.aspect)


def name_of(actor: Actor) -> str:
    """Return the default name of an actor: its class, and its entity if it has only one."""
    only = actor.only_entity
    own = f"-{only.name.replace('/', '-')}" if isinstance(only, Entity) else ""
    return f"{type(actor).__name__}{own}"


def same_data(one: Declared, other: Declared) -> bool:
    """Say whether two requests of one context could name one datum."""
    return one.aspect.name == other.aspect.name and patterns_overlap(
        str(one.entity), str(other.entity)
    )


def _attributes(actor_class: type[Actor]) -> dict[str, Declared | Together[Any]]:
    """Return the class attributes that declare data, those of base classes first."""
    declared: dict[str, Declared | Together[Any]] = {}
    for base in reversed(actor_class.__mro__):
        for name, value in vars(base).items():
            declared.pop(name, None)
            if isinstance(value, LockRequest | Together):
                declared[name] = value
    return declared


def _together_of(
    actor_class: type[Actor], requests: Mapping[str, Declared]
) -> Together[Any] | None:
    """Return the set that triggers an actor, checked."""
    declared = [one for one in _attributes(actor_class).values() if isinstance(one, Together)]
    triggers = _listed(actor_class, "triggers")
    if not declared and not any(isinstance(one, Together) for one in triggers):
        return None
    name = actor_class.__name__
    if len(declared) != 1 or list(triggers) != declared:
        raise MisuseError(
            f"{name} declares {declared or 'no Together'} and triggers {actor_class.triggers!r};"
            " a Together is a class attribute of its actor and its only trigger"
        )
    for attribute, request in requests.items():
        if stands_for_trigger(request):
            raise MisuseError(
                f"{name}.{attribute} is {request!r}: its pattern stands for the triggering entity,"
                f" but a set triggers {name}; name one entity, or use"
                f" {type(request).__name__}Each for all that match"
            )
    return declared[0]


def _requests_of(actor_class: type[Actor]) -> dict[str, Declared]:
    requests: dict[str, Declared] = {}
    for name, value in _attributes(actor_class).items():
        if isinstance(value, Together):
            requests |= {f"{name}[{index}]": one for index, one in enumerate(value.requests)}
        else:
            requests[name] = value
    for name, request in requests.items():
        if not isinstance(request.world, World):
            raise MisuseError(
                f"{actor_class.__name__}.{name} names {request.world!r}; the requests of an actor"
                f' class name roles such as World("{request.world.name}"), which are bound to'
                " world contexts when the actor runs"
            )
    return requests


def _chosen(
    actor_class: type[Actor], attribute: str, requests: Mapping[str, Declared]
) -> tuple[Declared, ...]:
    chosen = _listed(actor_class, attribute)
    triggering = attribute == "triggers"
    for index, request in enumerate(chosen):
        where = f"{actor_class.__name__}.{attribute}[{index}]"
        if not isinstance(request, LockRequest) or request not in requests.values():
            raise MisuseError(
                f"{where} is {request!r}, which is no request of this class; it declares"
                f" {', '.join(requests) or 'none'}"
            )
        if request.access.writes is triggering:
            wanted = f"{_READING} can trigger" if triggering else "Write or WriteEach is shared"
            raise MisuseError(f"{where} is {request!r}; only a {wanted}")
    return tuple(chosen)


def _listed(actor_class: type[Actor], attribute: str) -> Sequence[Any]:
    """Return `triggers` or `shared`, which must be a list, also of one."""
    chosen: object = getattr(actor_class, attribute)
    if isinstance(chosen, Sequence) and not isinstance(chosen, str):
        return chosen
    attributes = _attributes(actor_class)
    name = next((n for n, value in attributes.items() if value is chosen and n != attribute), "")
    which = name or "NAME" + (", …" if isinstance(chosen, set | frozenset) else "")
    raise MisuseError(
        f"{actor_class.__name__}.{attribute} is {chosen!r}, which is no list or tuple; write"
        f" {attribute} = [{which}], a list even of one"
        + ("" if name else ", of requests that are attributes of the class")
    )


def _check_schedule(actor_class: type[Actor], declaration: Declaration) -> None:
    name, every_s = declaration.actor, actor_class.every_s
    if not declaration.requests:
        raise MisuseError(
            f"{name} declares no lock request; give it class attributes such as"
            ' observed = View(World("online"), PRODUCTS, SURFACE)'
        )
    if every_s is not None:
        check_period(name, every_s)
        if declaration.triggers:
            raise MisuseError(
                f"{name} has both triggers and every_s = {every_s!r}; an actor is triggered by"
                " data or by time, so split it in two"
            )


def check_update(actor_class: type[Actor]) -> None:
    """Raise `MisuseError` unless an actor class says what an update does."""
    if actor_class.update is Actor.update:
        raise MisuseError(
            f"{actor_class.__qualname__} of {actor_class.__module__} is no actor that can run; make"
            " an instance of a subclass of Actor that defines update(self, lock)"
        )


def _check_methods(actor_class: type[Actor]) -> None:
    """Refuse a method that a call would not run, or that cannot be called as it will be."""
    for name, words in _METHODS.items():
        method = inspect.getattr_static(actor_class, name)
        if not isinstance(method, types.FunctionType):
            continue  # a static method or another callable: its own business
        full = f"{actor_class.__name__}.{name}"
        for is_kind, kind, remedy in _NEVER_RUN:
            if is_kind(method):
                raise MisuseError(
                    f"{full} is {kind}: a call of it runs nothing of it; {remedy} inside"
                    f" `def {name}({', '.join(words)})`"
                )
        try:
            inspect.signature(method).bind(*words)
        except TypeError as error:
            raise MisuseError(
                f"{full} cannot be called ({error}); write `def {name}({', '.join(words)})`"
            ) from None


def check_period(name: str, every_s: object) -> None:
    """Raise `MisuseError` unless `every_s` is a period."""
    number = every_s if isinstance(every_s, (int, float)) else math.nan
    if isinstance(every_s, bool) or not math.isfinite(number) or number <= 0:
        raise MisuseError(f"{name}.every_s is {every_s!r}; it must be a period in seconds, > 0")


def _check_accesses(declaration: Declaration) -> None:
    try:
        refuse_duplicates(declaration.requests.values())
    except ValueError as error:
        raise MisuseError(f"{declaration.actor}: {error}") from None
    for trigger in declaration.triggers:
        for request in declaration.requests.values():
            if (
                request.access.writes
                and request.world.name == trigger.world.name
                and same_data(request, trigger)
            ):
                raise MisuseError(
                    f"{declaration.name_of(request)} writes what {declaration.name_of(trigger)}"
                    f" triggers on ({request!r}, {trigger!r}): each update would cause the next"
                    " one; write another aspect, or use every_s"
                )


def _check_patterns(declaration: Declaration) -> None:
    for request in declaration.requests.values():
        if not stands_for_trigger(request):
            continue
        where = declaration.name_of(request)
        for trigger in declaration.triggers:
            if not patterns_overlap(str(request.entity), str(trigger.entity)):
                raise MisuseError(
                    f"{where} is {request!r}: no entity that triggers through"
                    f" {declaration.name_of(trigger)} ({trigger.entity}) can match"
                    f" {request.entity}; use {type(request).__name__}Each for all that match"
                )
