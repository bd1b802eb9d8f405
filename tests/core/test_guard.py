"""Each request with the right that it needs and without: refused by name, with no other effect."""

from __future__ import annotations

from dataclasses import replace

import pytest
from shard_bench import ASPECTS, PLACEMENT, S, ShardBench, datum, item, lock_id, slot

from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol.datum import Token
from enact_dist.core.protocol.messages import Hello, Refused, WriteItem
from enact_dist.core.protocol.records import Recovered
from enact_dist.core.rights.guard import NOTED_MAX
from enact_dist.core.rights.rules import UNPROVEN, Rights, Rule, data_path
from enact_dist.core.shard.shard import Shard
from enact_dist.core.state.slots import INLINE_BYTES_MAX
from enact_dist.terms import Access

CAM = "cam@h:1"


def rule(**gives):
    """Return a rule for the camera: `read="online:a/x"`, `write` as what it stands for."""
    pairs = []
    for right, paths in gives.items():
        for one in (paths,) if isinstance(paths, str) else paths:
            data = right in ("read", "write", "change", "init", "delete")
            path = data_path(one) if data else one
            rights = ("change", "init", "delete") if right == "write" else (right.rstrip("_"),)
            pairs += [(each, path) for each in rights]
    return Rule(("cam",), tuple(pairs))


class GuardedBench(ShardBench):
    """A shard with rights at which the camera has a session."""

    def __init__(self, **gives):
        self.rights = Rights([rule(**gives)], operators=["ada"], hint="cell.toml, line 41")
        super().__init__()
        self.ask_as(CAM, Hello("cam", 0, 2 * S, "cam", "h", 1, False))

    def _boot(self, recovered):
        self.settings = replace(self.settings, rights=self.rights)
        super()._boot(recovered)
        plain = self.shard.handle

        def handle(message, *, identity="", **others):
            subject = identity.partition("@")[0]
            return plain(message, identity=identity, subject=subject, **others)

        self.shard.handle = handle

    def put(self, entity, text="0"):
        """Write a datum by this process, which needs no right."""
        self.hello("host")
        answer = self.write("host", len(self.notices) + 1, text, to=slot(entity))
        assert isinstance(answer, m.Committed), answer

    def asked(self, message):
        return self.ask_as(CAM, message)

    def acquired(self, access, entity="piece", aspect="count", seq=1):
        request = self.acquire_request(lock_id("cam", seq=seq), item(access, entity, aspect))
        return self.asked(request)


def refused(answer, right, what):
    assert isinstance(answer, Refused), answer
    assert answer.code == "permission"
    assert answer.text.startswith(f"cam may not {right} {what}: it "), answer.text
    assert answer.text.endswith("or add it (cell.toml, line 41)")
    return True


def requests(bench):
    """Return each row of the table: the rights that it needs, and the request."""
    lock, where = lock_id("cam"), {"epoch": bench.shard.epoch, "count": 9}
    acquire = bench.acquire_request
    everything = "online:**"
    return {
        "read": ({"read": "online:*/count"}, acquire(lock, item(Access.READ))),
        "read each": ({"read": "online:**/count"}, acquire(lock, item(Access.READ_EACH, "**"))),
        "write": ({"write": "online:piece/count"}, acquire(lock, item(Access.WRITE))),
        "init": ({"init": "online:piece/count"}, acquire(lock, item(Access.WRITE))),
        "view": (
            {"read": "online:piece/count"},
            m.TakeView(lock, bench.shard.epoch, PLACEMENT.version, 1, (item(Access.VIEW),), 0),
        ),
        "aspect": ({"change": "*:a/*"}, m.Register("cam", (), (ASPECTS[0],))),
        "world": ({"register": "new*"}, m.Register("cam", ("new1",), ())),
        "fork": (
            {"read": everything, "fork": "online/what*"},
            m.Fork("cam", "what1", "online", bench.wall_ns, **where),
        ),
        "drop": ({"drop": "training*"}, m.DropWorld("cam", "training2", **where)),
        "keep": ({"keep": "day/*"}, m.KeepVersions("cam", "day/1", (), **where)),
        "break": ({"break_": "**"}, m.Break(7, "why", bench.shard.epoch)),
        "abort": ({"resolve": "**"}, m.ForceAbort(7, "why", bench.shard.epoch)),
        "settle": ({"resolve": "**"}, m.ListAudit("settled")),
        "locks": ({"observe": "**"}, m.ListLocks()),
        "sessions": ({"observe": "**"}, m.ListSessions()),
        "explain": ({"observe": "**"}, m.Explain(())),
        "effects": ({"observe": "**"}, m.FindEffects(())),
        "audit": ({"observe": "**"}, m.ListAudit("")),
    }


@pytest.mark.parametrize("row", requests(ShardBench()))
def test_each_request_with_its_right_and_without(row):
    """With its rights it is answered; without any one it is refused and counted, with no effect."""
    gives, _ = requests(ShardBench())[row]
    bench = GuardedBench(**gives)
    answer = bench.asked(requests(bench)[row][1])
    assert not isinstance(answer, Refused) or answer.code != "permission", answer
    assert bench.counter("permission_denied") == 0

    for left_out in gives:
        without = {right: paths for right, paths in gives.items() if right != left_out}
        bench = GuardedBench(**without)
        before = len(bench.log), len(bench.notices)
        answer = bench.asked(requests(bench)[row][1])
        assert isinstance(answer, Refused), answer
        assert answer.code == "permission"
        assert (len(bench.log), len(bench.notices)) == before
        assert bench.shard.state.tenures.by_lock == {}
        assert bench.counter("permission_denied") == 1
        assert bench.counter("requests_refused") == 0


def test_this_process_and_operators_need_no_right():
    """Both pass where the camera, which has no rule, would be refused."""
    bench = GuardedBench()
    assert isinstance(bench.ask(m.ListLocks()), m.Locks)
    assert isinstance(bench.ask_as("ada@h:2", m.Break(7, "why", bench.shard.epoch)), m.Broken)


def test_a_name_without_proof_may_do_nothing_and_may_try_again():
    """It may say hello and renew; its refusal does not end an actor for good."""
    bench = GuardedBench(read="online:**")
    handle = type(bench.shard).handle
    asked = handle(
        bench.shard,
        bench.acquire_request(lock_id("cam"), item(Access.READ)),
        reply_to=999, identity=CAM, now_ns=bench.now_ns, wall_ns=bench.wall_ns,
    )  # fmt: skip
    (answer,) = [effect.answer for effect in asked if hasattr(effect, "answer")]
    assert answer.code == "unproven"
    assert "cam@h:1 asked to read online:piece/count over Zenoh" in answer.text


def test_a_reader_changes_nothing_of_what_is_registered():
    """It registers what it reads at every shard; one that may not write it alters no catalogue."""
    bench = GuardedBench(read="online:**")
    known, before = ASPECTS[0], bench.shard.state.catalogue.shown()
    new = known._replace(name="new", reads=True)
    more = known._replace(reads=True, retention=known.retention + 9)
    log = len(bench.log)

    assert isinstance(bench.asked(m.Register("cam", (), (new, more))), m.Registered)
    assert bench.shard.state.catalogue.shown() == before
    assert len(bench.log) == log
    assert bench.counter("permission_denied") == 0
    other = known._replace(reads=True, fingerprint="str")
    assert bench.asked(m.Register("cam", (), (other,))).code == "datum_type"
    assert refused(
        bench.asked(m.Register("cam", (), (more._replace(reads=False),))), "write", "aspect count"
    )
    writer = GuardedBench(read="online:**", change="online:*/new")
    assert isinstance(writer.asked(m.Register("cam", (), (new,))), m.Registered)
    assert "new" in writer.shard.state.catalogue.aspects


def test_a_pattern_half_inside_a_rule_is_refused():
    """A pattern has to lie within a rule, not just overlap with it."""
    bench = GuardedBench(read="online:view/*/count")
    assert isinstance(bench.acquired(Access.READ_EACH, "view/*"), m.Granted)
    assert refused(
        bench.acquired(Access.READ_EACH, "view/**", seq=2), "read", "online:view/**/count"
    )
    assert refused(bench.acquired(Access.READ_EACH, "*/a", seq=3), "read", "online:*/a/count")


def test_a_view_beside_a_lock_needs_its_own_right():
    """The right to write one slot does not show another one."""
    bench = GuardedBench(write="online:piece/count")
    both = (item(Access.WRITE), item(Access.VIEW, "other"))
    answer = bench.asked(bench.acquire_request(lock_id("cam"), *both))
    assert refused(answer, "read", "online:other/count")


def written(bench, value, seq=1):
    granted = bench.acquired(Access.WRITE, seq=seq)
    assert isinstance(granted, m.Granted), granted
    lock = lock_id("cam", seq=seq)
    return bench.asked(m.Commit(lock, granted.token, (WriteItem(slot(), value),), 0))


@pytest.mark.parametrize(
    ("has", "value", "there", "needs"),
    [
        ("change", datum(), False, "init"),
        ("change", None, True, "delete"),
        ("init", datum(), True, "change"),
        ("delete", datum(), True, "change"),
        ("change", datum(), True, ""),
        ("init", datum(), False, ""),
        ("delete", None, True, ""),
    ],
)
def test_a_commit_needs_the_right_for_what_is_there(has, value, there, needs):
    """Null becomes a datum by `init`, a datum another one by `change`, and null by `delete`."""
    bench = GuardedBench(**{has: "online:piece/count"})
    if there:
        bench.put("piece")
    answer = written(bench, value)
    if not needs:
        assert isinstance(answer, m.Committed), answer
        return
    assert refused(answer, needs, "online:piece/count")
    content = bench.shard.state.slots[slot()]
    assert (content.datum is not None) is there
    assert bench.shard.state.tenures.by_lock == {}  # a late copy finds no lock


def test_a_hostile_commit_of_what_the_lock_does_not_hold_changes_nothing():
    """Its token is that of a lock on another slot."""
    bench = GuardedBench(write="online:piece/count")
    granted = bench.acquired(Access.WRITE)
    other = WriteItem(slot("other"), datum())
    answer = bench.asked(m.Commit(lock_id("cam"), granted.token, (other,), 0))
    assert isinstance(answer, Refused)
    assert bench.shard.state.slots[slot("other")].datum is None


def test_nothing_is_prepared_without_the_right():
    """The other shard's half of a commit is refused, as its lock would have been."""
    bench = GuardedBench(change="online:piece/count")
    granted = bench.acquired(Access.WRITE)
    prepare = m.Prepare(
        lock_id("cam"), granted.token, (WriteItem(slot(), datum()),), 0, (),
        PLACEMENT.shards[1].name, Token(1, 1),
    )  # fmt: skip
    assert refused(bench.asked(prepare), "init", "online:piece/count")
    assert bench.counter("prepared") == 0
    bench = GuardedBench()
    assert refused(bench.acquired(Access.WRITE), "write", "online:piece/count")
    assert bench.shard.state.tenures.by_lock == {}


def test_listings_leave_out_what_is_not_readable():
    """A question about that slot alone is refused, since null would be a wrong answer."""
    bench = GuardedBench(read="online:piece/count", observe="**")
    for entity in ("piece", "secret"):
        bench.put(entity)
    seen = bench.asked(m.Survey((), (), ())).states
    assert [state.slot.entity for state in seen] == ["piece"]
    listed = bench.asked(m.ListHistory((), (), ())).entries
    assert {entry.state.slot.entity for entry in listed} == {"piece"}
    asked = tuple(m.SlotVersion(slot(entity), 1) for entity in ("secret", "piece"))
    assert len(bench.asked(m.Explain(asked)).entries) == 1
    assert len(bench.ask(m.Survey((), (), ())).states) == 2
    for alone in (
        m.Explain((m.SlotVersion(slot("secret"), 1),)),
        m.ListHistory(("online",), ("secret",), ("count",)),
    ):
        assert refused(bench.asked(alone), "read", "online:secret/count")


def test_a_large_datum_is_fetched_by_a_reader_or_under_its_own_lock():
    """Who may only write it gets its bytes once a lock pins them, and not before."""
    bench = GuardedBench(write="online:piece/count", read="online:other/count")
    for entity in ("piece", "secret", "other"):
        bench.put(entity, "1" * (INLINE_BYTES_MAX + 1))

    def fetched(entity):
        return bench.asked(m.Fetch(lock_id("cam"), bench.shard.epoch, slot(entity), 1, 0, 9))

    assert isinstance(fetched("other"), m.Slice)
    assert refused(fetched("piece"), "read", "online:piece/count")
    assert isinstance(bench.acquired(Access.WRITE), m.Granted)
    assert isinstance(fetched("piece"), m.Slice)
    assert refused(fetched("secret"), "read", "online:secret/count")


def test_new_rights_hold_from_the_next_message_on():
    """A lock that is held then ends at its commit, which is refused."""
    bench = GuardedBench(write="online:piece/count")
    granted = bench.acquired(Access.WRITE)
    bench.shard.take_rights(Rights([], hint="cell.toml, line 41"))
    commit = m.Commit(lock_id("cam"), granted.token, (WriteItem(slot(), datum()),), 0)
    assert refused(bench.asked(commit), "init", "online:piece/count")
    bench.shard.take_rights(bench.rights)
    assert isinstance(written(bench, datum(), seq=2), m.Committed)
    plain = Shard(
        replace(bench.settings, rights=None), Recovered(1), now_ns=bench.now_ns,
        wall_ns=bench.wall_ns,
    )  # fmt: skip
    with pytest.raises(ValueError, match="without rights"):
        plain.take_rights(bench.rights)


def test_a_request_asked_again_shows_nothing_that_is_no_longer_readable():
    """A held lock is found by its name, so what it holds counts, not what the copy asks for."""
    bench = GuardedBench(read="online:**", write="online:piece/count")
    bench.put("secret")
    both = (item(Access.WRITE), item(Access.VIEW, "secret"))
    granted = bench.asked(bench.acquire_request(lock_id("cam"), *both))
    assert [state.slot.entity for state in granted.states] == ["piece", "secret"]
    waits = bench.acquire_request(lock_id("host"), item(Access.WRITE, "secret"), wait_ns=0)
    assert isinstance(bench.ask(waits), m.Granted)
    queued = bench.acquire_request(lock_id("cam", lane=1), item(Access.READ, "secret"), wait_ns=0)
    assert isinstance(bench.asked(queued), m.Waiting)

    bench.shard.take_rights(Rights([rule(write="online:piece/count")], hint="cell.toml, line 41"))
    assert refused(
        bench.asked(bench.acquire_request(lock_id("cam"), *both)), "read", "online:secret/count"
    )
    for lane in (0, 1):
        for items in ((), (item(Access.WRITE),)):
            again = bench.acquire_request(lock_id("cam", lane=lane), *items, wait_ns=0)
            assert refused(bench.asked(again), "read", "online:secret/count")


def test_a_view_under_the_name_of_a_held_lock_needs_its_own_right():
    """The name of a lock opens nothing beyond its own slots."""
    bench = GuardedBench(write="online:piece/count")
    assert isinstance(bench.acquired(Access.WRITE), m.Granted)
    hidden = (item(Access.VIEW, "secret"),)
    view = m.TakeView(lock_id("cam"), bench.shard.epoch, PLACEMENT.version, 9, hidden, 0)
    assert refused(bench.asked(view), "read", "online:secret/count")


def test_a_name_without_proof_has_no_part_of_what_everybody_may():
    """A rule for `*` holds for proven names only."""
    rights = Rights([Rule(("*",), (("change", "**"), ("read", "**")))])
    assert rights.may_write_some("anybody", "**")
    assert not rights.may_write_some(UNPROVEN, "**")
    bench = GuardedBench()
    bench.shard.take_rights(rights)
    for message in (m.Stage("cam", "cam-1", 0, 9, datum()), m.Register("cam", (), (ASPECTS[0],))):
        assert bench.shard.denied(message, CAM, None).code == "unproven"
        assert bench.shard.denied(message, CAM, "cam") is None


@pytest.mark.parametrize(
    "readable", [("online:view/**",), ("online:*/**", "online:**/count"), ("*:**/count",)]
)
def test_a_world_of_which_a_part_is_readable_cannot_be_forked(readable):
    """Its fork would be another world, with other rules; parts of several rules make no whole."""
    bench = GuardedBench(read=readable, fork="online/*")
    fork = m.Fork("cam", "copy", "online", bench.wall_ns, epoch=bench.shard.epoch, count=9)
    assert refused(bench.asked(fork), "read", "online:**")
    assert "copy" not in bench.shard.state.catalogue.worlds
    for source, world in (("*", "copy"), ("online/x", "copy"), ("onlin*", "copy"), ("**", "c")):
        assert isinstance(bench.asked(replace(fork, source=source, world=world)), Refused)


HOSTILE = ("*", "**", "\0", "online/count/piece", "count/secret", "a@b", "%2A", "", "../secret")


@pytest.mark.parametrize("text", HOSTILE)
def test_no_text_of_a_request_reaches_beyond_a_rule(text):
    """Worlds, aspects and entities that are patterns, paths or nothing: refused, or null."""
    bench = GuardedBench(read="online:piece/count", write="online:piece/count", fork="online/c*")
    bench.put("secret")
    for number, access in enumerate(Access, 1):
        for place in range(3):
            names = ["online", "secret", "count"]
            names[place] = text
            wanted = m.Item(int(access), names[0], names[1], names[2])
            lock = lock_id("cam", seq=10 * number + place)
            view = m.TakeView(lock, bench.shard.epoch, PLACEMENT.version, 1, (wanted,), 0)
            for message in (bench.acquire_request(lock, wanted, wait_ns=0), view):
                answer = bench.asked(message)
                assert isinstance(answer, Refused), (message, answer)
    assert bench.shard.state.tenures.by_lock == {}


def test_what_another_session_has_pinned_is_not_fetched():
    """Neither under its lock, nor under one's own."""
    bench = GuardedBench(write="online:piece/count")
    bench.put("secret")
    bench.ask_as("ada@h:2", Hello("ada", 0, 2 * S, "ada", "h", 2, False))
    pinned = bench.acquire_request(lock_id("ada"), item(Access.READ, "secret"))
    assert isinstance(bench.ask_as("ada@h:2", pinned), m.Granted)
    fetch = m.Fetch(lock_id("ada"), bench.shard.epoch, slot("secret"), 1, 0, 9)
    assert isinstance(bench.ask_as("ada@h:2", fetch), m.Slice)
    answer = bench.asked(fetch)
    assert answer.text == "session ada belongs to ada@h:2; cam@h:1 asked and may not speak for it"
    answer = bench.asked(replace(fetch, lock=lock_id("cam")))
    assert refused(answer, "read", "online:secret/count")


def test_the_log_names_a_subject_and_a_right_once_a_second():
    """Each right has its own line, and the next one counts what was left out."""
    bench = GuardedBench()
    for _ in range(5):
        bench.asked(m.ListLocks())
    bench.asked(m.Break(7, "why", bench.shard.epoch))
    told = [story.text for story in bench.stories if story.event == "permission.denied"]
    assert len(told) == 2
    bench.wait(2 * S, keep=("cam",))
    bench.asked(m.ListLocks())
    told = [story.text for story in bench.stories if story.event == "permission.denied"]
    assert len(told) == 3
    assert told[2].endswith("4 more since the last line")
    assert bench.counter("permission_denied") == 7


def test_refusals_can_be_listed_by_those_who_may_observe():
    """With how often, and when first and last; the refused listing is an entry itself."""
    bench = GuardedBench()
    for _ in range(3):
        bench.asked(m.Break(7, "why", bench.shard.epoch))
    assert isinstance(bench.asked(m.ListRefusals()), Refused)
    (broke, listed) = bench.ask_as("ada@h:1", m.ListRefusals()).entries
    assert broke[:4] == ("cam", "break", "locks", 3)
    assert listed[:4] == ("cam", "observe", "the cell", 1)
    assert 0 < broke.first_ns <= broke.last_ns


def test_of_more_refusals_than_are_kept_the_latest_stay():
    """One that had to go and comes again begins at one."""
    bench = GuardedBench()
    for number in range(NOTED_MAX + 2):
        bench.asked(m.DropWorld("cam", f"w{number % (NOTED_MAX + 1)}", bench.shard.epoch))
    found = bench.ask_as("ada@h:1", m.ListRefusals()).entries
    assert len(found) == NOTED_MAX
    assert (found[0].what, found[-1].what, found[-1].times) == ("w2", "w0", 1)
