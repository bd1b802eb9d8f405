"""Which types of an aspect go together, and what the shard lets clients of either do."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shard_bench import item, lock_id

from enact_dist.core.offline.moving import Shards
from enact_dist.core.protocol.datum_types import (
    TYPES_MAX,
    newest,
    same_type,
    succeeds,
    type_conflict,
    with_type_of,
)
from enact_dist.core.protocol.messages import (
    AspectEntry,
    Granted,
    PlacementMap,
    Refused,
    Register,
    Registered,
    Release,
    ShardEntry,
)
from enact_dist.core.protocol.records import Recovered
from enact_dist.core.state.catalogue import Catalogue
from enact_dist.terms import Access

R, W = Access.READ, Access.WRITE
FIRST, SECOND, THIRD = "P{x:int}", "P{x:int,y:str=}", "P{w:list[float]=,x:int,y:str=}"


def entry(fingerprint, *, reads=False):
    return AspectEntry("pose", fingerprint, "durable", reads=reads)


@pytest.mark.parametrize(
    ("newer", "older"),
    [
        ("P{x:int,y:str=}", "P{x:int}"),
        ("P{y:str=,x:int}", "P{x:int=}"),
        ("P{x:int,y:str=,z:Q{a:int}?=}", "P{x:int,y:str}"),
        ("P{q:list[Q{a:int,b:float=}]}", "P{q:list[Q{a:int}]}"),
        ("P{q:dict[str,tuple[Q{a:int,b:<grid>=},...]]?}", "P{q:dict[str,tuple[Q{a:int},...]]?}"),
        ("list[P{x:int,at:ndarray[datetime64[ns]]=}]", "list[P{x:int}]"),
        ("P{x:int=}", "P{}"),
    ],
)
def test_type_succeeds_one_that_lacks_fields_with_defaults(newer, older):
    """At any place, nested ones, too; never the other way round."""
    assert succeeds(newer, older)
    assert not succeeds(older, newer)
    assert not same_type(newer, older)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("P{x:int,y:str}", "P{x:int}"),
        ("Q{x:int,y:str=}", "P{x:int}"),
        ("P{y:str=}", "P{x:int}"),
        ("P{y:str=,x:float}", "P{x:int}"),
        ("P{b:int,a:int,c:int=}", "P{a:int,b:int}"),
        ("P{x:int?,y:str=}", "P{x:int}"),
        ("P{x:list[int],y:str=}", "P{x:list[float]}"),
        ("P{x:tuple[int,int],y:str=}", "P{x:tuple[int]}"),
        ("P{x:<grid>,y:str=}", "P{x:<mesh>}"),
        ("int", "float"),
        ("P{x:int,y:str=}…sha256:00", "P{x:int}"),
        ("P{x:int", "P{x"),
        ("P{x:int,y=}", "P{x:int}"),
        ("", "int"),
        ("[]", "{}"),
        ("P{" * 500 + "}" * 500, "P{}"),
    ],
)
def test_types_that_differ_otherwise_do_not_go_together(one, other):
    """Whatever a client sends as a fingerprint: it is only text."""
    assert not succeeds(one, other)
    assert not succeeds(other, one)
    assert type_conflict(entry(other), entry(one, reads=True))
    assert newest(entry(one), entry(other)) is None


def test_marks_do_not_tell_types_apart():
    """Catalogues of before know no marks: the same type brings them along."""
    bare, marked = entry("P{x:int,y:str}"), entry(SECOND)
    assert same_type(bare.fingerprint, marked.fingerprint)
    assert not type_conflict(bare, marked)
    assert not type_conflict(marked, bare)
    assert with_type_of(bare, marked) == marked
    assert with_type_of(marked, bare) == marked


LEAVES = st.sampled_from(["int", "str", "ndarray[float64]", "<grid>", "list[int]", "bytes?"])
NAMES = st.sampled_from("abcdefgh")


@st.composite
def records(draw, depth=0):
    """Draw a dataclass: (fields, where a field is its name, its type and whether it has a default)."""
    kinds = LEAVES if depth > 1 else st.one_of(LEAVES, records(depth + 1))
    fields = draw(
        st.lists(st.tuples(NAMES, kinds, st.booleans()), max_size=3, unique_by=lambda f: f[0])
    )
    return tuple(fields)


def text(kind):
    if isinstance(kind, str):
        return kind
    fields = (f"{name}:{text(inner)}{'=' * default}" for name, inner, default in kind)
    return f"P{{{','.join(fields)}}}"


@st.composite
def grown(draw, kind):
    """Draw what a type may become: new names, with defaults, anywhere."""
    if isinstance(kind, str):
        return kind
    fields = [(name, draw(grown(inner)), default) for name, inner, default in kind]
    for number in range(draw(st.integers(0, 2))):
        at = draw(st.integers(0, len(fields)))
        fields.insert(at, (f"new{number}{len(fields)}", draw(LEAVES), True))
    return tuple(fields)


@settings(max_examples=50)
@given(data=st.data(), first=records())
def test_growing_is_a_partial_order(data, first):
    """What grew twice succeeds the first; two that succeed each other are one type."""
    second = data.draw(grown(first))
    third = data.draw(grown(second))
    one, two, three = text(first), text(second), text(third)
    for newer, older in ((two, one), (three, two), (three, one)):
        assert same_type(newer, older) or succeeds(newer, older)
        assert not (succeeds(newer, older) and succeeds(older, newer))


@given(st.text(alphabet="Pxy{}[]<>,:?=.…", max_size=40), st.text(alphabet="Px{}[],:=", max_size=40))
def test_no_text_breaks_the_reading_of_fingerprints(one, other):
    """A hostile client's text is compared like any."""
    assert (type_conflict(entry(one), entry(other)) == "") == (
        same_type(one, other) or succeeds(other, one)
    )


# ---------------------------------------------------------------- the catalogue


def catalogue():
    return Catalogue(configured=(), recovered=(), worlds=())


def test_aspect_has_the_newest_type_that_was_written_and_knows_those_before():
    """A reader's type is never the aspect's; what is refused leaves all as it was."""
    known = catalogue()
    known.register(entry(FIRST))
    assert known.register(entry(THIRD, reads=True)) == (known.aspects["pose"], False)
    known.register(entry(SECOND))
    known.register(entry(THIRD))
    assert known.aspects["pose"].older == (FIRST, SECOND)
    assert known.successions == 2
    for older in (FIRST, SECOND):
        refused = known.register(entry(older))
        assert older in refused
        assert THIRD in refused
        assert known.register(entry(older, reads=True)) == (known.aspects["pose"], False)
    assert known.aspects["pose"] == entry(THIRD)._replace(older=(FIRST, SECOND))


def test_aspect_has_a_bounded_number_of_types():
    """The chain of types stays in every welcome, so it has an end; the error says what to do."""
    known = catalogue()
    fields = [f"f{number}:int=" for number in range(TYPES_MAX + 1)]
    for count in range(TYPES_MAX):
        assert not isinstance(known.register(entry(f"P{{{','.join(fields[:count])}}}")), str)
    refused = known.register(entry(f"P{{{','.join(fields)}}}"))

    assert "has had 16 datum types" in refused
    assert "enact shard forget pose" in refused
    assert known.successions == TYPES_MAX - 1


def test_registration_that_came_to_nothing_leaves_the_types_as_they_were():
    """Put back with the count of successions, by which clients are told apart."""
    known = catalogue()
    known.register(entry(FIRST))
    before = dict(known.aspects)
    known.register(entry(SECOND))
    known.put_back(before)

    assert known.aspects["pose"] == entry(FIRST)
    assert known.successions == 0


# ---------------------------------------------------------------- the shard


def registered(bench, *entries):
    answer = bench.ask(Register("ann", (), entries))
    assert isinstance(answer, Registered), answer
    return answer


def asked(bench, lock, access, successions):
    request = bench.acquire_request(lock, item(access, "arm", "pose"))
    return bench.ask(replace(request, successions=successions))


def test_client_that_missed_a_newer_type_writes_only_after_it_has_looked(bench):
    """Its lock is refused before it is queued; one that only reads is granted."""
    for session in ("ann", "bob"):
        bench.hello(session)
    registered(bench, entry(FIRST))
    assert isinstance(asked(bench, lock_id("bob", 0, 1), W, 0), Granted)
    registered(bench, entry(SECOND))

    refused = asked(bench, lock_id("bob", 0, 2), W, 0)
    assert isinstance(refused, Refused)
    assert refused.code == "newer_type"
    assert bench.counter("newer_types_missed") == 1
    assert bench.counter("types_succeeded") == 1
    assert isinstance(asked(bench, lock_id("bob", 0, 3), W, 1), Granted)
    bench.ask(Release(lock_id("bob", 0, 3)))
    assert isinstance(asked(bench, lock_id("bob", 0, 4), R, 0), Granted)


def test_lock_that_was_queued_before_the_newer_type_keeps_its_place(bench):
    """It was asked while its type held, and is granted before any lock of the newer one."""
    for session in ("ann", "bob"):
        bench.hello(session)
    registered(bench, entry(FIRST))
    held, queued = lock_id("ann", 0, 1), lock_id("bob", 0, 1)
    assert isinstance(asked(bench, held, W, 0), Granted)
    handle = bench.send(bench.acquire_request(queued, item(W, "arm", "pose")))
    registered(bench, entry(SECOND))
    bench.ask(Release(held))

    assert isinstance(bench.answers[handle], Granted)
    assert isinstance(asked(bench, queued, W, 0), Granted)  # asked again in the same words


def test_types_are_as_they_were_after_a_restart(bench):
    """The chain is stored with the aspect."""
    bench.hello("ann")
    registered(bench, entry(FIRST))
    registered(bench, entry(SECOND))

    (found,) = [one for one in bench.recovered(2).aspects if one.name == "pose"]
    assert found == entry(SECOND)._replace(older=(FIRST,))


# ---------------------------------------------------------------- a cell that moves entities


def merged(left, right):
    """Return the plan for a cell whose two shards know an aspect so, and its entries by shard."""
    stores = {"left": Recovered(2, aspects=[left]), "right": Recovered(2, aspects=[right])}
    placement = PlacementMap(2, (ShardEntry("left", ()), ShardEntry("right", ())), ())
    plan = Shards(stores, placement, under_way=False).plan()
    records = {shard: [one.entry for one in found] for shard, found in plan.first.items()}
    return plan.obstacles, records


def test_rebalance_gives_all_shards_the_newest_type():
    """Where a newer type was written on one shard alone."""
    newer = entry(SECOND)._replace(older=(FIRST,), retention=3)
    obstacles, records = merged(entry(FIRST)._replace(retention=5), newer)

    assert obstacles == []
    assert records == {shard: [newer._replace(retention=5)] for shard in ("left", "right")}


def test_rebalance_refuses_types_that_do_not_go_together():
    """As ever, by both names."""
    obstacles, _ = merged(entry(SECOND), entry("P{x:int,z:str=}"))

    assert len(obstacles) == 1
    assert SECOND in obstacles[0]
    assert "P{x:int,z:str=}" in obstacles[0]
