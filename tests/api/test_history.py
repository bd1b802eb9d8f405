"""The versions of a datum that are still known, and those that labels keep."""

import time

import numpy as np
import pytest
from counted import COUNT, put

from enact_dist import Aspect, Durability, Entity, Lock, Write
from enact_dist.errors import ForgottenError, MisuseError, NullDatumError, UnknownWorldError

pytestmark = pytest.mark.carrier("local", "drawn")

CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE)
FLEETING = Aspect("fleeting", int, Durability.VOLATILE, retention=2)
ARM, LEG = Entity("arm"), Entity("leg")
LEFT, RIGHT = Entity("left/arm"), Entity("right/arm")


def test_history_lists_versions_oldest_first_with_where_they_stand(online):
    """Each says when it came, when it went, who made it; its datum is fetched when asked."""
    positions = [put(online, ARM, 10 * number, stamp_ns=number + 1) for number in range(3)]

    versions = online.history(ARM, COUNT)

    assert [version.version for version in versions] == [1, 2, 3]
    assert [version.position for version in versions] == positions
    ends = [position.stamp_ns for position in positions[1:]]
    assert [version.until_ns for version in versions] == [*ends, 0]
    assert [version.stamp_ns for version in versions] == [1, 2, 3]
    assert [version.datum() for version in versions] == [0, 10, 20]
    assert all(version.cause is not None and version.cause.actor for version in versions)
    assert (versions[0].world, versions[0].entity, versions[0].aspect) == (online, ARM, COUNT)


def test_history_is_limited_by_count_and_time(online):
    """The newest few, or what was current after a moment, the one current at it included."""
    positions = [put(online, ARM, number) for number in range(5)]

    assert [v.version for v in online.history(ARM, COUNT, count=2)] == [4, 5]
    assert [v.version for v in online.history(ARM, COUNT, since=positions[2])] == [3, 4, 5]
    for wrong in (0, -1, True, 1.5):
        with pytest.raises(MisuseError, match=r"count is"):
            online.history(ARM, COUNT, count=wrong)
    with pytest.raises(MisuseError, match=r"in the future"):
        online.history(ARM, COUNT, since=time.time() + 600.0)


def test_deleted_state_is_a_version(online):
    """It has no datum, and says why."""
    put(online, ARM, 1)
    request = Write(online, ARM, COUNT)
    with Lock(request) as lock:
        del lock[request]

    versions = online.history(ARM, COUNT)

    assert [version.null_reason for version in versions] == ["", "deleted"]
    with pytest.raises(NullDatumError, match=r"deleted"):
        versions[1].datum()


def test_large_datum_of_a_version_is_its_own(online):
    """Whatever was written since."""
    clouds = [np.full(40_000, number, np.float64) for number in range(3)]
    for cloud in clouds:
        put(online, ARM, cloud, CLOUD)

    versions = online.history(ARM, CLOUD)

    assert [version.size_bytes for version in versions] == [320_000] * 3
    for version, cloud in zip(versions, clouds, strict=True):
        assert np.array_equal(version.datum(), cloud)


def test_nothing_is_known_of_what_was_never_set(online):
    """An empty history is no error where the context exists."""
    assert online.history(ARM, Aspect("never", int)) == ()


def test_history_of_a_dropped_context_is_gone(cell, online):
    """Its versions do not come back under another one's number."""
    what_if = online.fork("what_if")
    put(what_if, ARM, 1)
    (version,) = what_if.history(ARM, COUNT)
    cell.drop_world("what_if")

    with pytest.raises(UnknownWorldError, match=r"what_if"):
        what_if.history(ARM, COUNT)
    with pytest.raises(UnknownWorldError, match=r"what_if"):
        version.datum()
    put(cell.create_world("what_if"), ARM, 2)
    with pytest.raises(ForgottenError):
        version.datum()


def test_history_of_a_fork_begins_with_what_it_was_forked_from(online):
    """Its first version is caused by the fork."""
    put(online, ARM, 1)
    what_if = online.fork("what_if")
    put(what_if, ARM, 2)

    versions = what_if.history(ARM, COUNT)

    assert [version.cause.kind for version in versions] == ["fork", "commit"]
    assert [version.datum() for version in versions] == [1, 2]


def test_datum_without_its_type_is_readable(online):
    """As `raw` gives it."""
    put(online, ARM, 1)

    (version,) = online.history(ARM, Aspect("count", object))

    assert version.datum() == 1


# ---------------------------------------------------------------- kept


def test_kept_version_outlives_its_retention(cell, online, loose):
    """It is listed, readable and named under its label; let go of, it is forgotten."""
    put(online, ARM, 1, FLEETING)
    (first,) = online.history(ARM, FLEETING)
    cell.pin("drop-17", [first])
    for number in range(2, 6):
        put(online, ARM, number, FLEETING)
    loose.end()
    put(online, ARM, 6, FLEETING)

    versions = online.history(ARM, FLEETING)
    assert [version.version for version in versions] == [1, 5, 6]
    assert [version.pinned for version in versions] == [("drop-17",), (), ()]
    assert first.datum() == 1
    kept = cell.pinned()
    assert [(version.slot, version.datum()) for version in kept["drop-17"]] == [(first.slot, 1)]

    cell.unpin("drop-17")

    assert cell.pinned() == {}
    with pytest.raises(ForgottenError):
        first.datum()
    with pytest.raises(
        ForgottenError, match=r"1 of the versions to pin under 'again' had already left"
    ):
        cell.pin("again", [first])


def test_labels_are_added_to_and_checked(cell, online):
    """A label collects; what is no label or no version is refused."""
    put(online, ARM, 1)
    put(online, LEG, 2)
    cell.pin("both", online.history(ARM, COUNT))

    cell.pin("both", online.history(LEG, COUNT))

    assert [version.entity for version in cell.pinned()["both"]] == [ARM, LEG]
    for label, versions, told in (
        ("a b", online.history(ARM, COUNT), r"cannot name a label"),
        ("empty", [], r"nothing to pin under 'empty'"),
        ("wrong", [1], r"1 is no version"),
    ):
        with pytest.raises(MisuseError, match=told):
            cell.pin(label, versions)
    cell.unpin("nobody-has-used-this")


def test_old_names_of_pins_warn_and_work(cell, online):
    """They go with the next release."""
    online.init(ARM, COUNT, 1)
    with pytest.warns(DeprecationWarning, match=r"Cell\.keep is now Cell\.pin"):
        cell.keep("old", online.history(ARM, COUNT))
    with pytest.warns(DeprecationWarning, match=r"Cell\.kept is now Cell\.pinned"):
        assert list(cell.kept()) == ["old"]
    with pytest.warns(DeprecationWarning, match=r"Cell\.let_go is now Cell\.unpin"):
        cell.let_go("old")
    assert cell.pinned() == {}


def test_other_former_names_warn_and_work(cell, online):
    """Of contexts, versions and cells; what never was a name is no attribute."""
    online.init(ARM, COUNT, 1)
    with pytest.warns(DeprecationWarning, match=r"WorldContext\.raw is now .*get_untyped"):
        assert online.raw(ARM, "count") == 1
    with pytest.warns(DeprecationWarning, match=r"WorldContext\.survey is now .*list_slots"):
        assert online.survey() == online.list_slots()
    (version,) = online.history(ARM, COUNT)
    with pytest.warns(DeprecationWarning, match=r"Version\.kept is now Version\.pinned"):
        assert version.kept == ()
    with pytest.warns(DeprecationWarning, match=r"Cell\.aspect_infos is now Cell\.aspects"):
        assert cell.aspect_infos("online") == cell.aspects("online")
    for one in (cell, online, version):
        with pytest.raises(AttributeError, match="no attribute 'colour'"):
            one.colour  # noqa: B018


def test_versions_of_several_shards_are_kept_under_one_label(two_stored):
    """And outlive a restart of their shard."""
    cell, online = two_stored.cell, two_stored.cell.world("online")
    put(online, LEFT, 1)
    put(online, RIGHT, 2)
    cell.pin("both", [*online.history(LEFT, COUNT), *online.history(RIGHT, COUNT)])

    two_stored.stop("right")
    two_stored.start("right")

    kept = cell.pinned()["both"]
    assert [(version.entity, version.datum()) for version in kept] == [(LEFT, 1), (RIGHT, 2)]
    cell.unpin("both")
    assert cell.pinned() == {}


def test_history_beyond_one_answer_comes_in_several(cell, online, monkeypatch):
    """Nothing of it is left out silently, the newest versions least of all."""
    for number in range(12):
        put(online, ARM, number)
        put(online, LEG, number)
    cell.pin("label", online.history(ARM, COUNT)[:7])
    cell.pin("label", online.history(LEG, COUNT)[2:8])
    monkeypatch.setattr("enact_dist.core.protocol.pages.PAGE_BYTES_MAX", 2_000)

    versions = online.history(ARM, COUNT)

    assert [version.version for version in versions] == list(range(1, 13))
    assert [version.datum() for version in versions] == list(range(12))
    assert [v.version for v in online.history(ARM, COUNT, count=10)] == list(range(3, 13))
    since = versions[5].position
    assert [v.version for v in online.history(ARM, COUNT, since=since)] == list(range(6, 13))
    kept = cell.pinned()["label"]
    assert [(v.entity, v.version) for v in kept] == [
        *((ARM, version) for version in range(1, 8)),
        *((LEG, version) for version in range(3, 9)),
    ]
