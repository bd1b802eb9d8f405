"""A process of the view's bench: `python -m enact_dist.bench.view.worker CELL ROLE {}`.

========  =======================================================================================
writer    writes at 10 Hz images and masks of eight cameras, a hull and two robots
follower  is woken by the hull of each tick and reads the eight images; says how late it had them
page      at a line with an address opens it and reads all that it is sent, but draws nothing
browser   the same with a headless Chromium, which draws; one page after the other
========  =======================================================================================

Each line is answered by one; what a line says begins with its name.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from enact_dist.access.lock import Lock
from enact_dist.bench.place import WORLD
from enact_dist.bench.timing import sleep_until
from enact_dist.terms import Aspect, Durability, Entity, View, Write
from enact_dist.world.connecting import connect
from enact_dist.world.context import WorldContext

CAMERAS: Final = 8
ROBOTS: Final = 2
PERIOD_NS: Final = 100_000_000
HIGH_PX, WIDE_PX = 480, 640
FRAMES: Final = 8
VOXEL_M: Final = 0.025
WAIT_S: Final = 30.0
CHROMIUM: Final = Path("/usr/bin/chromium")
BROWSER_S: Final = 120.0
UPDATE_BYTES: Final = 4096
"""A message with more bytes of arrays and images than this shows an update of the scene."""


@dataclass(frozen=True)
class FilmedCamera:
    """How a camera sees: matrix (3, 3) in pixels, (4, 4) from the cell into the camera."""

    camera_matrix: NDArray[np.float64]
    width: int
    height: int
    camera_from_cell: NDArray[np.float64]


@dataclass(frozen=True)
class FilmedMask:
    """What differs from the background: (H, W / 8) uint8, packed along rows."""

    packed: NDArray[np.uint8]


IMAGE: Final[Aspect[Any]] = Aspect("view_image", np.ndarray, Durability.VOLATILE, retention=4)
MASK: Final = Aspect("view_mask", FilmedMask, Durability.VOLATILE, retention=16)
CAMERA: Final = Aspect("view_camera", FilmedCamera, Durability.VOLATILE)
HULL: Final[Aspect[Any]] = Aspect("view_hull", np.ndarray, Durability.VOLATILE, retention=16)
ROBOT: Final[Aspect[Any]] = Aspect("view_robot", np.ndarray, Durability.VOLATILE, retention=16)
WORKSPACE: Final = Entity("workspace")
SHOWS: Final = f"""
[aspects.view_image]
shows = "image"
encoding = "bgr8"
frame = "{{entity}}"

[aspects.view_mask]
shows = "mask"
frame = "{{entity}}"

[aspects.view_camera]
shows = ["calibration", "transform"]
frame = "{{entity}}"
parent = "cell"
inverse = true

[aspects.view_hull]
shows = "voxels"
frame = "cell"
voxel_m = {VOXEL_M}
origin_m = [-2.0, -2.0, 0.0]

[aspects.view_robot]
shows = "capsules"
frame = "cell"
"""


def camera_of(number: int) -> FilmedCamera:
    """Return a camera that looks from a wall into the middle of the cell."""
    angle = number * 2.0 * np.pi / CAMERAS
    place_m = np.array((2.6 * np.cos(angle), 2.6 * np.sin(angle), 2.5))
    forward = np.array((0.0, 0.0, 0.7)) - place_m
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    turned = np.stack((right, np.cross(forward, right), forward))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turned, -turned @ place_m
    pinhole = np.array(((440.0, 0.0, WIDE_PX / 2), (0.0, 440.0, HIGH_PX / 2), (0.0, 0.0, 1.0)))
    return FilmedCamera(pinhole, WIDE_PX, HIGH_PX, matrix)


def frames_of(number: int) -> list[tuple[NDArray[np.uint8], FilmedMask]]:
    """Return what a camera sees in turn: a room with noise, a person who walks, and the masks."""
    noise = np.random.default_rng(number)
    rows, columns = np.mgrid[:HIGH_PX, :WIDE_PX]
    tiles = 25.0 * ((rows // 60 + columns // 60) % 2)
    room = np.stack([90 + 60 * rows / HIGH_PX + tiles, 120 + tiles, 150 - tiles], axis=2)
    found = []
    for frame in range(FRAMES):
        middle = 200.0 + 30.0 * frame
        covers = ((columns - middle) / 45.0) ** 2 + ((rows - 260.0) / 150.0) ** 2 < 1.0
        image = room + noise.normal(0.0, 2.5, room.shape)
        image[covers] = (60.0, 80.0, 160.0)
        packed = np.packbits(covers, axis=1)
        found.append((np.clip(image, 0.0, 255.0).astype(np.uint8), FilmedMask(packed)))
    return found


def hull_of(frame: int) -> NDArray[np.int16]:
    """Return voxels (N, 3) of a person, about 18,000."""
    at = np.mgrid[:40, :40, 2:74].reshape(3, -1).T
    inside = (((at[:, :2] - 20.0) / (11.0, 8.0)) ** 2).sum(axis=1) + (
        (at[:, 2] - 38.0) / 42.0
    ) ** 2 < 1.0
    return np.asarray(at[inside] + (70 + 2 * frame, 90, 0), np.int16)


def robot_of(number: int, tick: int) -> NDArray[np.float32]:
    """Return seven capsules (7, 7): end, end, radius; they turn with the ticks."""
    angles = 0.05 * tick + 0.5 * np.arange(8)
    places = np.stack((0.15 * np.cos(angles), 0.15 * np.sin(angles), 0.15 * np.arange(8)), axis=1)
    places[:, 0] += 0.8 * number
    return np.hstack((places[:-1], places[1:], np.full((7, 1), 0.07))).astype(np.float32)


# ---------------------------------------------------------------- roles in the cell


def _write(world: WorldContext) -> None:
    cameras = [Entity(f"camera/{number}") for number in range(CAMERAS)]
    frames = [frames_of(number) for number in range(CAMERAS)]
    hulls = [hull_of(frame) for frame in range(FRAMES)]
    for number, of in enumerate(cameras):
        _put(0, (Write(world, of, CAMERA), camera_of(number)))
    filmed = [(Write(world, of, IMAGE), Write(world, of, MASK)) for of in cameras]
    robots = [Write(world, Entity(f"robot/{number}"), ROBOT) for number in range(ROBOTS)]
    hull = Write(world, WORKSPACE, HULL)
    commits: list[tuple[int, int]] = []
    print("ready:", flush=True)
    stopped = _asked()
    tick = 0
    begin_ns = time.perf_counter_ns()
    while not stopped.is_set():
        due_ns = begin_ns + tick * PERIOD_NS
        sleep_until(due_ns)
        if time.perf_counter_ns() > due_ns + PERIOD_NS:  # too late for this one
            tick += 1
            continue
        frame = tick % FRAMES
        groups: list[tuple[tuple[Write[Any], Any], ...]] = [
            tuple(zip(writes, seen[frame], strict=True))
            for writes, seen in zip(filmed, frames, strict=True)
        ]
        groups += [((write, robot_of(n, tick)),) for n, write in enumerate(robots)]
        groups.append(((hull, hulls[frame]),))
        commits.extend((due_ns, _put(due_ns, *group)) for group in groups)
        tick += 1
    print("did:", json.dumps(commits), flush=True)


def _put(stamp_ns: int, *data: tuple[Write[Any], Any]) -> int:
    """Write some data in one lock; return how long that took, nanoseconds."""
    begun_ns = time.perf_counter_ns()
    with Lock(*(write for write, _ in data), wait_s=WAIT_S) as lock:
        for write, value in data:
            lock.put(write, value, stamp_ns=stamp_ns)
    return time.perf_counter_ns() - begun_ns


def _follow(world: WorldContext) -> None:
    views = [View(world, Entity(f"camera/{number}"), IMAGE) for number in range(CAMERAS)]
    late: list[tuple[int, int]] = []
    print("ready:", flush=True)
    stopped = _asked()
    with world.watch(WORKSPACE, HULL) as watch:
        while not stopped.is_set():
            change = watch.next(0.5)
            if change is None or change.null:
                continue
            seen = world.view(*views)
            assert all(seen[view][::40, ::40].any() for view in views)
            late.append((change.captured_ns, time.perf_counter_ns() - change.captured_ns))
    print("did:", json.dumps(late), flush=True)


def _asked() -> threading.Event:
    """Return an event that the next line of the standard input sets."""
    event = threading.Event()

    def wait() -> None:
        sys.stdin.readline()
        event.set()

    threading.Thread(target=wait, daemon=True).start()
    return event


# ---------------------------------------------------------------- roles before the page


def updates_in(message: bytes) -> bool:
    """Whether a message of viser shows something new in the scene: it has arrays or images."""
    packed_bytes = int.from_bytes(message[8:16], "little")
    return len(message) - 16 - packed_bytes > UPDATE_BYTES


def _camera_message() -> bytes:
    import msgspec

    posed: bytes = msgspec.msgpack.encode(
        {
            "type": "ViewerCameraMessage",
            "wxyz": (1.0, 0.0, 0.0, 0.0),
            "position": (3.0, -3.0, 2.0),
            "fov": 0.8,
            "near": 0.01,
            "far": 1000.0,
            "image_height": 850,
            "image_width": 1300,
            "look_at": (0.0, 0.0, 0.0),
            "up_direction": (0.0, 0.0, 1.0),
        }
    )
    return posed


def _read_page(url: str, stopped: threading.Event) -> Iterator[tuple[int, int]]:
    """Open a page, read all that comes; give the time and the size of each update."""
    from importlib.metadata import version

    from websockets.sync.client import connect as open_socket
    from websockets.typing import Subprotocol

    protocol = Subprotocol(f"viser-v{version('viser')}")
    with open_socket(
        url.replace("http", "ws", 1), subprotocols=[protocol], max_size=None, compression=None
    ) as socket:
        socket.send(_camera_message())
        while not stopped.is_set():
            try:
                message = socket.recv(0.5)
            except TimeoutError:
                continue
            if isinstance(message, bytes) and updates_in(message):
                yield time.perf_counter_ns(), len(message)


def _page() -> None:
    import websockets.sync.client  # noqa: F401 - its import is no part of a first picture

    _camera_message()
    print("ready:", flush=True)
    for line in iter(sys.stdin.readline, ""):
        url, stopped = line.strip(), _asked()
        updates: list[tuple[int, int]] = []
        for update in _read_page(url, stopped):
            if not updates:
                print("shown:", update[0], flush=True)
            updates.append(update)
        print("did:", json.dumps(updates), flush=True)


_FRAMES: Final = """() => { window.enactFrames = 0;
  const count = () => { window.enactFrames += 1; requestAnimationFrame(count); };
  requestAnimationFrame(count); }"""
_SAID: Final = "() => (document.body.innerText.match(/([0-9.]+) updates/) || [])[1] || ''"


def _browse() -> None:
    from playwright.sync_api import sync_playwright

    flags = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=str(CHROMIUM), args=[*flags, "--disable-dev-shm-usage"]
        )
        print("ready:", flush=True)
        for line in iter(sys.stdin.readline, ""):
            page = browser.new_page(viewport={"width": 1300, "height": 850})
            page.set_default_timeout(BROWSER_S * 1e3)
            page.goto(line.strip())
            page.wait_for_function(_SAID)
            page.wait_for_selector("canvas")
            print("shown:", time.perf_counter_ns(), flush=True)
            sys.stdin.readline()  # from here on it counts
            page.evaluate(_FRAMES)
            begun_s = time.perf_counter()
            said: list[float] = []
            stopped = _asked()
            while not stopped.wait(1.0):
                said.append(float(page.evaluate(_SAID) or 0.0))
            frames = page.evaluate("() => window.enactFrames")
            frames_s = frames / (time.perf_counter() - begun_s)
            page.close()
            print("did:", json.dumps({"updates": said, "frames_s": frames_s}), flush=True)
        browser.close()


_IN_CELL: Final[dict[str, Callable[[WorldContext], None]]] = {
    "writer": _write,
    "follower": _follow,
}
_BEFORE_PAGE: Final[dict[str, Callable[[], None]]] = {
    "page": _page,
    "browser": _browse,
}


def main(words: Sequence[str]) -> None:
    """Play one role until the parent ends this process."""
    target, role, _options = words
    if role in _BEFORE_PAGE:
        _BEFORE_PAGE[role]()
        return
    with connect(target, actor=f"bench-{role}", timeout_s=20.0) as cell:
        _IN_CELL[role](cell.create_world(WORLD))


if __name__ == "__main__":
    main(sys.argv[1:])
