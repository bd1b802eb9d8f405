"""A shard beside the list-of-dicts model of its history: commits, forks, travels, crashes.

Time stands still between steps and passes when a step says so, so the model knows to the nanosecond
what retention has let go of.  The disk keeps what it was given when a step asks for it; a crash
loses any tail of what was not reported, so any step may be cut off before its record or after it.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, ClassVar

from history_steps import (
    ASPECT,
    ASPECTS,
    CAPTURES_MAX,
    DOWN_NS,
    FIRM,
    FORK,
    FORKS,
    KEPT,
    LABELS,
    LOSSES,
    NOT_KEPT,
    PAUSES_NS,
    PICK,
    RULES,
    WHERE,
    WORLDS,
    WRITES,
)
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from reference_time import Nothing, Past, Place, TimeModel  # found by what `history_steps` added
from shard_bench import MS, S, ShardBench, lock_id

from enact_dist.core.protocol.datum import Datum, Position, Slot
from enact_dist.core.protocol.messages import (
    Commit,
    Committed,
    DatumRead,
    Dropped,
    DropWorld,
    Explain,
    FindEffects,
    Finish,
    Forgotten,
    Fork,
    Forked,
    Hello,
    Item,
    KeepVersions,
    Kept,
    ListHistory,
    Prepare,
    Prepared,
    Register,
    SlotState,
    SlotVersion,
    TakeView,
    VersionEntry,
    Versions,
    Viewed,
    WriteItem,
)
from enact_dist.core.protocol.parts import CAUSE_COMMIT, CAUSE_FORK
from enact_dist.core.protocol.records import SlotRecord, Tick
from enact_dist.terms import Access


class ShardHistoryMachine(RuleBasedStateMachine):
    """One shard, one session, and everything that history, forks and lineage can be asked."""

    tally: ClassVar[Counter[str]] = Counter()

    def __init__(self) -> None:
        super().__init__()
        self.bench = ShardBench(register=False)
        self.bench.disk_is_done = False
        self.model = TimeModel(RULES, FIRM)
        self.moments: list[int] = []
        self.seq = self.numbers = 0
        self.fallen_ns = 0
        self.late: Viewed | None = None

    # ---------------------------------------------------------------- rules

    @initialize()
    def begin(self):
        """A session comes, and the aspects are known."""
        self._hello()
        self._ask(Register("ann", (), ASPECTS))

    @rule(writes=WRITES, picks=st.lists(PICK, max_size=3), loss=LOSSES)
    def commit(self, writes, picks, loss):
        """One lock writes some slots, and says what it has read."""
        self._commit(writes, list(dict.fromkeys(map(self._place, picks))), loss)

    @rule(place=WHERE, count=st.integers(3, 7))
    def commit_often(self, place, count):
        """One slot has many versions soon."""
        for number in range(count):
            self._commit([(place, 10 + number, number % 5)], [])

    @rule(writes=WRITES, ahead_ns=st.sampled_from((0, 1, 300 * MS)), dies=st.booleans())
    def commit_over_shards(self, writes, ahead_ns, dies):
        """Another shard decides: what was prepared here gets its stamp, restart or not."""
        granted, sent, taken = self._granted(writes)
        if granted is None:
            return
        lock, token = granted.lock, granted.token
        prepared = self._ask(Prepare(lock, token, sent, 0, (), "far", token))
        assert isinstance(prepared, Prepared), prepared
        if dies:
            self._crash(0)
            self._restart_model()
        self._travel([tuple(write.slot) for write in sent], prepared.stamp_ns - 1)
        stamp_ns = max(prepared.stamp_ns, self.bench.wall_ns + ahead_ns)
        self._ask(Finish(lock, Position(stamp_ns, "far")))
        self._set(taken, stamp_ns, (CAUSE_COMMIT, stamp_ns, ()))
        self._settle("commits over shards")

    @rule(pause_ns=st.sampled_from(PAUSES_NS))
    def wait(self, pause_ns):
        """Time passes."""
        self.bench.wall_ns += pause_ns
        self._settle("pauses")

    @rule(name=FORK, source=WORLDS, pick=PICK, loss=LOSSES)
    def fork(self, name, source, pick, loss):
        """A context is made of another one, as of now or of some moment."""
        if name == source or source not in self.model.worlds:
            return
        if name in self.model.worlds:
            self.drop(name, None)
        at_ns = self._moment(pick)
        answer = self._ask(Fork("ann", name, source, at_ns), loss)
        if answer is not NOT_KEPT:
            made = self.model.fork(name, source, at_ns, _fork_cause(at_ns))
            if isinstance(made, Past):
                self._check_forgotten(answer, made)
                self.tally["forks of the forgotten"] += 1
            elif answer is not KEPT:
                assert isinstance(answer, Forked), answer
                assert answer.slots == made
            self.tally["forks of forks"] += source in FORKS
        self._settle("forks")

    @rule(name=FORK, loss=LOSSES)
    def drop(self, name, loss):
        """A context that was made goes, with all that it was."""
        if name not in self.model.worlds:
            return
        answer = self._ask(DropWorld("ann", name), loss)
        if answer is not NOT_KEPT:
            gone = self.model.drop(name)
            assert answer in (KEPT, Dropped(name, gone))
        self._settle("drops")

    @rule(name=FORK)
    def make_again(self, name):
        """A context is made that is no fork, and may have been there before."""
        if name in self.model.worlds:
            return
        self._ask(Register("ann", (name,), ()))
        self.model.worlds[name] = "", 0
        self.tally["worlds made again"] += name in self.model.bases
        self._settle("worlds made")

    @rule(label=st.sampled_from(LABELS), picks=st.lists(PICK, min_size=1, max_size=3), loss=LOSSES)
    def keep(self, label, picks, loss):
        """Somebody wants some versions to stay, known ones and others."""
        found = [self._version(pick) for pick in picks]
        asked = list(dict.fromkeys(one for one in found if one is not None))
        if not asked:
            return
        answer = self._ask(KeepVersions("ann", label, tuple(asked)), loss)
        if answer is not NOT_KEPT:
            late = {
                one for one in asked if not self.model.keep(label, tuple(one.slot), one.version)
            }
            if answer is not KEPT:
                assert isinstance(answer, Kept), answer
                assert set(answer.forgotten) == late
                kept = {(tuple(slot), version) for slot, version in answer.versions}
                assert kept == self.model.labels.get(label, set())
            self.tally["kept too late"] += bool(late)
        self._settle("keeps")

    @rule(label=st.sampled_from(LABELS), loss=LOSSES)
    def let_go(self, label, loss):
        """Nobody wants them any more."""
        if label not in self.model.labels:
            return
        if self._ask(KeepVersions("ann", label, ()), loss) is not NOT_KEPT:
            self.model.let_go(label)
        self._settle("labels let go")

    @rule(keep=st.integers(0, 2))
    def restart(self, keep):
        """The shard dies between two steps."""
        self._crash(keep)
        self._settle("restarts")

    @rule(
        picks=st.lists(PICK, min_size=1, max_size=4),
        pick=PICK,
        beside_ns=st.sampled_from((-1, 0, 0, 1)),
    )
    def travel(self, picks, pick, beside_ns):
        """Some slots are seen as of a moment."""
        at_ns = min(self._moment(pick) + beside_ns, self._now_ns())
        self._travel(list(dict.fromkeys(map(self._place, picks))), at_ns)

    @rule(world=WORLDS, aspect=ASPECT, pick=PICK)
    def travel_by_pattern(self, world, aspect, pick):
        """All of one aspect are seen as of a moment: those that were there then."""
        if world not in self.model.worlds:
            return
        at_ns = self._moment(pick)
        places = [place for place in self.model.places(world) if place[2] == aspect]
        answer = self._view([Item(int(Access.VIEW_EACH), world, "**", aspect)], at_ns)
        expected = self.model.view(places, at_ns)
        if isinstance(expected, Past):
            self._check_forgotten(answer, expected)
            return
        assert isinstance(answer, Viewed), answer
        shown = {place: one for place, one in expected.items() if isinstance(one, dict)}
        found = {tuple(state.slot): state for state in answer.states}
        assert found.keys() == shown.keys()
        for place, state in found.items():
            _check_state(state, shown[place])
        self.tally["travels by pattern"] += bool(found)

    @rule(where=PICK, nearest=st.booleans())
    def travel_by_capture(self, where, nearest):
        """A slot is seen as it was captured at each stamp, or next to it."""
        place = self._place(where)
        for captured_ns in range(1, CAPTURES_MAX + 2):
            item = Item(int(Access.VIEW), *place, 0, captured_ns, nearest)
            answer = self._view([item], 0)
            assert isinstance(answer, Viewed), answer
            expected = self.model.captured(place, captured_ns, nearest=nearest)
            _check_state(answer.states[0], expected)
            if isinstance(expected, dict):
                self.tally["nearest captures" if nearest else "exact captures"] += 1

    @rule(pick=PICK)
    def explain(self, pick):
        """Where a version comes from, and what came of it."""
        asked = self._version(pick)
        if asked is None:
            return
        answer = self._ask(Explain((asked,)))
        assert isinstance(answer, Versions), answer
        history = self.model.history(tuple(asked.slot))
        known = [state for state in history if state["version"] == asked.version]
        assert [entry.state.version for entry in answer.entries] == [s["version"] for s in known]
        self.tally["explained too late"] += not known
        if known:
            self._check_effects(DatumRead(*asked, known[0]["stamp_ns"]))

    def _check_effects(self, read: DatumRead) -> None:
        answer = self._ask(FindEffects((read,)))
        assert isinstance(answer, Versions), answer
        found = {(tuple(entry.state.slot), entry.state.version) for entry in answer.entries}
        expected = {
            (place, state["version"])
            for place in self.model.lines
            for state in self.model.history(place)
            if state["cause"] is not None and read in state["cause"][2]
        }
        assert found == expected
        self.tally["effects"] += len(found)

    # ---------------------------------------------------------------- after each step

    @invariant()
    def all_histories_are_those_of_the_model(self):
        """Every known version of every slot is listed, with its times, labels and cause."""
        answer = self._ask(ListHistory((), (), ()))
        assert isinstance(answer, Versions), answer
        found: dict[Place, list[VersionEntry]] = {}
        for entry in answer.entries:
            found.setdefault(tuple(entry.state.slot), []).append(entry)
        expected = {place: self.model.history(place) for place in self.model.lines}
        assert found.keys() == {place for place, states in expected.items() if states}
        for place, entries in found.items():
            states = expected[place]
            assert [e.state.version for e in entries] == [s["version"] for s in states], place
            for entry, state in zip(entries, states, strict=True):
                self._check_entry(place, entry, state)

    def _check_entry(self, place: Place, entry: VersionEntry, state: dict[str, Any]) -> None:
        untils_ns = {state["until_ns"]}
        if not state["until_known"]:
            untils_ns.add(state["stamp_ns"])
        assert entry.until_ns in untils_ns, (place, entry, state)
        shown, cause = entry.state, entry.cause
        assert shown.stamp_ns == state["stamp_ns"], place
        assert shown.size == state["size"], place
        assert shown.null_reason == state["reason"], place
        assert shown.captured_ns == state["captured_ns"], place
        assert entry.kept == self.model.kept(place, state["version"]), place
        if state["cause"] is None:
            assert cause is None, place
            return
        assert cause is not None, place
        assert (cause.kind, cause.stamp_ns, cause.reads) == state["cause"], place
        assert SlotVersion(Slot(*place), state["version"]) in cause.writes, place

    # ---------------------------------------------------------------- commits

    def _granted(self, writes):
        """Take a lock on what can be written; return it with the writes, twice."""
        writes = [write for write in writes if write[0][0] in self.model.worlds]
        if not writes:
            return None, (), []
        self.seq += 1
        items = [Item(int(Access.WRITE), *place) for place, _, _ in writes]
        granted = self.bench.granted(lock_id("ann", 0, self.seq), *items, alone=False)
        taken, sent = [], []
        for place, size, captured_ns in writes:
            self.numbers += 1
            body = None if size is None else str(self.numbers).encode().ljust(size, b".")
            datum = None if body is None else Datum(b"t", body, len(body), captured_ns)
            taken.append((place, body, captured_ns))
            sent.append(WriteItem(Slot(*place), datum))
        return granted, tuple(sent), taken

    def _commit(self, writes, reads, loss=None) -> None:
        granted, sent, taken = self._granted(writes)
        if granted is None:
            return
        inputs = tuple(map(self._newest, reads))
        commit = Commit(granted.lock, granted.token, sent, 0, reads=inputs)
        answer = self._ask(commit, loss, [place for place, _, _ in taken])
        if answer is KEPT:
            rows = [row for row in self.bench.log if isinstance(row, SlotRecord)]
            stamp_ns = rows[-1].stamp_ns
        elif answer is not NOT_KEPT:
            assert isinstance(answer, Committed), answer
            stamp_ns = answer.position.stamp_ns
        if answer is not NOT_KEPT:
            self._set(taken, stamp_ns, (CAUSE_COMMIT, stamp_ns, inputs))
        if self.late is not None:
            self._check_view([place for place, _, _ in taken], stamp_ns, self.late)
            self.late = None
            self.tally["views that waited"] += 1
        self._settle("commits")

    def _set(self, taken, stamp_ns: int, cause) -> None:
        for place, body, captured_ns in taken:
            size = 0 if body is None else len(body)
            self.model.set(place, stamp_ns, body, size=size, captured_ns=captured_ns, cause=cause)

    def _newest(self, place: Place) -> DatumRead:
        states = self.model.lines[place].states if place in self.model.lines else []
        known = (states[-1]["version"], states[-1]["stamp_ns"]) if states else (0, 0)
        return DatumRead(Slot(*place), *known)

    # ---------------------------------------------------------------- views

    def _view(self, items, at_ns: int):
        return self._ask(self._view_request(items, at_ns))

    def _view_request(self, items, at_ns: int) -> TakeView:
        self.seq += 1
        bench = self.bench
        lock, count = lock_id("ann", 1, self.seq), bench.next_count("ann")
        return TakeView(lock, bench.shard.epoch, 1, count, tuple(items), 0, at_ns, bool(at_ns))

    def _travel(self, places: list[Place], at_ns: int) -> None:
        items = [Item(int(Access.VIEW), *place) for place in places]
        self._check_view(places, at_ns, self._view(items, at_ns))

    def _check_view(self, places: list[Place], at_ns: int, answer) -> None:
        expected = self.model.view(places, at_ns)
        if isinstance(expected, Past):
            self._check_forgotten(answer, expected)
            return
        assert isinstance(answer, Viewed), (answer, expected)
        assert answer.from_ns <= at_ns <= answer.until_ns
        for place, state in zip(places, answer.states, strict=True):
            _check_state(state, expected[place])
        self.tally["travels"] += 1
        self.tally["travels to a null"] += any(isinstance(o, Nothing) for o in expected.values())

    def _check_forgotten(self, answer, expected: Past) -> None:
        assert isinstance(answer, Forgotten), (answer, expected)
        assert answer.oldest_ns == expected.since_ns
        self.tally["forgotten"] += 1

    def _look_while_under_way(self, places: list[Place]) -> int:
        """View what a commit is about to replace: as of before at once, as of then when it is done.

        Returns:
            The handle of a view that waits.
        """
        undecided_ns = min(stamp_ns for stamp_ns, _ in self.bench.shard.state.commits.undecided())
        items = [Item(int(Access.VIEW), *place) for place in places]
        before = self.bench.ask(self._view_request(items, undecided_ns - 1))
        self._check_view(places, undecided_ns - 1, before)
        waits = self.bench.send(self._view_request(items, undecided_ns))
        assert waits not in self.bench.answers, "shows what is undecided"
        return waits

    # ---------------------------------------------------------------- choosing

    def _now_ns(self) -> int:
        return self.bench.shard.state.stamps.last_ns

    def _moment(self, pick: int) -> int:
        """Return a moment that was: the present as often as each of the last ones."""
        moments = [*(self.moments if pick % 4 == 0 else self.moments[-30:]), self._now_ns()]
        return moments[pick // 4 % len(moments)]

    def _place(self, pick: int) -> Place:
        """Return a slot that there is, or may be."""
        places = [place for world in self.model.worlds for place in self.model.places(world)]
        places += [(world, "piece", "three") for world in self.model.worlds]
        return places[pick % len(places)]

    def _version(self, pick: int) -> SlotVersion | None:
        """Return some version that there was, known or not."""
        versions = [
            SlotVersion(Slot(*place), state["version"])
            for place, line in self.model.lines.items()
            for state in line.states[-8:]
        ]
        return versions[pick % len(versions)] if versions else None

    # ---------------------------------------------------------------- disk, time and death

    def _hello(self) -> None:
        for known_epoch in (0, self.bench.shard.epoch):
            self._ask(Hello("ann", known_epoch, 2 * S, "ann", "host", 1, False))

    def _ask(self, message, loss: str | None = None, looked_at: list[Place] | None = None):
        """Ask, and let the disk keep everything; or die while it works on this.

        Returns:
            The answer; where the shard has died, `KEPT` or `NOT_KEPT`.
        """
        bench = self.bench
        before = len(bench.pending)
        handle = bench.send(message)
        if handle not in bench.answers and loss is not None and len(bench.pending) > before:
            self._crash(len(bench.pending) if loss == "after" else before)
            self.tally[f"died {loss} the record"] += 1
            return KEPT if loss == "after" else NOT_KEPT
        waits = 0
        if looked_at and handle not in bench.answers:
            waits = self._look_while_under_way(looked_at)
        bench.finish_disk()
        self.late = bench.answers.get(waits)
        return bench.answers[handle]

    def _crash(self, keep: int) -> None:
        """Die with the first so many of the records that were not reported, and start again."""
        bench = self.bench
        for persist in bench.pending[:keep]:
            bench.log += persist.records
        bench.wall_ns += DOWN_NS
        bench.restart()
        self.fallen_ns = bench.shard.state.stamp()
        self._hello()

    def _restart_model(self) -> None:
        """After a crash, once the step that it came in is in the model or known to be lost."""
        if self.fallen_ns:
            self.model.restart(self.fallen_ns)
            self.fallen_ns = 0

    def _settle(self, step: str) -> None:
        """End a step: what is too old goes, here and there."""
        self.tally[step] += 1
        self._restart_model()
        self.moments.append(self.bench.shard.state.stamp())
        self.bench.event(Tick())
        self.model.pass_time(self._now_ns())


def _fork_cause(at_ns: int):
    return lambda read: (CAUSE_FORK, at_ns, (DatumRead(Slot(*read[0]), *read[1:]),))


def _check_state(state: SlotState, expected: dict[str, Any] | Nothing) -> None:
    if isinstance(expected, Nothing):
        assert (state.datum, state.null_reason) == (None, expected.reason), state
        return
    assert state.datum is not None, (state, expected)
    assert bytes(state.datum.body) == expected["value"]
    assert (state.version, state.stamp_ns) == (expected["version"], expected["stamp_ns"])
