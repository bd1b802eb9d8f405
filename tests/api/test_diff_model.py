"""Diffs against plain dicts: any sequence of writes, deletions and forks gives the same answers."""

import math

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from enact_dist import Aspect, Entity, Lock, Tolerance, Write, local

TOLERANCE = 0.5
SHIFT = Aspect("shift_mm", float, compare=Tolerance(absolute=TOLERANCE))
NAME = Aspect("name", str)
ENTITIES = tuple(Entity(f"tray/{number}") for number in range(3))
CONTEXTS_MAX = 5

values = st.sampled_from([0.0, 0.25, 0.5, 1.0, math.nan]) | st.sampled_from(["a", "b"])


def model_kind(left, right):
    """How two values of a slot stand, by the words of the interface alone."""
    if left is None or right is None:
        return "equal" if left is right else "only right" if left is None else "only left"
    if isinstance(left, str):
        return "equal" if left == right else "changed"
    if math.isnan(left) or math.isnan(right):
        return "equal" if math.isnan(left) and math.isnan(right) else "changed"
    return "changed" if abs(left - right) > TOLERANCE else "equal"


def model_diff(left, right):
    rows = {
        place: model_kind(left.get(place), right.get(place)) for place in left.keys() | right.keys()
    }
    return {place: kind for place, kind in rows.items() if kind != "equal"}


class Diffs(RuleBasedStateMachine):
    """Some world contexts and their dicts; two of them are followed by a standing diff."""

    @initialize()
    def open(self):
        self.cell = local(worlds=["one", "two"])
        self.model = {"one": {}, "two": {}}
        self.watch = self.cell.world("one").watch_diff(self.cell.world("two"))
        self.told = {}

    def request(self, context, entity, value):
        aspect = NAME if isinstance(value, str) else SHIFT
        return Write(self.cell.world(context), entity, aspect), (entity.name, aspect.name)

    @rule(which=st.integers(0, CONTEXTS_MAX), entity=st.sampled_from(ENTITIES), value=values)
    def write(self, which, entity, value):
        context = sorted(self.model)[which % len(self.model)]
        request, place = self.request(context, entity, value)
        with Lock(request) as lock:
            lock[request] = value
        self.model[context][place] = value

    @rule(which=st.integers(0, CONTEXTS_MAX), entity=st.sampled_from(ENTITIES), value=values)
    def delete(self, which, entity, value):
        context = sorted(self.model)[which % len(self.model)]
        request, place = self.request(context, entity, value)
        with Lock(request) as lock:
            del lock[request]
        self.model[context].pop(place, None)

    @precondition(lambda self: len(self.model) < CONTEXTS_MAX)
    @rule(which=st.integers(0, CONTEXTS_MAX))
    def fork(self, which):
        context, name = sorted(self.model)[which % len(self.model)], f"fork_{len(self.model)}"
        self.cell.world(context).fork(name)
        self.model[name] = dict(self.model[context])

    @rule(which=st.integers(0, CONTEXTS_MAX))
    def compare(self, which):
        left = sorted(self.model)[which % len(self.model)]
        for right in self.model:
            diff = self.cell.world(left).diff(self.cell.world(right), "**", SHIFT, NAME)

            found = {(row.entity.name, row.aspect): row.kind.value for row in diff}
            assert found == model_diff(self.model[left], self.model[right])
            places = self.model[left].keys() | self.model[right].keys()
            assert diff.equal + diff.within + len(diff) == len(places)
            assert diff.same <= diff.equal

    @invariant()
    def standing_diff_has_told_what_a_diff_would(self):
        for row in iter(lambda: self.watch.next(0), None):
            place = row.entity.name, row.aspect
            assert row.kind.value != self.told.get(place, "equal")
            self.told[place] = row.kind.value
        differ = {place: kind for place, kind in self.told.items() if kind != "equal"}
        assert differ == model_diff(self.model["one"], self.model["two"])

    def teardown(self):
        if hasattr(self, "cell"):
            self.watch.close()
            self.cell.close()


Diffs.TestCase.settings = settings(max_examples=30, stateful_step_count=25, deadline=None)
TestDiffs = Diffs.TestCase
