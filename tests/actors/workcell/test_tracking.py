"""Exact bodies that walk: found again, told apart, predicted; hidden ones come out again."""

import numpy as np
import pytest
from lost_commits import lose_commit
from slots import put

from actors.geometry.people import WALK_M_S, Body, associated, body_of, limbs
from actors.workcell.tracking import GATE_M, HumanTracking, Person, followed, known_people
from actors.workcell.vocabulary import (
    GRID,
    HULL,
    HUMANS,
    LIMBS,
    PREDICTION,
    TRACK,
    WORKSPACE,
    Grid,
    Hull,
    human_entity,
)
from enact_dist import ViewEach, testing

ORIGIN_M, VOXEL_M, SHAPE = np.array([-2.0, -2.0, 0.0]), 0.025, (160, 160, 88)
START_NS, PERIOD_NS = 10**18, 100_000_000
INDEX = np.stack(np.mgrid[: SHAPE[0], : SHAPE[1]], -1).reshape(-1, 2)
MIDDLE = ORIGIN_M[:2] + (INDEX + 0.5) * VOXEL_M
DRAW = np.random.default_rng(1)


def body(centre, height_m=1.7, radius_m=0.15):
    """Return voxels of an upright cylinder whose middle is exactly at `centre`, one array."""
    disc = INDEX[
        np.linalg.norm(MIDDLE - np.round(np.array(centre) / VOXEL_M) * VOXEL_M, axis=1) < radius_m
    ]
    z = np.arange(round(height_m / VOXEL_M))
    return np.concatenate([np.column_stack([disc, np.full(len(disc), k)]) for k in z])


def hull_of(*parts, loose=()):
    """Return a hull whose components are `parts`, all tight, and `loose`, which is not."""
    everything = [*parts, *loose]
    voxels = np.concatenate(everything) if everything else np.empty((0, 3))
    numbers = np.repeat(np.arange(len(everything)), [len(part) for part in everything])
    tight = numbers < len(parts)
    return Hull(
        voxels.astype(np.int16), np.zeros(len(voxels), np.float32), tight,
        numbers.astype(np.int16), {}, (), np.inf, -1,
    )  # fmt: skip


class Cell:
    def __init__(self, cell):
        self.cell, self.online, self.actor = cell, cell.world("online"), HumanTracking()
        self.now_ns = START_NS
        self.online.init(WORKSPACE, GRID, Grid(ORIGIN_M, VOXEL_M, SHAPE))

    def come(self, *parts, loose=()):
        """Let a set come."""
        self.now_ns += PERIOD_NS
        put(self.online, WORKSPACE, HULL, hull_of(*parts, loose=loose), self.now_ns)

    def see(self, *parts, loose=()):
        """Let a set come and be looked at; return the tracks by name."""
        self.come(*parts, loose=loose)
        testing.run_once(self.actor, self.cell)
        return self.each(TRACK)

    def each(self, aspect):
        request = ViewEach(self.online, HUMANS, aspect)
        return {entity.name: datum for entity, datum in self.online.view(request)[request].items()}


@pytest.fixture
def cell():
    with testing.worlds("online") as worlds:
        yield Cell(worlds)


def line(start, end, sets):
    return np.linspace(start, end, sets)


def test_person_is_found_where_they_are(cell):
    """Position, height and volume of an exact body; nobody else."""
    for _ in range(5):
        tracks = cell.see(body((0.5, -0.75)))

    track = tracks["human/0"]
    np.testing.assert_allclose(track.position_m, [0.5, -0.75, 1.7], atol=0.02)
    np.testing.assert_allclose(track.velocity_m_s, 0.0, atol=0.02)
    assert track.volume_m3 == pytest.approx(np.pi * 0.15**2 * 1.7, rel=0.05)
    assert (list(tracks), track.hidden) == (["human/0"], False)
    assert track.first_ns == START_NS + PERIOD_NS


def test_walker_is_tracked_and_predicted(cell):
    """Within half a voxel and a little: 4 cm, 0.1 m/s, and 12 cm half a second ahead."""
    positions, velocities, ahead = [], [], []
    walk = line((-1.4, -1.2), (1.4, -1.0), 30)
    velocity = (walk[1] - walk[0]) / 0.1
    for place in walk:
        tracks = cell.see(body(place))
        prediction = cell.each(PREDICTION)["human/0"]
        track = tracks["human/0"]
        positions.append(np.linalg.norm(track.position_m[:2] - place))
        velocities.append(np.linalg.norm(track.velocity_m_s[:2] - velocity))
        ahead.append(np.linalg.norm(prediction.centre_m[4] - place - 0.5 * velocity))

    assert len(tracks) == 1
    assert np.median(positions) <= 0.02
    assert np.median(velocities[5:]) <= 0.1
    assert np.median(ahead[5:]) <= 0.06
    np.testing.assert_allclose(prediction.at_s, np.arange(1, 11) / 10.0)
    assert prediction.centre_m.shape == (10, 2)
    assert (np.diff(prediction.radius_m) > 0.0).all()
    assert prediction.radius_m[0] >= 0.25


def test_two_people_cross_and_stay_themselves(cell):
    """Where they pass each other they are one component; behind it, each goes on."""
    one, other = line((-1.2, 0.2), (1.2, 0.2), 25), line((1.2, -0.2), (-1.2, -0.2), 25)
    for a, b in zip(one, other, strict=True):
        parts = [body(a), body(b)]
        near = np.linalg.norm(a - b) < 0.6
        tracks = cell.see(np.concatenate(parts)) if near else cell.see(*parts)

    assert sorted(tracks) == ["human/0", "human/1"]
    assert tracks["human/0"].velocity_m_s[0] > 0.5
    assert tracks["human/1"].velocity_m_s[0] < -0.5
    np.testing.assert_allclose(tracks["human/0"].position_m[:2], (1.2, 0.2), atol=0.06)


def test_nearer_of_two_is_nobody_elses(cell):
    """The sum of the distances decides, not who comes first."""
    pairs = associated(
        np.array([[0.0, 0.0], [0.3, 0.0]]),
        np.array([0.5, 0.5]),
        np.array([[0.25, 0.0], [-0.2, 0.0]]),
    )

    assert sorted(pairs) == [(0, 1), (1, 0)]
    assert associated(np.zeros((1, 2)), np.ones(1), np.array([[1.5, 0.0]])) == []


def test_small_and_loose_things_are_nobody(cell):
    """Less than 20 litres, or not in the tight hull: no track."""
    small = body((0.0, 0.0), height_m=0.2)

    assert cell.see(small, loose=[body((1.0, 1.0))]) == {}


def test_hidden_person_is_kept_and_found_again(cell):
    """Gone in the middle of the workspace: hidden, growing; the same track when they come out."""
    for place in line((-1.2, 0.0), (-0.6, 0.0), 8):
        cell.see(body(place))
    sizes = []
    for _ in range(20):
        tracks = cell.see()
        sizes.append(cell.each(PREDICTION)["human/0"].radius_m[0])
    hidden = tracks["human/0"]

    back = cell.see(body((0.8, 0.6)))

    assert hidden.hidden
    assert (np.diff(sizes[:6]) > 0.1).all()
    assert max(sizes) <= 1.5
    np.testing.assert_allclose(hidden.position_m[:2], (-0.6, 0.0), atol=0.12)
    assert cell.each(LIMBS).keys() == {"human/0"}
    assert list(back) == ["human/0"]
    assert not back["human/0"].hidden
    np.testing.assert_allclose(back["human/0"].position_m[:2], (0.8, 0.6), atol=0.1)


def test_brief_sight_is_not_a_person(cell):
    """What two sets show in the middle of the workspace, and no later one, leaves no track.

    The arm does so as the cell starts: the first hull still has it, the later ones do not.
    """
    counts = [len(cell.see(*bodies)) for bodies in ([body((0.4, 0.0))], [body((0.4, 0.0))], [])]

    assert counts == [1, 1, 0]
    assert [cell.each(aspect) for aspect in (LIMBS, PREDICTION)] == [{}, {}]


def test_what_is_left_is_foreign_once_it_is_still(cell):
    """Low and in one place for three seconds: foreign.  A person who stands there is not."""
    marks = [
        {name: track.foreign for name, track in tracks.items()}
        for tracks in (
            cell.see(body((0.6, 0.6), height_m=0.4), body((-0.6, 0.0))) for _ in range(32)
        )
    ]
    moved = cell.see(body((0.7, 0.6), height_m=0.4), body((-0.6, 0.0)))

    low = max(marks[-1], key=lambda name: marks[-1][name])
    assert sorted(marks[29].values()) == [False, False]
    assert sorted(marks[30].values()) == [False, True]
    assert sorted(moved) == ["human/0", "human/1"]
    assert not moved[low].foreign


def test_person_who_leaves_is_gone(cell):
    """At a side of the workspace the track ends with all that was known; a new one is new."""
    for place in line((1.0, 0.0), (1.85, 0.0), 9):
        cell.see(body(place))
    gone = cell.see()
    left = [cell.each(aspect) for aspect in (LIMBS, PREDICTION)]

    again = cell.see(body((1.5, 0.0)))

    assert gone == {}
    assert left == [{}, {}]
    assert list(again) == ["human/1"]


def test_hiding_ends(cell):
    """A track that was hidden for longer than allowed ends."""
    cell.actor.hidden_s_max = 0.5
    for _ in range(5):
        cell.see(body((0.0, 0.0)))

    counts = [len(cell.see()) for _ in range(9)]

    assert counts[0] == 1
    assert counts[-1] == 0


def test_restarted_tracking_goes_on(cell):
    """Another process finds the tracks in the world context."""
    for place in line((-1.2, 0.0), (-0.8, 0.0), 5):
        cell.see(body(place))
    cell.actor = HumanTracking()

    tracks = cell.see(body((-0.7, 0.0)))

    assert list(tracks) == ["human/0"]
    assert tracks["human/0"].first_ns == START_NS + PERIOD_NS
    assert human_entity(0).name in tracks


def test_tracking_goes_on_when_the_clock_of_the_cameras_was_set_back(cell):
    """A clock an hour ahead is corrected: the same person is followed, and can be lost again."""
    cell.now_ns += 3600 * 10**9
    for _ in range(5):
        cell.see(body((0.5, -0.75)))
    cell.now_ns = START_NS
    for place in line((0.5, -0.75), (0.9, -0.75), 5):
        tracks = cell.see(body(place))

    track = tracks["human/0"]
    np.testing.assert_allclose(track.position_m[:2], [0.9, -0.75], atol=0.05)
    assert (list(tracks), track.first_ns) == (["human/0"], START_NS + PERIOD_NS)


def test_limbs_of_a_cross_are_its_arms():
    """A trunk with two stretched arms: an end of a capsule at each hand, head and foot."""
    t = np.linspace(0.0, 1.0, 120)[:, None]
    shake = DRAW.normal(0.0, 0.03, (120, 3))
    trunk = np.array([0.0, 0.0, 0.0]) + t * [0.0, 0.0, 1.8] + shake
    arms = np.array([-0.8, 0.0, 1.4]) + t * [1.6, 0.0, 0.0] + shake
    points = np.concatenate([trunk, arms])

    capsules = limbs(points)

    assert capsules.dtype == np.float32
    assert capsules.shape[1] == 7
    ends = capsules[:, :6].reshape(-1, 3)
    for tip in ([-0.8, 0, 1.4], [0.8, 0, 1.4], [0, 0, 0], [0, 0, 1.8]):
        assert np.linalg.norm(ends - tip, axis=1).min() < 0.25
    assert limbs(np.empty((0, 3))).shape == (0, 7)


def test_body_is_measured_exactly():
    """Middle, top, volume and radius of a box of voxels."""
    grid = np.stack(np.mgrid[:10, :10, :20], -1).reshape(-1, 3) * 0.1 + 0.05

    seen = body_of(grid, 0.1)

    np.testing.assert_allclose(seen.centre_m, [0.5, 0.5])
    assert seen.top_m == pytest.approx(2.0)
    assert seen.volume_m3 == pytest.approx(2.0)
    assert 0.5 < seen.radius_m < 0.71


GRID_OF_CELL = Grid(ORIGIN_M, VOXEL_M, SHAPE)


def someone(x_m=0.0, *, top_m=1.7, seen_s=1.0, now_ns=START_NS):
    """A person who has been seen for a while, and the body."""
    at = Body(np.zeros((1, 3)), np.array([x_m, 0.0]), top_m, 0.06, 0.2)
    person = Person.new(at, now_ns - round(seen_s * 1e9))
    return person.seen(person.moved(0.0), at, now_ns), at


@pytest.mark.parametrize(
    ("x_m", "seen_s", "kept"), [(0.0, 1.0, True), (1.7, 1.0, False), (0.0, 0.1, False)]
)
def test_who_is_lost_is_hidden_unless_at_a_side_or_seen_too_briefly(x_m, seen_s, kept):
    """The middle hides, a side lets leave, and an arm of a moment is nobody."""
    person, _ = someone(x_m, seen_s=seen_s)
    lost = person.lost(person.moved(0.1), GRID_OF_CELL, START_NS, 300.0)
    assert (lost is not None) == kept
    assert lost is None or lost.track.hidden


def test_who_is_hidden_may_be_farther_away_every_second_and_is_given_up_at_last():
    """The gate grows as fast as a person walks; the prediction around the last place, too."""
    person, _ = someone()
    begin_ns = START_NS + PERIOD_NS
    hidden = person.lost(person.moved(0.1), GRID_OF_CELL, begin_ns, 5.0)
    later_ns = begin_ns + 10**9
    state, covariance = hidden.moved(1.0)
    assert state[:2] == pytest.approx(person.track.position_m[:2])
    gates = [hidden.gate_m(covariance, now_ns) for now_ns in (begin_ns, later_ns)]
    assert gates == pytest.approx([GATE_M, GATE_M + WALK_M_S])
    radii = [hidden.prediction(None, now_ns).radius_m[0] for now_ns in (begin_ns, later_ns)]
    assert radii == pytest.approx([0.25 + 0.1 * WALK_M_S, 1.5])
    kept = hidden.lost((state, covariance), GRID_OF_CELL, later_ns, 5.0)
    assert (kept.hidden_s(later_ns), kept.track.seen_ns) == (1.0, START_NS)
    end_ns = begin_ns + 5 * 10**9 + 1
    assert hidden.lost((state, covariance), GRID_OF_CELL, end_ns, 5.0) is None


@pytest.mark.parametrize(
    ("top_m", "move_m", "foreign"), [(0.4, 0.0, True), (0.4, 0.06, False), (1.7, 0.0, False)]
)
def test_what_is_low_and_still_is_foreign(top_m, move_m, foreign):
    """A move of more than 5 cm starts the three seconds again."""
    person, at = someone(top_m=top_m, seen_s=0.0)
    at = Body(at.points_m, np.array([move_m, 0.0]), top_m, 0.06, 0.2)
    for second in (1, 2, 3):
        person = person.seen(person.moved(1.0), at, START_NS + second * 10**9)
    assert person.track.foreign is foreign


def test_a_restart_knows_since_when_someone_is_hidden():
    """Their track tells; if the clock of the cameras was set back, they were seen just now."""
    person, _ = someone()
    hidden = person.lost(person.moved(0.1), GRID_OF_CELL, START_NS + PERIOD_NS, 300.0)
    name, later_ns = human_entity(3), START_NS + PERIOD_NS + 10**9
    assert known_people({name: hidden.track}, {}, later_ns)[name].hidden_s(later_ns) == 1.0
    assert known_people({name: person.track}, {}, later_ns)[name].hidden_s(later_ns) == 0.0
    before_ns = START_NS - 3600 * 10**9
    assert known_people({name: hidden.track}, {}, before_ns)[name].track.seen_ns == before_ns


def test_a_set_is_done_again_if_its_commit_fails(cell):
    """Someone walks a step further in it, and their speed is that of one step, as if at once."""
    for place in line((-1.2, 0.0), (-0.4, 0.0), 9):
        cell.see(body(place))
    cell.come(body((-0.3, 0.0)))
    lose_commit(cell.actor, cell.cell)
    testing.run_once(cell.actor, cell.cell)
    track = cell.each(TRACK)["human/0"]
    assert track.seen_ns == cell.now_ns
    np.testing.assert_allclose(track.position_m[:2], [-0.3, 0.0], atol=0.04)
    assert track.velocity_m_s[0] == pytest.approx(1.0, abs=0.15)


def test_who_comes_out_in_a_set_whose_commit_fails_is_found_in_the_next_one(cell):
    """They were hidden for a second all the same, and so may be farther away than a step."""
    for _ in range(5):
        cell.see(body((0.0, 0.0)))
    for _ in range(11):
        cell.see()
    cell.come(body((1.1, 0.0)))
    lose_commit(cell.actor, cell.cell)
    assert list(cell.see(body((1.2, 0.0)))) == ["human/0"]


def test_bodies_that_are_nobodys_are_new_people():
    """The known one keeps their entity; the others take the next free numbers."""
    person, _ = someone(-0.6)
    known = {human_entity(2): person}
    people, seen = followed(
        known, hull_of(body((-0.6, 0.0)), body((0.6, 0.5)), body((0.6, -0.5))), GRID_OF_CELL,
        seconds=0.1, now_ns=START_NS, free=5, hidden_s_max=300.0,
    )  # fmt: skip
    assert list(people) == list(seen) == [human_entity(number) for number in (2, 5, 6)]
    assert people[human_entity(2)].track.first_ns == person.track.first_ns
