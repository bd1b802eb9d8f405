"""Claims about the pictures: what changed is coloured, gaps stay gaps, empty data are drawn."""

import numpy as np

from actors.workcell import vocabulary as words
from actors.workcell.scores import figures, plots
from actors.workcell.scores.figures import CHANGED, SAME, masks_figure, scene_picture, voxel_points
from actors.workcell.scores.truth_of_run import truth_of
from actors.workcell.vocabulary import LIMBS, SILHOUETTE, TRACK, Grid, Silhouette, Track

from .runs import Run

GRID = Grid(np.zeros(3), 0.1, (8, 8, 8))


def mask(rows: slice) -> Silhouette:
    """Return a silhouette of whole rows."""
    picture = np.zeros((16, 16), np.bool_)
    picture[rows] = True
    return Silhouette(np.packbits(picture, axis=1), int(picture.sum()))


def test_only_changed_pixels_are_coloured() -> None:
    """Rows that were there before and after have the colour of what stayed."""
    picture = masks_figure({"camera/0": mask(slice(0, 8))}, {"camera/0": mask(slice(4, 12))})
    counts = {
        name: int((picture == colour).all(-1).sum())
        for name, colour in (("changed", CHANGED), ("same", SAME))
    }
    assert counts == {"changed": 16, "same": 16}  # two of four rows of eight, at half the size


def test_inner_faces_of_voxels_are_not_drawn() -> None:
    """A cube of 27 voxels has 54 points, all of them on its surface."""
    cube = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(-1, 3)
    points, colours, _ = voxel_points(GRID, cube, np.array([200, 100, 50]))
    assert len(points) == len(colours) == 6 * 9
    assert np.allclose(np.abs(points - 0.15).max(1), 0.15)


def test_nothing_occupied_is_drawn_as_nothing() -> None:
    """An empty set of voxels does not fail; the picture has its size."""
    nothing = voxel_points(GRID, np.empty((0, 3), np.int16), np.array(SAME))
    floor = voxel_points(GRID, np.array([[0, 0, 0]]), np.array(SAME))
    assert scene_picture([floor, nothing], size_px=(64, 48)).shape == (48, 64, 3)


def test_the_part_of_each_rule_is_within_the_picture(monkeypatch) -> None:
    """A caption with all of them ran out of it."""
    drawn, draw = [], figures.with_label

    def noting(picture, text, at_px, **given):
        drawn.append(text)
        return draw(picture, text, at_px, **given)

    monkeypatch.setattr(figures, "with_label", noting)
    voxels = np.array([[1, 1, 1]], np.int16)
    counts = dict.fromkeys(("raw", "static", "unreachable", "robot", "distant"), 2000000)
    flags = np.ones(1, np.bool_), np.zeros(1, np.int16)
    hull = words.Hull(voxels, np.full(1, 0.1, np.float32), *flags, counts, (), 0.1, 0)

    figures.hull_figure(GRID, np.empty((0, 15)), np.empty((0, 7)), (voxels, hull), None)

    assert drawn == [f"2,000,000 {rule}" for rule in counts if rule != "raw"]


def test_the_way_of_a_person_does_not_begin_with_somebody_elses() -> None:
    """A name is given again when a track has ended."""
    run = Run("S1", 4.0)
    run.rest()
    run.hull(30)
    for at_m, first, ticks in ((-2.2, 0, range(3)), (2.2, 20, range(20, 31))):
        for tick in ticks:
            there = np.array([at_m, 0.1 * (tick - first), 1.7])
            track = Track(there, np.zeros(3), np.eye(6), 1.7, 0.07, first, hidden=False)
            run.add("human/0", TRACK, track, tick)
    trace, stamp_ns = run.trace(), run.trace().of(words.WORKSPACE.name, words.HULL)[-1].stamp_ns
    hull = trace.newest(words.WORKSPACE.name, words.HULL)

    picture = plots.plan_figure(trace, truth_of(trace), hull, stamp_ns)

    blue = (picture == plots.TRACK).all(-1)[:-60]
    assert blue[:, -200:].any()
    assert not blue[:, : plots.PLAN_PX // 2].any()


def test_seconds_do_not_run_into_the_legend() -> None:
    """Between the figures along the time and the names of the curves is a free row."""
    line = plots.Line("speed", np.arange(6.0), np.full(6, np.nan), (255, 0, 0))
    picture = plots.timeline([("speed, m/s", 2.0, [line])])
    legend = int(np.flatnonzero((picture == (255, 0, 0)).all(-1).any(1))[0])
    ink = (picture[:, 100:] < 200).all(-1).any(1)  # right of the legend and of the values
    assert ink[: legend - 5].any()
    assert not ink[legend - 5 :].any()


def test_who_has_left_is_in_no_picture_of_later(monkeypatch):
    """Neither limbs nor properties: a recording has no word that a person went."""
    run, shown = Run("S1", 4.0), []
    run.rest()
    run.hull(30)
    run.add("camera/0", SILHOUETTE, Silhouette(np.zeros((480, 80), np.uint8), 0), 30)
    for person, tick in (("human/0", 3), ("human/1", 30)):
        track = Track(np.array([1.0, 1.0, 1.7]), np.zeros(3), np.eye(6), 1.7, 0.07, 0, hidden=False)
        run.add(person, TRACK, track, tick)
        run.add(person, LIMBS, np.ones((1, 7), np.float32), tick)
    monkeypatch.setattr(
        figures,
        "world_figure",
        lambda *given: shown.append(given) or np.zeros((4, 4, 3), "u1"),
    )

    pictures = figures.pictures_of(run.trace(), 0)

    assert len(pictures) == 5
    *_, limbs, lines = shown[0]
    assert len(limbs) == 1
    assert [line[:8] for line in lines if line.startswith("human")] == ["human/1:"]


def test_a_value_that_is_not_known_is_a_gap() -> None:
    """Two of six values that are infinite take away over 30 % of the curve's pixels."""

    def drawn(values: np.ndarray) -> int:
        line = plots.Line("speed", np.arange(6.0), values, (255, 0, 0))
        picture = plots.timeline([("speed, m/s", 2.0, [line])], size_px=(300, 120))
        return int((picture[30:80] == (255, 0, 0)).all(-1).sum())

    whole, gap = np.ones(6), np.ones(6)
    gap[2:4] = np.inf
    assert 0 < drawn(gap) < 0.7 * drawn(whole)
