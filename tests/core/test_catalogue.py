"""What clients register is bounded: every hello is answered with all of it."""

from random import Random

import pytest
from shard_bench import ShardBench, item, lock_id, slot

from enact_dist.core.offline.forgetting import planned, unused_aspects, unused_worlds, world_drops
from enact_dist.core.protocol.messages import (
    AspectEntry,
    DropWorld,
    EpochChanged,
    Fork,
    Hello,
    ListSessions,
    Refused,
    Register,
    Registered,
    Welcome,
    WorldEntry,
)
from enact_dist.core.protocol.records import (
    Recovered,
    SlotRecord,
    WorldDropped,
    WorldRecord,
)
from enact_dist.core.shard import inspection
from enact_dist.core.state import catalogue
from enact_dist.core.state.catalogue import ASPECTS_MAX, CATALOGUE_BYTES_MAX, WORLDS_MAX
from enact_dist.terms import Access
from enact_dist.wire.frames import encode_frame

MIB = 1 << 20
HELLO = Hello("bob", 0, 10**9, "", "", 0, True)
SESSIONS = ("ann",)


def register(bench, worlds=(), aspects=()):
    return bench.ask(Register("ann", tuple(worlds), tuple(aspects)))


def worlds(count, length=8):
    return (f"w{number}".ljust(length, "w") for number in range(count))


def aspects(count, fingerprint="int"):
    return (AspectEntry(f"a{number}", fingerprint, "durable") for number in range(count))


def test_session_that_is_not_known_registers_nothing(bench):
    """It is told to say hello first, as for a lock."""
    answer = bench.ask(Register("stranger", ("lab",), ()))

    assert answer == EpochChanged(1)
    assert "lab" not in bench.ask(HELLO).worlds


@pytest.mark.parametrize(
    ("asked", "bound"),
    [
        ({"worlds": worlds(WORLDS_MAX)}, f"world contexts to the 2 that are here; at most {WORLDS_MAX}"),
        ({"aspects": aspects(ASPECTS_MAX)}, f"aspects to the 3 that are here; at most {ASPECTS_MAX}"),
        ({"aspects": aspects(1, "x" * 4097)}, "a fingerprint of 4097 characters; at most 4096"),
        ({"aspects": aspects(800, "x" * 4096)}, f"at most {CATALOGUE_BYTES_MAX}"),
    ],
)  # fmt: skip
def test_registration_beyond_a_bound_is_refused_whole_and_names_it(bench, asked, bound):
    """Nothing of it is kept, neither here nor on the disk; the remedy is named."""
    before, log = bench.ask(HELLO), len(bench.log)

    answer = register(bench, **asked)

    assert isinstance(answer, Refused)
    assert answer.code == "overload"
    assert bound in answer.text
    assert "enact world drop" in answer.text
    after = bench.ask(HELLO)
    assert (after.worlds, after.aspects, len(bench.log)) == (before.worlds, before.aspects, log)
    assert bench.counter("overloads") == 1
    assert isinstance(register(bench, ["lab"], aspects(1)), Registered)


def test_fullest_catalogue_is_a_welcome_below_four_mebibytes(bench):
    """The longest names, as many as there may be, and types until nothing more is taken."""
    assert isinstance(register(bench, worlds(WORLDS_MAX - 2, 200)), Registered)
    number, step = 0, 20
    while step:
        names = (f"b{number + one}".ljust(200, "b") for one in range(step))
        entries = [AspectEntry(name, "x" * 4096, "os") for name in names]
        if isinstance(register(bench, (), entries), Registered):
            number += step
        else:
            step //= 2

    welcome = bench.ask(HELLO)

    assert number > 400
    assert len(welcome.aspects) == 3 + number
    assert len(encode_frame(welcome)[0]) < 4 * MIB


def test_what_is_known_is_registered_again_in_a_full_catalogue(bench, monkeypatch):
    """Actors that have run before run on."""
    monkeypatch.setattr(catalogue, "WORLDS_MAX", 2)
    monkeypatch.setattr(catalogue, "ASPECTS_MAX", 3)
    monkeypatch.setattr(catalogue, "CATALOGUE_BYTES_MAX", 1)

    assert isinstance(register(bench, ["online"], [AspectEntry("note", "int", "os")]), Registered)
    assert register(bench, ["lab"]).code == "overload"


def test_fork_beyond_the_bound_is_refused_until_a_context_is_dropped(bench, monkeypatch):
    """A fork is a world context, too."""
    monkeypatch.setattr(catalogue, "WORLDS_MAX", 3)
    register(bench, ["lab"])
    stamp_ns = bench.shard.state.stamp()

    refused = bench.ask(Fork("ann", "what_if", "online", stamp_ns))
    bench.ask(DropWorld("ann", "lab"))

    assert (refused.code, "at most 3" in refused.text) == ("no_room", True)
    assert bench.ask(Fork("ann", "what_if", "online", stamp_ns)).world == "what_if"


# ---------------------------------------------------------------- a store with more than that


def stuffed():
    """What a release without a bound let a client do: 21 MB of contexts and fat aspects."""
    return Recovered(
        2,
        worlds=[WorldRecord(name) for name in worlds(20_000, 200)],
        aspects=[
            *aspects(280, "x" * 60_000),
            AspectEntry("count", "int", "durable"),
        ],
        slots=[SlotRecord(slot(context="w7"), 3, 1, None, "DELETED", False)],
    )


def test_shard_with_an_older_store_that_is_too_full_says_hello():
    """It shows what has room, that with data and small types first, and counts the rest."""
    bench = ShardBench(recovered=stuffed())

    welcome = bench.ask(HELLO)

    assert isinstance(welcome, Welcome)
    assert len(encode_frame(welcome)[0]) < 4 * MIB
    assert welcome.worlds[:3] == ("online", "training", "w7")
    assert welcome.aspects[0].name == "count"
    shown = len(welcome.worlds) + len(welcome.aspects)
    assert bench.shard.state.catalogue.shown().left_out == 3 + 20_000 + 281 - shown
    listed = bench.ask(ListSessions())
    assert "catalogue_left_out" in [counter.name for counter in listed.counters]
    bench.hello("ann")
    assert register(bench, ["lab"]).code == "overload"
    assert isinstance(bench.granted(lock_id("ann"), item(Access.WRITE)).token.number, int)


def test_who_reads_figures_meanwhile_leaves_no_catalogue_of_before_behind(bench, monkeypatch):
    """Figures are taken without the shard's mutex: here between a look and a registration."""
    known = bench.shard.state.catalogue
    real = catalogue.CatalogueExcerpt

    def registered_meanwhile(*parts):
        monkeypatch.setattr(catalogue, "CatalogueExcerpt", real)
        bench.ask(Register("ann", ("later",), ()))
        return real(*parts)

    known.add_world(WorldEntry("soon"))
    monkeypatch.setattr(catalogue, "CatalogueExcerpt", registered_meanwhile)
    inspection.counted(bench.shard.state)

    assert "later" in bench.ask(HELLO).worlds


def test_what_is_unused_can_be_forgotten_from_such_a_store():
    """Everything without data but forks and what the cell names; versions never come twice."""
    stored = Recovered(
        2,
        worlds=[WorldRecord(name) for name in ("lab", "named", "used", "twice")]
        + [WorldRecord("fork", "used", 5)],
        dropped=[WorldDropped("twice", 9)],
        aspects=[AspectEntry("count", "int", "durable"), AspectEntry("fat", "x" * 60_000, "os")],
        slots=[SlotRecord(slot(context="used"), 3, 1, None, "DELETED", False)],
    )
    stores = {"s0": stored, "s1": Recovered(2, worlds=[WorldRecord("lab")])}

    assert unused_aspects(stores) == ("fat",)
    gone = unused_worlds(stores, ["named"])
    assert gone == ("lab", "twice")
    assert world_drops(stores, gone) == {
        "s0": (WorldDropped("lab", 0), WorldDropped("twice", 9)),
        "s1": (WorldDropped("lab", 0),),
    }
    assert planned(stores, unused_aspects(stores), now_ns=1).names == ("fat",)


@pytest.mark.parametrize("fingerprint", ["int", "x" * 4097])
def test_registration_costs_the_same_however_many_aspects_there_are(
    bench, monkeypatch, fingerprint
):
    """A refusal put back all of them: 13 ms with 4,096, while everybody waited."""
    register(bench, aspects=aspects(ASPECTS_MAX - 10))
    bytes_in_frame, sized = catalogue.bytes_in_frame, []

    def sizing(value):
        sized.append(value)
        return bytes_in_frame(value)

    monkeypatch.setattr(catalogue, "bytes_in_frame", sizing)
    answer = register(bench, ["lab"], [AspectEntry("new", fingerprint, "durable")])

    assert isinstance(answer, Registered) is (fingerprint == "int")
    assert len(sized) < 10


@pytest.mark.parametrize("seed", range(8))
def test_catalogue_is_after_each_registration_what_a_look_at_all_entries_gives(bench, monkeypatch, seed):  # fmt: skip
    """New types, larger retention, refusals half way: sums and what is shown stay right."""
    monkeypatch.setattr(catalogue, "ASPECTS_MAX", 14)
    monkeypatch.setattr(catalogue, "WORLDS_MAX", 8)
    random, known = Random(seed), bench.shard.state.catalogue
    types = ("int", "float", "a" * 5000, 'm.P{"x": int}', 'm.P{"x": int, "y": int = 0}')
    answers = set()
    for _ in range(120):
        before = {**known.aspects}, {**known.worlds}, {**known.policies}
        entries = [
            AspectEntry(f"a{random.randrange(16)}", random.choice(types), "durable", random.randrange(3))
            for _ in range(random.randrange(4))
        ]  # fmt: skip
        answer = register(bench, [f"w{random.randrange(12)}"][: random.randrange(2)], entries)
        answers.add(type(answer))

        if isinstance(answer, Refused):
            assert (known.aspects, known.worlds, known.policies) == before
        whole = catalogue.Catalogue(
            configured=(), recovered=known.aspects.values(), worlds=known.worlds.values()
        )
        assert (known.bytes, known.successions) == (whole.bytes, whole.successions)
        assert known.shown() == whole.shown()
    assert answers == {Registered, Refused}
