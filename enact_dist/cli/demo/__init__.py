"""`enact demo`: the table of the demonstrations; the modules beside carry them out."""

from __future__ import annotations

from typing import Final

from enact_dist.cli.arguments import counted, file_of, seconds_of
from enact_dist.cli.verbs import Option, OptionGroup, Verb, flag, option

FORMATS: Final = """\
FOLDER holds, as .png, .jpg, .ppm, .pgm, .bmp or .tif (without MOMENT if there is only one):
  masks/CAMERA/MOMENT.png      not black is foreground
  images/CAMERA/MOMENT.png     where there are no masks, with background/CAMERA.png or --key
and one calibration of all cameras, with x_camera = R X + t:
  cameras.json                 as enact workcell calibrate writes it: "unit", and "cameras", each
                               with "name", "K", "R", "t" (or "P"), "distortion", "width", "height"
  cameras.txt and images.txt   of COLMAP, as text, here or in sparse, sparse/0, colmap
  NAME.txt                     the number of cameras, and a line for each: name K(9) R(9) t(3)
  CAMERA.txt                   a 3 x 4 projection, here or in calib, projections, cameras
  CAMERA.yml, .yaml, .xml      of OpenCV, in the same places: camera_matrix,
                               distortion_coefficients, and R with t, or projection_matrix
bounds.json, {"low": [x, y, z], "high": [x, y, z]}, says where to look, if that is known."""
"""What a folder of pictures holds; `camera_sets` and `folders.pictures` read it."""

_OUT: Final = file_of("--out", "DIR", "where pictures and tables go")
_KEEP_RUNNING: Final = flag("--keep-running", "leave the cell up afterwards, until Ctrl-C")


def _seed(metavar: str, text: str) -> Option:
    return option("--seed", metavar, text, type=int)


VERBS: Final = (
    Verb(
        "workcell",
        "eight cameras watch a person and a robot, which slows down, stops and goes around",
        "workcell:run_workcell",
        "enact demo workcell\n"
        "enact demo workcell --scenario S3 --seconds 30 --seed 2 --out workcell\n"
        "enact demo workcell --live --json\n"
        "enact demo workcell --cell cell.toml --out workcell\n"
        "enact demo workcell --cameras pictures --out hull",
        (
            option("--scenario", "S", "visit (the default) or S1 to S12"),
            _seed("N", "seed of paths, speeds and noise"),
            seconds_of("--seconds", "how long (default 60)"),
            _OUT,
            option("--voxel-m", "M", "edge of a voxel (default 0.025)", type=float),
            option("--scale", "X", "of the images, with --live: 0.5 is a quarter of the pixels",
                   type=float),
            flag("--live", "render the images at run time"),
            file_of("--play", "DIR", "play views recorded there"),
            file_of("--record", "DIR", "draw the views there, and end"),
            option("--renderer", None, "renderer of --record (default composite)",
                   choices=("composite", "mujoco")),
            flag("--embedded", "all in one process"),
            flag("--separate",
                 "camera, learning and subtraction as actors of their own, as in the paper's"
                 " Figure 4"),
            flag("--json", "print the report as JSON"),
            _KEEP_RUNNING,
            file_of("--cell", "FILE",
                    "the cell.toml of a running workcell, to be conducted and scored"),
            OptionGroup("real pictures of calibrated cameras instead of the simulation", (
                file_of("--cameras", "FOLDER", "pictures or masks"),
                counted("--grid", "voxels along the longest edge"),
                option("--unit", "U", "unit of a calibration that names none, such as m"),
                option("--frame", "NAME", "the moment to use (default: the first)"),
                option("--key", "COLOUR", "colour of the backdrop: green, #00b140 or 0,177,64"),
                option("--distortion", None, "k1, k2, k3 act on radii in pixels",
                       choices=("pixel",)),
            ), FORMATS),
        ),
        page="workcell",
    ),
    Verb(
        "palletizing", "a robot packs a tray; actors train models, judge each package and react",
        "palletizing:run_palletizing",
        "enact demo palletizing --packages 6 --seed 1 --speed 1 --out demo\n"
        "enact demo palletizing --store postgresql://enact@db/cell --fail-over-after 2\n"
        "enact demo palletizing --cell cell.toml --out demo\n"
        "enact demo palletizing --views redwood_rgbd --out surface\n"
        "enact demo palletizing --model milk.pcd --scene table.pcd --out pose\n"
        "enact demo palletizing --check-net push.toml --out nets",
        (
            counted("--packages", "how many packages come by"),
            _seed("S", "seed of packages and sensors"),
            option("--speed", "X", "simulated time per real time (default: 1.25)", type=float),
            _OUT,
            _KEEP_RUNNING,
            option("--store", "URL",
                   "keep the data in this PostgreSQL database, with a standby daemon of each shard"
                   " (default: ENACT_STORE; otherwise a folder)"),
            counted("--fail-over-after",
                    "kill the daemons of all shards after so many packages; the standbys take"
                    " over"),
            file_of("--cell", "FILE",
                    "the cell.toml of a running palletizing cell, to be watched and scored"),
            file_of("--check-net", "FILE",
                    "check a primitive net or skeleton (TOML) and draw it to DIR; nothing runs"),
            OptionGroup("real recordings instead of the simulated sensor", (
                file_of("--views", "DIR", "train from an RGB-D recording"),
                file_of("--model", "FILE", "a model to find (PLY, PCD, …)"),
                file_of("--scene", "FILE", "the cloud to find it in"),
            )),
        ),
    ),
)  # fmt: skip
