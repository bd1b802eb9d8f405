"""A folder of calibrated pictures to its hull: what holds for any data, and what is refused."""

import json
import shutil

import cv2
import numpy as np
import pytest

from actors.geometry.cameras.camera_sets import SetCamera
from actors.geometry.hull.space_carving import (
    Carver,
    found_bounds,
    grid_of,
    in_front,
    intersection_over_union,
    nearest_to_axes,
)
from actors.geometry.hull.voxel_surface import surface_of, voxel_surface
from actors.workcell.folders.pictures import colour_of
from actors.workcell.folders.run import FolderOptions, run_folder
from enact_dist.cli.main import main

from . import turntable

RING = turntable.ring()
MASKS = [turntable.mask_of(one) for one in RING]


@pytest.fixture(scope="module")
def carver():
    return Carver(RING, MASKS)


@pytest.fixture(scope="module")
def box(carver):
    return found_bounds(carver)


@pytest.fixture
def folder(tmp_path):
    """Masks of eight cameras and their calibration."""
    place = tmp_path / "set"
    place.mkdir()
    write(place, "masks/{}.png")
    turntable.write_json(place, RING)
    return place


def write(place, name, picture=lambda mask: mask.astype(np.uint8) * 255, cameras=RING):
    for one, mask in zip(cameras, MASKS, strict=False):
        file = place / name.format(one.name)
        file.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(file), picture(mask))


def run(folder, capsys, **options):
    """Return exit status, report (None where refused) and the error stream."""
    out = folder.parent / "out"
    shutil.rmtree(out, ignore_errors=True)
    status = run_folder(folder, out, FolderOptions(**({"grid": 48} | options)))
    err = capsys.readouterr().err
    report = out / "report.json"
    return status, json.loads(report.read_text()) if report.exists() else None, err


# ---------------------------------------------------------------- what holds for any data


def test_hull_of_fewer_cameras_contains_the_hull_of_all(carver, box):
    """In whatever order they are asked; a voxel that somebody denied was not there."""
    grid = grid_of(*box, 48)
    every = carver.carve(grid, seen_least=0)
    for chosen in ([0, 2, 5, 7], [7, 6, 5, 4, 3, 2, 1, 0], [3]):
        part = Carver([RING[at] for at in chosen], [MASKS[at] for at in chosen])
        some = part.carve(grid, seen_least=0)
        assert np.isin(every.rows, some.rows).all()
        assert np.isin(every.tight_rows, some.tight_rows).all()
        if len(chosen) == len(RING):
            assert np.array_equal(some.rows, every.rows)
    without = Carver(RING[1:], MASKS[1:]).carve(grid, seen_least=0)
    assert np.array_equal(np.sort(every.without(0)), without.rows)


def test_looking_at_blocks_first_changes_nothing(carver, box, monkeypatch):
    """But the time."""
    grid = grid_of(*box, 64)
    quick = carver.carve(grid)
    monkeypatch.setattr("actors.geometry.hull.space_carving.WHOLE_MAX", 1 << 60)
    slow = carver.carve(grid)
    assert np.array_equal(quick.rows, slow.rows)
    assert np.array_equal(quick.tight_rows, slow.tight_rows)


def test_outline_of_the_hull_covers_each_mask(carver, box):
    """A voxel goes only where nothing of it meets foreground, so nothing of a mask is lost."""
    grid = grid_of(*box, 48)
    rows = carver.carve(grid).rows
    for number, mask in enumerate(MASKS):
        assert carver.outline(number, grid, rows, grown=True)[mask].all()


def test_volume_falls_when_the_grid_gets_finer(carver, box):
    """Down to that of the thing and what no camera can tell from it."""
    volumes = []
    for count in (16, 32, 64):
        grid = grid_of(*box, count)
        volumes.append(1e3 * grid.voxel_m**3 * len(carver.carve(grid).rows))
    assert volumes == sorted(volumes, reverse=True)
    assert volumes[-1] > turntable.volume_l()


def test_cameras_all_around_look_at_the_same_place():
    """The middle is the point that is nearest to their axes; a camera turned away sees it behind."""
    assert np.allclose(nearest_to_axes(RING), (0.0, 0.0, 0.15), atol=1e-9)
    assert in_front(RING, np.array((0.0, 0.0, 0.15))) == 1.0
    assert in_front([RING[0], RING[1].flipped()], np.array((0.0, 0.0, 0.15))) == 0.5


def test_outlines_of_bent_lenses_agree():
    """Distortion acts when a voxel is projected, no picture is straightened."""
    aside = {"at_m": (0.25, 0.0, 0.3)}
    cameras = turntable.ring(6, distortion=(-0.4, 0.15, 2e-3, -2e-3, 0.0), **aside)
    masks = [turntable.mask_of(one) for one in cameras]
    bent, straight = Carver(cameras, masks), Carver(turntable.ring(6, **aside), masks)
    grid = grid_of((-0.2, -0.3, -0.05), (0.3, 0.3, 0.4), 64)
    right, wrong = (
        np.mean(one.agreement(grid, one.carve(grid).tight_rows)) for one in (bent, straight)
    )
    assert right > wrong + 0.01


# ---------------------------------------------------------------- the surface


def enclosed(vertices, triangles):
    corners = vertices[triangles]
    return np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0


def test_surface_is_closed_with_its_front_outside():
    """Each edge belongs to as many triangles one way as the other way; a ball has its volume."""
    at = np.indices((24, 24, 24)) - 11.5
    ball = np.sqrt((at**2).sum(0)) < 9.0
    ball[0, 0, 0] = True  # a voxel at the side of the grid
    vertices, triangles = voxel_surface(ball, np.array((1.0, 2.0, 3.0)), 0.1)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    forth = {tuple(edge): 0 for edge in edges.tolist()}
    for edge in edges.tolist():
        forth[tuple(edge)] += 1
    assert all(forth.get((b, a), 0) == count for (a, b), count in forth.items())
    assert np.isclose(enclosed(vertices, triangles), ball.sum() * 1e-3, rtol=0.06)
    assert (vertices > (0.9, 1.9, 2.9)).all()
    assert (vertices < (3.5, 4.5, 5.5)).all()


def test_surface_of_nothing_is_empty():
    """No vertex, no triangle."""
    vertices, triangles = voxel_surface(np.zeros((4, 4, 4), bool), np.zeros(3), 1.0)
    assert (vertices.shape, triangles.shape) == ((0, 3), (0, 3))


def test_surface_of_the_hull_lies_on_the_thing(carver, box):
    """Of the vertices that touch the larger ball, each is within two voxels of it."""
    grid = grid_of(*box, 96)
    vertices, triangles = surface_of(grid, carver.carve(grid).tight_rows)
    centre, radius = turntable.BALLS[1]
    away = np.linalg.norm(vertices - centre, axis=1) - radius
    assert np.count_nonzero(np.abs(away) < 2 * grid.voxel_m) > 100
    assert away.min() > -2 * grid.voxel_m
    assert 0.95 < 1e3 * enclosed(vertices, triangles) / turntable.volume_l() < 1.2


# ---------------------------------------------------------------- whole folders


WAYS = ["masks", "frames", "flat", "background", "key", "parameters", "opaque", "jpeg"]


@pytest.mark.parametrize("kind", WAYS)
def test_each_way_to_lay_out_a_folder_gives_the_same_hull(tmp_path, capsys, kind):
    """Masks, frames, a flat list, backgrounds or a key colour; outlines agree with the masks."""
    place = tmp_path / "set"
    place.mkdir()
    scene = np.random.default_rng(1).integers(60, 120, (*MASKS[0].shape, 3), np.uint8)
    scene = cv2.GaussianBlur(scene, (0, 0), 3.0)

    def coloured(mask):
        return np.where(mask[..., None], np.uint8((30, 40, 220)), scene)

    options = {}
    if kind == "parameters":
        turntable.write_parameters(place, RING)
        write(place, "{}.png", lambda mask: np.uint8(((0, 0, 0), (200, 200, 200)))[mask * 1])
        options["key"] = colour_of("black")
    else:
        turntable.write_json(place, RING, size=kind != "flat")
    if kind in ("masks", "flat"):
        write(place, "masks/{}.png" if kind == "masks" else "masks/{}.pgm")
    if kind == "opaque":  # red, green, blue and an alpha that hides nothing
        write(
            place, "masks/{}.png", lambda m: np.dstack([*[m * 255] * 3, m * 0 + 255]).astype("u1")
        )
    if kind == "jpeg":
        write(place, "masks/{}.jpg")
    if kind == "frames":
        for frame in ("a", "b"):
            write(place, f"masks/{{}}/{frame}.png")
        write(place, "images/{}/b.png", coloured)
        (place / "masks" / "3" / "a.png").unlink()
    if kind == "background":
        write(place, "images/{}/0.png", coloured)
        write(place, "background/{}.png", lambda _: scene)
    if kind == "key":
        write(place, "images/{}.png", lambda m: np.uint8(((64, 177, 0), (30, 40, 220)))[m * 1])
        options["key"] = colour_of("green")

    status, report, err = run(place, capsys, **options)

    assert (status, err) == (0, "")
    assert report["iou_mean"] > 0.93
    assert len(report["iou"]) == len(RING)
    assert 0.95 < report["volume_l"] / turntable.volume_l() < 1.25
    assert report["centre_in_front"] == 1.0
    assert report["suspicious"] == ""
    assert report["made_by"] == "BackgroundSubtraction and Reconstruction"
    assert report["frame"] == {"frames": "b", "background": "0"}.get(kind, "")
    out = place.parent / "out"
    assert {file.name for file in out.iterdir()} >= {"hull.ply", "report.json"}
    pictures = [cv2.imread(str(file)) for file in out.glob("camera_*.png")]
    assert [picture.shape for picture in pictures] == [(240, 320, 3)] * len(RING)
    assert all((picture == (40, 61, 226)).all(axis=2).any() for picture in pictures)


def test_bounds_of_the_folder_are_taken_in_the_unit_of_the_calibration(folder, capsys):
    """Here millimetres."""
    turntable.write_json(folder, RING, unit="mm", scale=1000.0)
    bounds = {"low": [-300, -300, -50], "high": [300, 300, 450]}
    (folder / "bounds.json").write_text(json.dumps(bounds))
    _, report, _ = run(folder, capsys)
    assert np.allclose(report["low_m"][:2], (-0.3, -0.3), atol=0.05)
    assert report["high_m"][2] - report["low_m"][2] < 0.65


def test_camera_that_is_off_is_named(folder, capsys):
    """One pose is turned by two degrees: without it the others agree better."""
    off = turntable.camera("5", RING[5].centre_m, at_m=(0.03, 0.0, 0.17))
    turntable.write_json(folder, [*RING[:5], off, *RING[6:]])
    status, report, _ = run(folder, capsys)
    assert status == 0
    assert report["suspicious"] == "5"


def turned(way):
    return lambda folder: turntable.write_json(folder, [getattr(one, way)() for one in RING])


def mirror(folder):
    write(folder, "masks/{}.png", lambda mask: mask[:, ::-1].astype(np.uint8) * 255)


def replaced(name, content):
    return lambda folder: (folder / name).write_bytes(content)


def resized(folder):
    cv2.imwrite(str(folder / "masks" / "2.png"), np.full((24, 32), 255, np.uint8))


def blank(folder):
    cv2.imwrite(str(folder / "masks" / "2.png"), np.zeros((240, 320), np.uint8))


def apart(folder):
    places = [np.array((50.0 * at, 0.0, 0.0)) for at in range(len(RING))]
    far = [
        turntable.camera(one.name, one.centre_m + place, at_m=place + np.array((0.0, 9.0, 0.0)))
        for place, one in zip(places, RING, strict=True)
    ]
    turntable.write_json(folder, far)


WRONG = {
    "inverted poses": (turned("turned_round"), {}, "with all poses inverted"),
    "computer graphics": (turned("flipped"), {}, "with y up and z back"),
    "mirrored masks": (mirror, {}, "with the pictures mirrored left to right"),
    "no overlap": (apart, {}, "an empty hull"),
    "no picture": (lambda folder: shutil.rmtree(folder / "masks"), {}, "two cameras or more"),
    "broken picture": (replaced("masks/2.png", b"text"), {}, "masks/2.png: asked for a picture"),
    "another size": (resized, {}, "asked for 320 x 240 pixels"),
    "nothing in it": (blank, {}, "0% of it (masks)"),
    "no such frame": (lambda _: None, {"frame": "7"}, "asked for frame 7"),
    "no background": (
        lambda folder: (folder / "masks").rename(folder / "images"), {}, "a mask or a background",
    ),
    "wrong bounds": (replaced("bounds.json", b'{"low": [1, 1, 1]}'), {}, "bounds.json: asked for"),
    "no box": (
        replaced("bounds.json", b'{"low": [1, 1, 1], "high": [0, 2, 2]}'), {},
        "low corner below its high one, found [1.0, 1.0, 1.0] to [0.0, 2.0, 2.0]",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_one_line_and_nothing_is_written(folder, capsys, name):
    """With the file, what was asked and what was found."""
    spoil, options, said = WRONG[name]
    spoil(folder)

    status, report, err = run(folder, capsys, **options)

    assert (status, report) == (1, None)
    assert said in err
    assert err.count("\n") == 1
    assert not (folder.parent / "out").exists()


def test_actors_that_make_no_hull_are_one_line(folder, capsys, monkeypatch):
    """Here what the cameras saw never reaches them."""
    monkeypatch.setattr("actors.workcell.folders.cell._write", lambda *_: None)
    monkeypatch.setattr("actors.workcell.folders.cell.HULL_S", 0.1)
    status, report, err = run(folder, capsys)
    assert (status, report) == (1, None)
    assert "no hull of 8 pictures" in err
    assert err.count("\n") == 1


def test_missing_picture_is_told_and_the_others_are_used(folder, capsys):
    """A hull of seven cameras is one."""
    (folder / "masks" / "2.png").unlink()
    status, report, _ = run(folder, capsys)
    assert status == 0
    assert report["missing"] == ["2"]
    assert "2" not in report["iou"]


def test_very_many_voxels_are_carved_without_tables(folder, capsys, monkeypatch):
    """The result is the same but for what the refinement takes for noise."""
    _, by_actors, _ = run(folder, capsys)
    monkeypatch.setattr("actors.workcell.folders.cell.TABLES_BYTES_MAX", 0)
    _, carved, _ = run(folder, capsys)
    assert carved["made_by"] == "carving, voxel by voxel"
    assert np.isclose(carved["volume_l"], by_actors["volume_l"], rtol=0.05)


def test_report_is_printed_as_json(folder, capsys):
    """In place of its lines."""
    assert run_folder(folder, folder.parent / "out", FolderOptions(grid=32, quiet=True)) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((folder.parent / "out" / "report.json").read_text())


@pytest.mark.parametrize("text", ["teal", "#12345", "#gg0000", "1,2", "0,0,256", "1,2,3,4"])
def test_colour_that_is_none_is_refused(text):
    """With those that there are."""
    with pytest.raises(ValueError, match="black, white, green, blue, red, #rrggbb or R,G,B"):
        colour_of(text)
    assert colour_of("#0a0b0c") == colour_of("10,11,12") == (10, 11, 12)


def test_key_colour_of_the_command_line_is_a_name_or_numbers(folder, capsys):
    """All that the code reads can be typed; what it cannot read is one line."""
    out = folder.parent / "out"
    words = ["demo", "workcell", "--cameras", str(folder), "--out", str(out), "--key"]
    (folder / "masks").rename(folder / "images")
    assert main([*words, "teal"]) == 2
    assert "--key: asked for a colour, black, white" in capsys.readouterr().err
    assert main([*words, "black", "--grid", "32", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["masks_from"] == "key colour"


def test_renderer_without_a_recording_is_refused(capsys):
    """It would be played as if nobody had asked for it."""
    assert main(["demo", "workcell", "--renderer", "mujoco"]) == 2
    assert "--renderer belongs to --record DIR" in capsys.readouterr().err


def test_two_masks_without_anything_agree():
    """And half of one is half of it."""
    mask = np.zeros((2, 2), bool)
    assert intersection_over_union(mask, mask) == 1.0
    mask[0] = True
    assert intersection_over_union(mask, np.ones((2, 2), bool)) == 0.5


def test_camera_of_a_set_has_a_size_of_its_own():
    """A calibration without one takes that of the picture."""
    assert isinstance(RING[0].of_size(1, 2), SetCamera)
    assert (RING[0].of_size(1, 2).width, RING[0].of_size(1, 2).height) == (1, 2)
