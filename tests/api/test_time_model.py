"""World contexts in time against plain lists of dicts: commits, travels, forks, prunes, restarts.

The model keeps everything for good; what the system has forgotten it may say so, where the
aspect's retention has let it go, and must not where it has not.
"""

import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from enact_dist import Aspect, Entities, Entity, Lock, Position, Retention, View, ViewEach, Write
from enact_dist.connecting import local
from enact_dist.errors import ForgottenError
from enact_dist.testing import ManualClock

FEW = Aspect("few", int, retention=3)
AGED = Aspect("aged", int, retention=Retention(age_s=30.0))
PLAIN = Aspect("plain", int)
ASPECTS = {aspect.name: aspect for aspect in (FEW, AGED, PLAIN)}
KEPT_FOR = {"few": (3, 1 << 62), "aged": (1 << 62, 30 * 10**9), "plain": (16, 600 * 10**9)}
"""Versions, the newest included, and how long ago one may have been replaced."""
ENTITIES = tuple(Entity(f"tray/{number}") for number in range(2))
CONTEXTS_MAX = 4

places = st.tuples(st.sampled_from(ENTITIES), st.sampled_from(sorted(ASPECTS)))
which = st.integers(0, 1000)


class Travels(RuleBasedStateMachine):
    """One shard with a folder on a manual clock, and for each slot the list of all its states."""

    @initialize()
    def begin(self):
        self.folder = Path(tempfile.mkdtemp())
        self.clock = ManualClock()
        self.model = {"online": {}}
        self.born = {"online": 0}
        self.kept = {}
        self.forks = 0
        self.open()

    def open(self):
        self.block = ExitStack()
        self.cell = self.block.enter_context(
            local(self.folder, worlds=["online"], clock=self.clock, actor="model")
        )
        self.block.enter_context(self.clock.ticking(self.cell._host.tick))

    def teardown(self):
        if hasattr(self, "block"):
            self.block.close()
            shutil.rmtree(self.folder)

    # ------------------------------------------------------------ the model

    def context(self, number):
        return sorted(self.model)[number % len(self.model)]

    def states(self, context, entity, aspect):
        return self.model[context].setdefault((entity, aspect), [])

    def value_at(self, context, entity, aspect, at_ns):
        """Return what a slot held, None where nothing, by the list alone."""
        held = [one for one in self.states(context, entity, aspect) if one["stamp_ns"] <= at_ns]
        return held[-1]["value"] if held else None

    def retained(self, context, entity, aspect):
        """Return the states that the aspect's retention keeps, oldest first."""
        states = self.states(context, entity, aspect)
        count, age_ns = KEPT_FOR[aspect]
        now_ns = self.clock.wall_ns()
        newer = states[1:]
        first = max(0, len(states) - count)
        while first < len(newer) and newer[first]["stamp_ns"] < now_ns - age_ns:
            first += 1
        return states[first:]

    def may_be_forgotten(self, context, entity, aspect, at_ns):
        states = self.states(context, entity, aspect)
        known = self.retained(context, entity, aspect)
        return len(known) < len(states) and at_ns < known[0]["stamp_ns"]

    def stamps(self, context):
        found = [one["stamp_ns"] for states in self.model[context].values() for one in states]
        return sorted({*found, self.clock.wall_ns()})

    # ------------------------------------------------------------ what happens

    def commit(self, context, place, value):
        entity, aspect = place
        request = Write(self.cell.world(context), entity, ASPECTS[aspect])
        with Lock(request) as lock:
            if value is None:
                del lock[request]
            else:
                lock[request] = value
        state = {"stamp_ns": lock.position.stamp_ns, "value": value}
        self.states(context, entity, aspect).append(state)

    @rule(number=which, place=places, value=st.integers(0, 9) | st.none())
    def write(self, number, place, value):
        self.commit(self.context(number), place, value)

    @rule(number=which, place=places)
    def write_often(self, number, place):
        for value in range(4):
            self.commit(self.context(number), place, value)

    @rule(seconds=st.sampled_from([0.5, 3.0, 20.0]))
    def time_passes(self, seconds):
        self.clock.advance(seconds)

    @rule()
    def restart(self):
        self.block.close()
        self.open()

    @precondition(lambda self: len(self.model) < CONTEXTS_MAX)
    @rule(number=which, moment=which, now=st.booleans())
    def fork(self, number, moment, now):
        source = self.context(number)
        stamps = [ns for ns in self.stamps(source) if ns >= self.born[source]]
        at_ns = stamps[moment % len(stamps)]
        self.forks += 1
        name = f"fork_{self.forks}"
        try:
            fork = self.cell.world(source).fork(name, at=None if now else Position(at_ns, ""))
        except ForgottenError:
            assert any(self.may_be_forgotten(source, *place, at_ns) for place in self.model[source])
            assert name not in self.cell.worlds()
            return
        origin, at_ns = fork.forked_from
        assert origin == source
        self.born[name] = at_ns
        self.model[name] = {
            place: [{"stamp_ns": at_ns, "value": self.value_at(source, *place, at_ns)}]
            for place, states in self.model[source].items()
            if any(one["stamp_ns"] <= at_ns for one in states)
        }

    @precondition(lambda self: len(self.model) > 1)
    @rule(number=which)
    def drop(self, number):
        name = sorted(set(self.model) - {"online"})[number % (len(self.model) - 1)]
        self.cell.drop_world(name)
        del self.model[name]
        self.kept = {key: value for key, value in self.kept.items() if key[0] != name}

    @rule(number=which, place=places, version=which)
    def keep(self, number, place, version):
        context, (entity, aspect) = self.context(number), place
        versions = self.cell.world(context).history(entity, ASPECTS[aspect])
        if versions:
            one = versions[version % len(versions)]
            self.cell.keep("label", [one])
            stamp_ns = one.position.stamp_ns
            self.kept[context, entity, aspect, stamp_ns] = self.value_at(
                context, entity, aspect, stamp_ns
            )

    @rule()
    def let_go(self):
        self.cell.let_go("label")
        self.kept = {}

    # ------------------------------------------------------------ what is seen

    @rule(number=which, moment=which, before=st.integers(0, 1))
    def travel(self, number, moment, before):
        """Each datum of then is the one of the list, or told to be forgotten where it may be."""
        context = self.context(number)
        stamps = [ns for ns in self.stamps(context) if ns - before >= self.born[context]]
        if not stamps:
            return
        at_ns = max(1, stamps[moment % len(stamps)] - before)
        past = self.cell.world(context).at(Position(at_ns, ""))
        for aspect in ASPECTS.values():
            expected = {}
            for entity in ENTITIES:
                value = self.value_at(context, entity, aspect.name, at_ns)
                if value is not None:
                    expected[entity] = value
                self.see(context, past, entity, aspect, value)
            each = ViewEach(past, Entities("tray/*"), aspect)
            try:
                assert dict(past.view(each)[each]) == expected
            except ForgottenError:
                assert any(
                    self.may_be_forgotten(context, entity, aspect.name, at_ns)
                    for entity in ENTITIES
                )

    def see(self, context, past, entity, aspect, value):
        one = View(past, entity, aspect)
        try:
            assert past.view(one).get(one) == value, (context, entity, aspect, past)
        except ForgottenError as error:
            assert self.may_be_forgotten(context, entity, aspect.name, past.at_ns)
            oldest_ns = error.oldest_ns
            assert past.at_ns < oldest_ns
            known = self.cell.world(context).at(Position(oldest_ns, ""))
            again = View(known, entity, aspect)
            assert known.view(again).get(again) == self.value_at(
                context, entity, aspect.name, oldest_ns
            )

    @rule(number=which)
    def list_history(self, number):
        """Whatever retention or a label keeps is listed in order, with its data."""
        context = self.context(number)
        for entity, aspect in list(self.model[context]):
            self.check_listed(context, entity, aspect)

    def check_listed(self, context, entity, aspect):
        versions = self.cell.world(context).history(entity, ASPECTS[aspect])
        stamps = [version.position.stamp_ns for version in versions]
        wanted = {one["stamp_ns"] for one in self.retained(context, entity, aspect)}
        wanted |= {key[3] for key in self.kept if key[:3] == (context, entity, aspect)}
        assert stamps == sorted(stamps)
        assert wanted <= set(stamps)
        numbers = [version.version for version in versions]
        assert numbers == sorted(set(numbers))
        for version in versions:
            value = self.value_at(context, entity, aspect, version.position.stamp_ns)
            assert (None if version.null_reason else version.datum()) == value

    @invariant()
    def present_is_the_newest_of_each_list(self):
        for context in self.model:
            world = self.cell.world(context)
            for aspect in ASPECTS.values():
                each = ViewEach(world, Entities("**"), aspect)
                expected = {
                    entity: states[-1]["value"]
                    for (entity, name), states in self.model[context].items()
                    if name == aspect.name and states and states[-1]["value"] is not None
                }
                assert dict(world.view(each)[each]) == expected

    @invariant()
    def labels_keep_what_they_were_given(self):
        kept = self.cell.kept().get("label", ())
        found = {
            (v.world.name, v.entity, v.aspect.name, v.position.stamp_ns): v.null_reason or v.datum()
            for v in kept
        }
        assert found == {
            key: "deleted" if value is None else value for key, value in self.kept.items()
        }


Travels.TestCase.settings = settings(max_examples=25, stateful_step_count=30, deadline=None)
TestTravels = Travels.TestCase
