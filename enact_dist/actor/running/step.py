"""One step of an actor again: what the commit of a version had read, and today's code.

::

    step = Step(cell, "online", "system", "deviation", version=12)
    result = step.run(DeviationDetection(), keep_as="")
    result.differences                       # how what it wrote then and writes now differ

The step runs in world contexts of its own, one for each that the actor is bound to.  They hold the
versions that the commit had read.  Everything else that the actor declares is as it was just before
that commit, as far as the history still knows it.  So a step needs no more of the past than its own
inputs; a fork of a whole context would need every slot of that moment.  No other world context is
written, and no actor is woken.
"""

from __future__ import annotations

import secrets
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from enact_dist.access.arguments import checked_as
from enact_dist.access.lock import refuse_inside_lock
from enact_dist.actor.binding import BoundActor
from enact_dist.actor.running.doing import Doing, own_lines, raised
from enact_dist.actor.running.past_step import PastStep, members_of, some
from enact_dist.compare.diff import Diff, diff_places
from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.errors import EnactError, LinkError, MisuseError, UnknownWorldError
from enact_dist.terms import Aspect, Entity
from enact_dist.wire.limits import BODY_BYTES_MAX, ITEMS_MAX
from enact_dist.world.version_data import set_encoded

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from enact_dist.actor.actor import Actor
    from enact_dist.world.cell import Cell

WAIT_S: Final = 10.0
HOLD_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class StepResult:
    """What came of a step that was run again.

    Attributes:
        version: The version whose commit was run again, as ``world:entity/aspect vN``.
        actor: Class of the actor.
        by: Who made that commit.
        entity: The entity that triggered it; empty if none did.
        contexts: The world contexts of the step by those that they stand for.
        kept: Whether these are still there.
        inputs: How many data the step was given.
        differences: By world context: how what the commit wrote (left) and what the step wrote
            (right) differ.
        error: What `update` raised, and where, and then `stop`, if it also did; empty if `update`
            did not.
        traceback: Its lines of the user's own files.
        remarks: What may make the step another one than it was.
    """

    version: str
    actor: str
    by: str
    entity: str
    contexts: dict[str, str]
    kept: bool
    inputs: int
    differences: tuple[Diff, ...] = ()
    error: str = ""
    traceback: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def differs(self) -> bool:
        """Whether a datum differs by more than its tolerance."""
        return any(self.differences)

    def to_json(self) -> dict[str, object]:
        """Return it in a form that JSON can carry."""
        names = ("version", "actor", "by", "entity", "contexts", "kept", "inputs", "error",
                 "traceback", "remarks")  # fmt: skip
        facts: dict[str, object] = {name: getattr(self, name) for name in names}
        return facts | {
            "differs": self.differs,
            "differences": [one.to_json() for one in self.differences],
        }


class Step:
    """The step of an actor that made a version.

    Args:
        cell: The cell; the connection must not only observe.
        world: Name of the version's world context.
        entity: Name of its entity.
        aspect: Name of its aspect.
        version: Its number; 0: the newest.

    Raises:
        NullDatumError: Nothing was ever set there.
        ForgottenError: The version itself is beyond retention.
        MisuseError: There is no such version yet, or it is not known which commit made it.
        UnknownWorldError: The cell has no world context of that name.
        ShardUnreachableError: A shard does not answer.
    """

    def __init__(self, cell: Cell, world: str, entity: str, aspect: str, version: int = 0) -> None:
        refuse_inside_lock("Step")
        self._cell = cell
        self._past = PastStep(cell, world, entity, aspect, version)
        self.made = self._past.made
        self._session = self._past.session

    def run(
        self,
        actor: Actor,
        worlds: Mapping[str, str] | None = None,
        *,
        keep_as: str = "",
        tolerances: Mapping[str, Aspect[Any]] | None = None,
    ) -> StepResult:
        """Run `update` once on what the commit had read; `start` and `stop` are called around it.

        Args:
            actor: The actor, made as it is to run.
            worlds: Role → name of a world context; None binds each role to the context of its name.
            keep_as: Name of the step's world context, which then stays.  Of several, each is called
                ``NAME-WORLD``.  Empty: they are dropped.
            tolerances: Aspects by name that are compared in another way than the actor's.

        Raises:
            ForgottenError: A version that the commit had read is beyond retention; names it.
            MisuseError: The actor does not write this version, cannot be bound, acts on a version
                only once, or the entity that triggered it is not clear; or the name is taken.
            EnactError: The lock, the commit or a shard refuses the step.
        """
        past, bound = self._past, BoundActor(actor, self._cell, worlds)
        past.refuse_other_actor(bound)
        entity = past.entity(bound)
        history = past.history(bound, entity)
        inputs, remarks = past.inputs(bound, entity, history)
        then, left_out = past.written(bound, history)
        remarks += left_out
        names = self._names(bound, keep_as)
        result = StepResult(
            past.name,
            type(actor).__name__,
            past.made.made_by,
            entity.name if entity is not None else "",
            names,
            bool(keep_as),
            len(inputs),
            remarks=remarks,
        )
        with self._contexts(list(names.values()), keep=bool(keep_as)):
            self._set(names, inputs)
            before = self._versions(names)
            roles = {role: names[context.name] for role, context in bound.contexts.items()}
            again = BoundActor(actor, self._cell, roles)
            failed = self._update(again, entity, members_of(bound, inputs))
            if failed is not None:
                error = "; ".join((raised(failed), *getattr(failed, "__notes__", ())))
                return replace(result, error=error, traceback=tuple(own_lines(failed)))
            after = self._versions(names)
            now = {slot for slot, state in after.items() if before.get(slot) != state}
            types = {one.aspect.name: one.aspect for one in bound.declaration.requests.values()}
            types |= tolerances or {}
            differences, more = self._compared(names, then | now, types)
            return replace(result, differences=differences, remarks=(*remarks, *more))

    def _names(self, bound: BoundActor, keep_as: str) -> dict[str, str]:
        """Return what the step's world contexts are called, by those that they stand for."""
        worlds = list(dict.fromkeys(context.name for context in bound.contexts.values()))
        base = keep_as or _own_name()
        names = {world: base if len(worlds) == 1 else f"{base}-{world}" for world in worlds}
        if keep_as:
            there = self._cell.worlds()
            for name in names.values():
                if checked_as("world context", name) in there:
                    raise MisuseError(
                        f"there is a world context {name!r}; take another name, or drop it: enact"
                        f" world drop {name}"
                    )
        return names

    @contextmanager
    def _contexts(self, names: Sequence[str], *, keep: bool) -> Iterator[None]:
        """Make the step's world contexts; drop them at the end unless they are to be kept.

        A name that a user chose may be taken at any moment, and `create_world` returns what is
        there.  A fork never does so: where it is made, the name was free on every shard.
        """
        made: list[str] = []
        try:
            if keep:
                made.append(_own_name())
                empty = self._cell.create_world(made[0])
                for name in names:
                    empty.fork(name)
                    made.append(name)
                self._drop([made.pop(0)])
            else:
                for name in names:  # no one else knows these
                    made.append(name)
                    self._cell.create_world(name)
            yield
        except BaseException as error:
            try:
                self._drop(made)
            except EnactError as left:
                error.add_note(str(left))
            raise
        if not keep:
            self._drop(made)

    def _drop(self, names: Sequence[str]) -> None:
        """Drop world contexts that this step has made; those that are gone are no error.

        Raises:
            EnactError: Some are still there; names them, and how to drop them.
            KeyboardInterrupt: The user does not wait for it; a note names those that may be there.
        """
        left: dict[str, EnactError] = {}
        for number, name in enumerate(names):
            try:
                self._cell.drop_world(name)
            except UnknownWorldError:
                pass
            except EnactError as error:
                left[name] = error
            except KeyboardInterrupt as error:
                todo = ", ".join(f"enact world drop {one}" for one in (*left, *names[number:]))
                error.add_note(
                    f"this step's world contexts may have to be dropped by hand ({todo})"
                )
                raise
        if left:
            todo = ", ".join(f"enact world drop {name}" for name in left)
            why = next(iter(left.values()))
            raise LinkError(f"this step's world contexts are to be dropped by hand ({todo}): {why}")

    def _set(self, names: Mapping[str, str], inputs: Mapping[Slot, Datum]) -> None:
        client = self._session.client
        client.greet()
        known = client.aspect_entries()
        used = {slot.aspect for slot in inputs}
        client.register(aspects=[known[name]._replace(reads=True) for name in sorted(used)])
        part: dict[Slot, Datum | None] = {}
        size = 0
        for slot, datum in inputs.items():
            if part and (len(part) >= ITEMS_MAX or size + datum.size > BODY_BYTES_MAX):
                set_encoded(client, part, wait_s=WAIT_S, hold_s=HOLD_S)
                part, size = {}, 0
            part[slot._replace(context=names[slot.context])] = datum
            size += datum.size
        if part:
            set_encoded(client, part, wait_s=WAIT_S, hold_s=HOLD_S)

    def _versions(self, names: Mapping[str, str]) -> dict[Slot, tuple[int, int]]:
        """Return version and stamp of what the step's contexts have, our own commits included."""
        for shard in self._session.client.shards():
            self._session.settle(shard)
        return {
            Slot(world, info.entity.name, info.aspect): (info.version, info.position.stamp_ns)
            for world, name in names.items()
            for info in self._cell.world(name).list_slots()
        }

    def _update(
        self, bound: BoundActor, entity: Entity | None, members: tuple[int, ...]
    ) -> BaseException | None:
        """Run the update in the step's contexts; return what it raised."""
        actor = bound.actor
        failed: BaseException | None = None
        tick_ns = 0
        if actor.every_s and not bound.declaration.triggers:
            tick_ns = self._past.tick_ns(actor.every_s, in_phase=actor.in_phase)
        _called(actor, "start")
        try:
            with bound.lock(entity, tick_ns=tick_ns, members=members) as lock:
                try:
                    actor.update(lock)
                except (Exception, SystemExit) as error:
                    failed = error
                    raise
        except BaseException as error:
            try:
                _called(actor, "stop")
            except EnactError as late:
                (failed or error).add_note(str(late))
            if failed is None or not isinstance(error, (Exception, SystemExit)):
                raise
        else:
            _called(actor, "stop")
        return failed

    def _compared(
        self, names: Mapping[str, str], slots: set[Slot], types: Mapping[str, Aspect[Any]]
    ) -> tuple[tuple[Diff, ...], tuple[str, ...]]:
        """Return how slots differ between then and now, and which are forgotten since then."""
        found, forgotten = list[Diff](), list[str]()
        for world, name in names.items():
            written = sorted(slot for slot in slots if slot.context == world)
            gone = self._past.forgotten_since(written)
            known = [slot for slot in written if slot not in gone]
            forgotten += [str(slot) for slot in written if slot not in known]
            if not known:
                continue
            past = self._cell.world(world).at(self._past.made.position)
            places = [(slot.entity, slot.aspect) for slot in known]
            aspects = {slot.aspect: Aspect(slot.aspect, object) for slot in known}
            used = {one: types.get(one, aspect) for one, aspect in aspects.items()}
            diff = diff_places(past, self._cell.world(name), places, used)
            found.append(replace(diff, left=f"{world} then", right=f"{world} now"))
        remark = f"not compared, because that version is forgotten: {some(forgotten)}"
        return tuple(found), (remark,) if forgotten else ()


def _own_name() -> str:
    return f"step-{secrets.token_hex(4)}"


def _called(actor: Actor, method: str) -> None:
    """Call `start` or `stop` of an actor.

    Raises:
        MisuseError: It raised something of its own, or called `sys.exit`.
    """
    name = type(actor).__name__
    try:
        with Doing(name).inside(method):
            getattr(actor, method)()
    except EnactError:
        raise
    except Exception as error:
        raise MisuseError(f"{method} of actor {name} failed: {raised(error)}") from error
