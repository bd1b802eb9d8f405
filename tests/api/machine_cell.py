"""A durable cell in this process beside the list-of-dicts model of its history.

Only the wall clock is the test's: it stands still within a step, so the model knows what retention
has let go of.  Everything is asked for as a user would ask, and answered by real threads and a real
store.
"""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
from reference_time import Nothing, Past, Place, TimeModel
from time_cell import (
    ASPECTS,
    FIRM,
    FORKS,
    LABELS,
    MS,
    PAUSES_NS,
    PICK,
    RULES,
    WHERE,
    WORLD,
    WRITES,
    WallClock,
    datum_of,
    plain,
)

from enact_dist import Entities, Entity, Lock, Read, View, Write, local
from enact_dist.core.protocol.datum import Position
from enact_dist.core.protocol.messages import AwaitStamp
from enact_dist.errors import ForgottenError, NullDatumError, UnknownWorldError
from enact_dist.terms import NullReason, ViewEach

if TYPE_CHECKING:
    from enact_dist.world.cell import Cell
    from enact_dist.world.context import Version
    from enact_dist.world.past import PastContext


class CellMachine(RuleBasedStateMachine):
    """One cell, one process, and everything that can be asked of its history."""

    tally: ClassVar[Counter[str]] = Counter()

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="enact-time-"))
        self.clock = WallClock()
        self.cell = self._opened()
        self.model = TimeModel(RULES, FIRM)
        self.moments = [self._stamp_ns()]
        self.listed: dict[tuple[Place, int], Version[Any]] = {}

    def _opened(self) -> Cell:
        return local(self.folder, worlds=FIRM, clock=self.clock)

    def teardown(self):
        """The example is over."""
        self.cell.close()
        shutil.rmtree(self.folder)

    # ---------------------------------------------------------------- rules

    @rule(writes=WRITES, picks=st.lists(PICK, max_size=3), looks=st.booleans())
    def commit(self, writes, picks, looks):
        """One lock writes some slots, beside what it reads and views."""
        reads = {self._place(pick // 2): bool(pick % 2) for pick in picks}
        self._commit(writes, list(reads.items()), looks=looks)

    @rule(place=WHERE, count=st.integers(3, 6))
    def commit_often(self, place, count):
        """One slot has many versions soon."""
        for number in range(count):
            self._commit([(place, number, number % 5)], [])

    @rule(pause_ns=st.sampled_from(PAUSES_NS))
    def wait(self, pause_ns):
        """Time passes."""
        self.clock.now_ns += pause_ns
        self._settle("pauses")

    @rule(name=st.sampled_from(FORKS), source=WORLD, pick=PICK, now=st.booleans())
    def fork(self, name, source, pick, now):
        """A context is made of another one, as of now or of some moment."""
        if name == source or source not in self.model.worlds:
            return
        if name in self.model.worlds:
            self.drop(name)
        at_ns = self._stamp_ns() if now else self._moment(pick)
        when = {} if now else {"at": Position(at_ns, "local")}
        made, late = None, None
        try:
            made = self.cell.world(source).fork(name, **when)
        except ForgottenError as error:
            late = error
        if made is not None and now:
            assert made.forked_from is not None
            assert made.forked_from[1] >= at_ns
            at_ns = made.forked_from[1]
        expected = self.model.fork(name, source, at_ns, _fork_cause(at_ns))
        if isinstance(expected, Past):
            self._check_forgotten(late, expected)
            assert name not in self.cell.worlds()
            self.tally["forks of the forgotten"] += 1
        else:
            assert late is None
            assert made.forked_from == (source, at_ns)
            self.tally["forks of the past"] += not now
            self.tally["forks of forks"] += source in FORKS
        self._settle("forks")

    @rule(name=st.sampled_from(FORKS))
    def drop(self, name):
        """A context that was made goes, with all that it was."""
        if name not in self.model.worlds:
            return
        assert self.cell.drop_world(name) == self.model.drop(name)
        self._settle("drops")

    @rule(name=st.sampled_from(FORKS))
    def make_again(self, name):
        """A context is made that is no fork, and may have been there before."""
        if name in self.model.worlds:
            return
        assert self.cell.create_world(name).forked_from is None
        self.model.worlds[name] = "", 0
        self.tally["worlds made again"] += name in self.model.bases
        self._settle("worlds made")

    @rule(label=st.sampled_from(LABELS), picks=st.lists(PICK, min_size=1, max_size=3))
    def keep(self, label, picks):
        """Somebody wants versions to stay that were listed once."""
        listed = map(self._version, picks if self.listed else ())
        asked = {
            (place, version.version): version
            for place, version in listed
            if place[0] in self.model.worlds and self._is_same(place, version)
        }
        if not asked:
            return
        late = None
        try:
            self.cell.pin(label, asked.values())
        except ForgottenError as error:
            late = error
        known = [self.model.keep(label, *one) for one in asked]
        assert (late is None) == all(known), (late, asked)
        self.tally["kept too late"] += late is not None
        self._settle("keeps")

    @rule(label=st.sampled_from(LABELS))
    def let_go(self, label):
        """Nobody wants them any more."""
        self.cell.unpin(label)
        self.model.let_go(label)
        self._settle("labels let go")

    @rule(pause_ns=st.sampled_from((0, *PAUSES_NS)))
    def restart(self, pause_ns):
        """The process ends, and another one opens its folder."""
        self.cell.close()
        self.clock.now_ns += pause_ns + MS
        self.cell = self._opened()
        self.model.restart(self._stamp_ns())
        self.listed.clear()  # handles of a cell that is closed
        self._settle("restarts")

    @rule(
        picks=st.lists(PICK, min_size=1, max_size=4),
        pick=PICK,
        beside_ns=st.sampled_from((-1, 0, 0, 1)),
    )
    def travel(self, picks, pick, beside_ns):
        """Some slots are seen as of a moment."""
        at_ns = min(self._moment(pick) + beside_ns, self._stamp_ns())
        places = list(dict.fromkeys(map(self._place, picks)))
        views = {place: _request(View, self._past(place[0], at_ns), place) for place in places}
        expected = self.model.view(places, at_ns)
        snapshot = self._seen(
            lambda: self._past(places[0][0], at_ns).view(*views.values()), expected
        )
        if snapshot is None:
            return
        for place, view in views.items():
            self._check_shown(snapshot, view, expected[place])
        self.tally["travels"] += 1

    @rule(world=WORLD, aspect=st.sampled_from(tuple(RULES)), pick=PICK)
    def travel_by_pattern(self, world, aspect, pick):
        """All of one aspect are seen as of a moment, and surveyed: those that were there then."""
        if world not in self.model.worlds:
            return
        at_ns = self._moment(pick)
        past = self._past(world, at_ns)
        places = [place for place in self.model.places(world) if place[2] == aspect]
        expected = self.model.view(places, at_ns)
        each = ViewEach(past, Entities("**"), ASPECTS[aspect])
        snapshot = self._seen(lambda: past.view(each), expected)
        if snapshot is None:
            return
        shown = {place[1]: one for place, one in expected.items() if isinstance(one, dict)}
        found = {entity.name: plain(datum) for entity, datum in snapshot[each].items()}
        assert found == {entity: state["value"] for entity, state in shown.items()}
        surveyed = {info.entity.name: info.version for info in past.list_slots(aspects=(aspect,))}
        assert surveyed == {entity: state["version"] for entity, state in shown.items()}
        self.tally["travels by pattern"] += bool(found)

    @rule(where=PICK, captured_ns=st.integers(1, 5), nearest=st.booleans())
    def travel_by_capture(self, where, captured_ns, nearest):
        """A slot is seen as it was captured at a stamp, or next to it."""
        place = self._place(where)
        past = self.cell.world(place[0]).at(stamp_ns=captured_ns, nearest=nearest)
        view = _request(View, past, place)
        expected = self.model.captured(place, captured_ns, nearest=nearest)
        self._check_shown(past.view(view), view, expected)
        if isinstance(expected, dict):
            self.tally["nearest captures" if nearest else "exact captures"] += 1

    @rule(where=PICK, pick=PICK, count=st.sampled_from((None, 1, 2)))
    def list_some(self, where, pick, count):
        """The versions since a moment, or the newest few."""
        place = self._place(where)
        since_ns = self._moment(pick)
        found = self.cell.world(place[0]).history(
            Entity(place[1]), ASPECTS[place[2]], since=Position(since_ns, "local"), count=count
        )
        untils = [(s["version"], s["until_ns"]) for s in self.model.history(place)]
        expected = [version for version, until_ns in untils if not until_ns or until_ns > since_ns]
        states = {s["version"]: s for s in self.model.history(place)}
        if all(states[version]["until_known"] for version in states):
            assert [version.version for version in found] == (
                expected[-count:] if count else expected
            )
            self.tally["lists of some"] += len(found) < len(states)

    @rule(pick=PICK)
    def fetch(self, pick):
        """The datum of a version that was listed some time ago."""
        if not self.listed:
            return
        place, version = self._version(pick)
        known = self._is_same(place, version) and [
            s for s in self.model.history(place) if s["version"] == version.version
        ]
        if known and known[0]["value"] is not None:
            assert plain(version.datum()) == known[0]["value"]
            self.tally["data of versions"] += 1
            return
        there = place[0] in self.model.worlds
        if not known and there and self._is_near(place, version):
            return  # no longer listed, and still there for a moment
        error = NullDatumError if known else ForgottenError if there else UnknownWorldError
        with pytest.raises(error):
            version.datum()
        self.tally["versions fetched too late"] += not known

    @rule(left=WORLD, right=WORLD, pick=PICK, past=st.booleans())
    def diff(self, left, right, pick, past):
        """Two contexts are compared, the right one as it is or as it was."""
        if left not in self.model.worlds or right not in self.model.worlds:
            return
        one, two = self.cell.world(left), self.cell.world(right)
        at_ns = self._moment(pick) if past else 0
        expected = self.model.diff(left, right, at_ns)
        found = self._seen(lambda: one.diff(self._past(right, at_ns) if past else two), expected)
        if found is None:
            return
        rows = {(row.entity.name, row.aspect): row.kind.value for row in found}
        assert rows == expected
        self.tally["diffs with the past" if past else "diffs"] += 1
        self.tally["differences"] += len(rows)

    # ---------------------------------------------------------------- after each step

    @invariant()
    def all_that_is_listed_is_the_models(self):
        """Worlds, labels, and every known version of every slot with its times and its cause."""
        assert set(self.cell.worlds()) == set(self.model.worlds)
        kept = {
            label: {(tuple(version.slot), version.version) for version in versions}
            for label, versions in self.cell.pinned().items()
        }
        assert kept == self.model.labels
        for world in self.model.worlds:
            for place in self.model.places(world):
                self._check_history(place)

    def _check_history(self, place: Place) -> None:
        world, entity, aspect = place
        found = self.cell.world(world).history(Entity(entity), ASPECTS[aspect])
        expected = self.model.history(place)
        assert [version.version for version in found] == [s["version"] for s in expected], place
        for version, state in zip(found, expected, strict=True):
            untils_ns = {state["until_ns"]}
            if not state["until_known"]:
                untils_ns.add(state["stamp_ns"])
            assert version.until_ns in untils_ns, (version, state)
            assert version.position.stamp_ns == state["stamp_ns"], version
            assert version.stamp_ns == state["captured_ns"], version
            assert version.size_bytes == state["size"], version
            assert version.null_reason == _reason(state["reason"]), version
            assert version.pinned == self.model.kept(place, version.version), version
            self._check_cause(version, state["cause"])
            if version.version:
                self.listed.setdefault((place, version.version), version)

    def _check_cause(self, version: Version[Any], expected: Any) -> None:
        cause = version.cause
        if expected is None:
            assert cause is None, version
            return
        assert cause is not None, version
        kind, stamp_ns, reads = expected
        assert (cause.kind, cause.stamp_ns) == (kind, stamp_ns), version
        found = {(tuple(read.slot), read.version, read.stamp_ns) for read in cause.reads}
        assert found == reads, version
        assert (version.slot, version.version) in cause.writes, version

    # ---------------------------------------------------------------- steps

    def _commit(self, writes, reads, *, looks: bool = False) -> None:
        writes = [write for write in writes if write[0][0] in self.model.worlds]
        written = {place for place, _, _ in writes}
        reads = [(place, only_views) for place, only_views in reads if place not in written]
        if not writes:
            return
        places = {place: _request(Write, self._world(place), place) for place, _, _ in writes}
        seen = [_request(View if only else Read, self._world(p), p) for p, only in reads]
        inputs = {self._newest(place) for place, _ in reads}
        with Lock(*places.values(), *seen) as lock:
            for place, number, captured_ns in writes:
                request = places[place]
                if looks and lock.get(request) is not None:
                    inputs.add(self._newest(place))
                if number is None:
                    del lock[request]
                elif captured_ns:
                    lock.put(request, datum_of(place[2], number), stamp_ns=captured_ns)
                else:
                    lock[request] = datum_of(place[2], number)
        assert lock.position is not None
        stamp_ns = lock.position.stamp_ns
        for place, number, captured_ns in writes:
            value = None if number is None else plain(datum_of(place[2], number))
            size = len(value) if isinstance(value, bytes) else 0
            self.model.set(
                place,
                stamp_ns,
                value,
                size=size,
                captured_ns=captured_ns,
                cause=("commit", stamp_ns, inputs),
            )
        self._settle("commits")

    def _settle(self, step: str) -> None:
        """End a step: what is too old goes, here and there."""
        self.tally[step] += 1
        now_ns = self._stamp_ns()
        self.moments.append(now_ns)
        self.cell._host.tick()
        self.model.pass_time(now_ns)

    # ---------------------------------------------------------------- answers

    def _seen(self, look: Any, expected: Any) -> Any:
        """Return what is seen; None where it is forgotten, as the model says."""
        found, late = None, None
        try:
            found = look()
        except ForgottenError as error:
            late = error
        assert (late is not None) == isinstance(expected, Past), (late, expected)
        if isinstance(expected, Past):
            self._check_forgotten(late, expected)
        return found

    def _check_forgotten(self, error: ForgottenError | None, expected: Past) -> None:
        assert error is not None, expected
        assert error.oldest_ns == expected.since_ns, error
        self.tally["forgotten"] += 1

    def _check_shown(self, snapshot: Any, view: Any, expected: Any) -> None:
        if isinstance(expected, Nothing):
            with pytest.raises(NullDatumError) as caught:
                snapshot[view]
            assert caught.value.reason == _reason(expected.reason)
            self.tally["nulls"] += 1
            return
        assert plain(snapshot[view]) == expected["value"], view
        assert snapshot.version(view) == expected["version"], view

    # ---------------------------------------------------------------- choosing

    def _stamp_ns(self) -> int:
        answer = self.cell._client.call("local", AwaitStamp(0, 0))
        return int(answer.stamp_ns)

    def _moment(self, pick: int) -> int:
        """Return a moment that was, one of the last ones."""
        moments = self.moments if pick % 4 == 0 else self.moments[-25:]
        return moments[pick // 4 % len(moments)]

    def _world(self, place: Place) -> Any:
        return self.cell.world(place[0])

    def _past(self, world: str, at_ns: int) -> PastContext:
        return self.cell.world(world).at(Position(at_ns, "local"))

    def _newest(self, place: Place) -> tuple[Place, int, int]:
        line = self.model.lines.get(place)
        state = line.states[-1] if line is not None and line.states else None
        return (place, state["version"], state["stamp_ns"]) if state else (place, 0, 0)

    def _is_same(self, place: Place, version: Version[Any]) -> bool:
        """Whether a version that was listed once is still one of its slot, and of no other life."""
        line = self.model.lines.get(place)
        return line is not None and any(
            (s["version"], s["stamp_ns"]) == (version.version, version.position.stamp_ns)
            for s in line.states
        )

    def _is_near(self, place: Place, version: Version[Any]) -> bool:
        return self._is_same(place, version) and any(
            s["near"] for s in self.model.lines[place].states if s["version"] == version.version
        )

    def _version(self, pick: int) -> tuple[Place, Version[Any]]:
        """Return a version that was listed once: as often one that is not any more as another."""
        listed = [(place, version) for (place, _), version in self.listed.items()]
        late = [one for one in listed if self._is_same(*one) and not self._is_listed(*one)]
        among = late if late and pick % 2 else listed
        return among[pick // 2 % len(among)]

    def _is_listed(self, place: Place, version: Version[Any]) -> bool:
        return any(s["version"] == version.version for s in self.model.history(place))

    def _place(self, pick: int) -> Place:
        """Return a slot that there is, or may be."""
        places = [place for world in self.model.worlds for place in self.model.places(world)]
        places += [(world, "piece", "three") for world in self.model.worlds]
        return places[pick % len(places)]


def _request(kind: Any, world: Any, place: Place) -> Any:
    return kind(world, Entity(place[1]), ASPECTS[place[2]])


def _reason(name: str) -> str:
    return NullReason[name].value if name else ""


def _fork_cause(at_ns: int) -> Any:
    return lambda read: ("fork", at_ns, {read})
