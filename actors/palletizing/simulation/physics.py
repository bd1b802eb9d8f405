"""SIMULATED palletizing cell with physics (MuJoCo): packages slip, tilt and dent by themselves.

    cell = PhysicalCell(12, seed=59)
    cell.feed()                       # the next package, at the start of the belt
    cell.run_belt()                   # until it interrupts the light barrier
    arm = cell.arm                    # an `ArmController`
    arm.start()
    while ...:
        arm.command(q)
        cell.step()                   # one cycle of 4 ms
    cell.truth()                      # where everything is, what became of it

Rules a change must keep: a cell is a function of its packages, its seed and the commands it got in
each cycle; `mj_forward` follows every pose that is set by hand, or bodies are where they were
before; poses are read off bodies, never off geoms (MuJoCo moves the geom of a mesh to its centre).
It is not for several threads: `cell.thread` runs it in one of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.poses import inverse, on_tray
from actors.palletizing.control.controller import ControllerError
from actors.palletizing.simulation.cell.arm import CYCLE_S, STEPS, SimulatedArm
from actors.palletizing.simulation.cell.contacts import Contacts, GripWatch
from actors.palletizing.simulation.cell.scene import (
    BARRIER_M,
    BELT_HALF_M,
    BELT_M_S,
    PACKAGES_GROUP,
    CellLayout,
    centre_of_mass,
    collision_corners,
    load_mujoco,
    scene_xml,
)
from actors.palletizing.simulation.cell.truth import (
    CellTruth,
    PackageTruth,
    ShownCell,
    ShownPackage,
    place_of,
)
from actors.palletizing.simulation.physical_packages import (
    DENT_AREA_M2,
    Damage,
    PhysicalPackage,
    draw_packages,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    F64 = npt.NDArray[np.float64]

FEED_X_M: Final = -0.75
"""Where a package comes onto the belt, from the light barrier."""
PICTURE_PX: Final = (960, 720)
"""Greatest width and height of a rendered picture."""
DAMPED: Final = 0.95
"""Greatest impedance of MuJoCo's contacts, by which it divides their damping."""
FAILURES: Final = {
    "belt": "the belt does not move",
    "gripper": "the fingers open, whatever is commanded",
    "wrist": "arm and gripper measure nothing new",
    "camera": "the depth sensors give the image of that moment, again and again",
    "blind": "the depth sensors give no image",
}
"""What can be made to fail for a while, and how it shows."""
WHEN: Final = {
    "": "at once",
    "carried": "when a held package hangs over the tray",
    "running": "when the belt moves",
}
"""What a failure can wait for."""
HANGS_M: Final = 0.06
"""A held package whose base is so high above the tray hangs."""
OUTSIDE: Final = "outside"
"""Name of whatever presses on a package and is no part of the cell."""
NEAR_M: Final = 0.3
"""A package farther from the tool than this is not the one that was missed."""


@dataclass(frozen=True, slots=True)
class Failure:
    """Something that fails for a while.

    Attributes:
        when: What it waits for, one of `WHEN`.
        cycles: How long it lasts.
        since: Cycle in which it began; -1: it waits.
    """

    when: str
    cycles: int
    since: int = -1


class PhysicalCell:
    """The cell: arm, gripper, belt, tray, packages, and the truth about them.

    Args:
        packages: How many come, or which.
        seed: Seed of the packages and of the wrist sensor.
        layout: Where things stand.
        epoch_ns: What the stamps of measurements begin with, nanoseconds since 1970.

    Attributes:
        arm: The controller of arm and gripper.
        layout: Where things stand.
        seed: As given.
    """

    def __init__(
        self,
        packages: int | Sequence[PhysicalPackage],
        *,
        seed: int,
        layout: CellLayout | None = None,
        epoch_ns: int = 0,
    ) -> None:
        if isinstance(packages, int):
            packages = draw_packages(packages, seed=seed)
        self.layout, self.seed = layout or CellLayout(), seed
        self._packages, self._epoch_ns = tuple(packages), epoch_ns
        self._mujoco = load_mujoco()
        text = scene_xml(self._packages, self.layout, picture=PICTURE_PX)
        self.model: Any = self._mujoco.MjModel.from_xml_string(text)
        self.data: Any = self._mujoco.MjData(self.model)
        model = self.model
        names = [f"package{package.number}" for package in self._packages]
        self._bodies = [int(model.body(name).id) for name in names]
        self._geoms = [int(model.geom(name).id) for name in names]
        self._package_of = np.full(model.ngeom, -1)
        self._package_of[self._geoms] = np.arange(len(names))
        self._pads = (int(model.geom("left").id), int(model.geom("right").id))
        self._belt = int(model.geom("belt").id)
        self._damages = [Damage(package) for package in self._packages]
        self._harmless_n = np.array(
            [min(p.yield_n("top"), p.yield_n("front")) for p in self._packages]
        )
        self._pressed: set[int] = set()
        self._present: list[bool] = [False] * len(names)
        self._away: list[bool] = [False] * len(names)
        self._fed = 0
        self._cycles = 0
        self._running = self._interrupted = False
        self._failing: dict[str, Failure] = {}
        self._loads: dict[int, tuple[F64, F64]] = {}
        self._seen_last: ShownCell | None = None
        self._grip = GripWatch()
        self._hand = int(model.body("hand").id)
        self._change = np.zeros((3, model.nv))
        self._finger_dof = int(model.joint("left").dofadr[0])
        self._areas = self.layout.areas()
        self.arm = SimulatedArm(model, self.data, self._mujoco.mj_mulM, seed=seed)
        self._mujoco.mj_forward(model, self.data)
        self.arm.measure(self._stamp_ns())

    @property
    def time_s(self) -> float:
        """Simulated time since the beginning."""
        return self._cycles * CYCLE_S

    @property
    def coming(self) -> int:
        """How many packages have not come yet."""
        return len(self._packages) - self._fed

    def step(self, cycles: int = 1) -> None:
        """Let the cell go on by cycles of control, 4 ms each."""
        for _ in range(cycles):
            self._begin_failures()
            self.arm.drive(slack=self._fails("gripper"))
            self._carry()
            self._mujoco.mj_step(self.model, self.data, STEPS)
            # A step leaves bodies where they were before it.
            self._mujoco.mj_kinematics(self.model, self.data)
            self._cycles += 1
            self._drive_belt()
            self._notice()
            self._unload()
            if not self._fails("wrist"):
                self.arm.measure(self._stamp_ns())

    def fail(self, kind: str, seconds: float, when: str = "") -> None:
        """Let something fail.

        Args:
            kind: One of `FAILURES`.
            seconds: Simulated time until it works again; 0 mends it.
            when: What it waits for, one of `WHEN`.

        Raises:
            ControllerError: No such kind, or nothing that can be waited for.
        """
        for asked, known, what in ((kind, FAILURES, "failure"), (when, WHEN, "moment")):
            if asked not in known:
                names = ", ".join(name or "none" for name in known)
                raise ControllerError(f"asked for the {what} {asked!r}; this cell has {names}")
        self._failing[kind] = Failure(when, round(seconds / CYCLE_S))
        self._begin_failures()

    def failures(self) -> dict[str, tuple[float, float]]:
        """Return from when to when each failure that has begun lasts, simulated seconds."""
        return {
            kind: (CYCLE_S * failure.since, CYCLE_S * (failure.since + failure.cycles))
            for kind, failure in self._failing.items()
            if failure.since >= 0
        }

    def _begin_failures(self) -> None:
        for kind, failure in self._failing.items():
            if failure.since < 0 and self._is_so(failure.when):
                if kind == "camera":
                    self._seen_last = self.shown()
                self._failing[kind] = replace(failure, since=self._cycles)

    def _is_so(self, when: str) -> bool:
        """Return whether what a failure waits for is so."""
        if when == "carried":
            held = self._grip.held
            if held < 0:
                return False
            frame, (least, most) = self._areas["tray"]
            at = (inverse(frame) @ self.pose(held))[:3, 3]
            return bool((least < at[:2]).all() and (at[:2] < most).all() and at[2] > HANGS_M)
        return when != "running" or (self._running and self._moving)

    def _fails(self, kind: str) -> bool:
        failure = self._failing.get(kind)
        if failure is None or failure.since < 0:
            return False
        return self._cycles < failure.since + failure.cycles

    # The belt

    def run_belt(self) -> None:
        """Move the belt until a package interrupts the light barrier."""
        self._running = True

    def stop_belt(self) -> None:
        """Stop the belt."""
        self._running = False

    def arrived(self) -> bool:
        """Return whether a package stands in the light barrier, the belt at rest."""
        return self._interrupted and not self._moving

    def feed(self) -> int:
        """Put the next package onto the start of the belt; return its number.

        Raises:
            ControllerError: No package is left, or one stands where it would come.
        """
        if not self.coming:
            raise ControllerError(f"all {len(self._packages)} packages have come")
        package = self._packages[self._fed]
        beside = on_tray(FEED_X_M, package.belt_y_m, package.belt_yaw_rad)
        pose = self.layout.base_from_belt @ beside
        for number, present in enumerate(self._present):
            where = self.data.xpos[self._bodies[number]]
            if present and np.linalg.norm(where[:2] - pose[:2, 3]) < 0.22:
                raise ControllerError(
                    f"package {package.number} cannot come: package {number} stands at the start"
                    " of the belt; run the belt first"
                )
        self.put(package.number, pose)
        return package.number

    def put(self, number: int, base_from_product: F64) -> None:
        """Put a package somewhere, at rest: a person's hand, or the start of a test.

        Args:
            number: Which; if it has not come yet, those before it will not come any more.
            base_from_product: (4, 4), metres.
        """
        address = int(self.model.jnt_qposadr[self.model.body_jntadr[self._bodies[number]]])
        dof = int(self.model.jnt_dofadr[self.model.body_jntadr[self._bodies[number]]])
        self._appear(number)
        self.data.qpos[address : address + 3] = base_from_product[:3, 3]
        turn = np.empty(4)
        self._mujoco.mju_mat2Quat(turn, np.ascontiguousarray(base_from_product[:3, :3]).ravel())
        self.data.qpos[address + 3 : address + 7] = turn
        self.data.qvel[dof : dof + 6] = 0.0
        self._mujoco.mj_forward(self.model, self.data)
        self._fed = max(self._fed, number + 1)

    def take_away(self, number: int) -> None:
        """Take a package out of the cell: a person's hand, or a tray that is changed."""
        if not self._present[number]:
            return
        body = self._bodies[number]
        self._present[number], self._away[number] = False, True
        self._touchable(number, yes=False)
        address = int(self.model.jnt_qposadr[self.model.body_jntadr[body]])
        dof = int(self.model.jnt_dofadr[self.model.body_jntadr[body]])
        self.data.qpos[address : address + 7] = [0.0, 0.0, -5.0 - number, 1.0, 0.0, 0.0, 0.0]
        self.data.qvel[dof : dof + 6] = 0.0
        self._mujoco.mj_forward(self.model, self.data)
        self._damages[number].calm()

    def replace(self, number: int, base_from_product: F64) -> None:
        """Put a sound package of the same kind somewhere in place of one: a person's hands."""
        self._damages[number] = Damage(self._packages[number])
        self.put(number, base_from_product)

    def load(self, number: int, force_n: F64, at_m: F64) -> None:
        """Let a force from outside act on a package in the next cycle: a knock, something on it.

        It dents like a body that touches the package over the area of one dent.

        Args:
            number: Which.
            force_n: (3,), base frame.
            at_m: (3,), where, product frame.
        """
        pose, body = self.pose(number), self._bodies[number]
        lever = pose[:3, :3] @ at_m + pose[:3, 3] - self.data.xipos[body]
        self.data.xfrc_applied[body] = np.concatenate((force_n, np.cross(lever, force_n)))
        self._loads[number] = force_n, at_m

    def change_tray(self) -> list[int]:
        """Take the tray away with all that is on it; return the numbers of those packages."""
        taken = [truth.number for truth in self.truth().packages if truth.where == "tray"]
        for number in taken:
            self.take_away(number)
        return taken

    # The truth

    def pose(self, number: int) -> F64:
        """Return base_from_product of a package, (4, 4)."""
        body = self._bodies[number]
        pose = np.eye(4)
        pose[:3, :3] = self.data.xmat[body].reshape(3, 3)
        pose[:3, 3] = self.data.xpos[body]
        return pose

    def truth(self) -> CellTruth:
        """Return what is true now."""
        tray_from_base = inverse(self.layout.base_from_tray)
        found = []
        for number, package in enumerate(self._packages):
            pose = self.pose(number)
            kinds = [event.kind for event in self._grip.events if event.package == number]
            found.append(
                PackageTruth(
                    number=number,
                    product=package.product,
                    where=self._where(number, pose),
                    base_from_product=pose,
                    tray_from_product=tray_from_base @ pose,
                    tilt_rad=float(np.arccos(np.clip(pose[2, 2], -1.0, 1.0))),
                    dents=tuple(self._damages[number].dents),
                    missed=kinds.count("missed"),
                    lost=kinds.count("lost"),
                    friction=package.friction,
                    mass_kg=package.mass_kg,
                )
            )
        return CellTruth(self.time_s, tuple(found), tuple(self._grip.events))

    def shown(self) -> ShownCell:
        """Return what a sensor can see now."""
        if self._fails("camera") and self._seen_last is not None:
            return replace(self._seen_last, camera="frozen")
        measured = self.arm.measured()
        return ShownCell(
            stamp_ns=self._stamp_ns(),
            q=measured.q,
            width_m=measured.width_m,
            camera="blind" if self._fails("blind") else "",
            packages=tuple(
                ShownPackage(
                    number=number,
                    product=package.product,
                    base_from_product=self.pose(number),
                    dents=tuple(self._damages[number].dents),
                    pick_offset_m=package.pick_offset_m,
                )
                for number, package in enumerate(self._packages)
                if self._present[number]
            ),
        )

    # Inside

    def _stamp_ns(self) -> int:
        return self._epoch_ns + self._cycles * round(CYCLE_S * 1e9)

    @property
    def _moving(self) -> bool:
        return bool(self.model.geom_surfacevel[self._belt].any())

    def _where(self, number: int, pose: F64) -> str:
        if not self._present[number]:
            return "away" if self._away[number] else "coming"
        if number == self._grip.held:
            return "held"
        corners = collision_corners(self._packages[number].product)
        lowest = float((corners @ pose[2, :3]).min() + pose[2, 3])
        centre = pose[:3, :3] @ centre_of_mass(self._packages[number].product) + pose[:3, 3]
        return place_of(lowest, centre, self._areas)

    def _appear(self, number: int) -> None:
        self._touchable(number, yes=True)
        self._present[number], self._away[number] = True, False

    def _touchable(self, number: int, *, yes: bool) -> None:
        """Let a package collide and fall, or float where nothing is."""
        model, body, geom = self.model, self._bodies[number], self._geoms[number]
        model.geom_contype[geom] = model.geom_conaffinity[geom] = int(yes)
        # The broad phase asks the body, whose bits the compiler made of those of its geoms.
        model.body_contype[body] = model.body_conaffinity[body] = int(yes)
        model.body_gravcomp[body] = float(not yes)

    def _drive_belt(self) -> None:
        frame = self.layout.base_from_belt
        across = BELT_HALF_M[1]
        start = frame[:3, 3] - across * frame[:3, 1] + BARRIER_M * frame[:3, 2]
        groups = np.zeros(6, np.uint8)
        groups[PACKAGES_GROUP] = 1
        seen = np.array([-1], np.int32)
        hit_m = self._mujoco.mj_ray(self.model, self.data, start, frame[:3, 1], groups, 0, -1, seen)
        self._interrupted = 0.0 <= hit_m <= 2.0 * across
        moving = self._running and not self._interrupted and not self._fails("belt")
        self.model.geom_surfacevel[self._belt, 0] = BELT_M_S if moving else 0.0

    def _carry(self) -> None:
        """Let what is held accelerate as the hand does by its speed alone.

        MuJoCo's contacts equate accelerations without the part that comes from the change of the
        Jacobian: friction then lets a package slip with that part times half the time constant of
        the contact, whatever the grip, the step and the solver.  A carton slipped by 10 mm in a
        hand that carried it at 0.8 m/s.  A surface velocity of the pads of that size cancels it.
        """
        held = self._grip.held
        self.model.geom_surfacevel[self._pads, :3] = 0.0
        if held < 0:
            return
        point = self.data.xipos[self._bodies[held]]
        self._mujoco.mj_jacDot(self.model, self.data, self._change, None, point, self._hand)
        lag_s = 0.5 * DAMPED * self._packages[held].contact_s
        slip_m_s = lag_s * (self._change @ self.data.qvel)
        for pad in self._pads:
            turn = self.data.geom_xmat[pad].reshape(3, 3)
            self.model.geom_surfacevel[pad, :3] = turn.T @ slip_m_s

    def _notice(self) -> None:
        """Take the contacts of this cycle: what is deformed, what is in the gripper."""
        contacts = Contacts(self.model, self.data, self._package_of)
        # A package that is pressed by less than its yield force, all patches together, is safe.
        on_each = contacts.on_packages(len(self._packages))
        pressed = {int(number) for number in np.flatnonzero(on_each > self._harmless_n)}
        for number in pressed:
            pose = self.pose(number)
            for patch in contacts.patches(self._geoms[number]):
                self._damages[number].press(
                    patch.by,
                    patch.force_n,
                    patch.area_m2,
                    pose[:3, :3].T @ (patch.at_m - pose[:3, 3]),
                    pose[:3, :3].T @ patch.inwards,
                )
        for number in self._pressed - pressed:
            self._damages[number].calm()
        self._pressed = pressed
        self._grip.watch(
            contacts.between(self._pads),
            closing_cycles=self.arm.gripping_cycles if self.arm.gripping else 0,
            rate_m_s=float(self.data.qvel[self._finger_dof]),
            nearest=self._nearest,
            now_s=self.time_s,
        )

    def _unload(self) -> None:
        """Take the loads of this cycle, and away."""
        for number, (force_n, at_m) in self._loads.items():
            strength_n = float(np.linalg.norm(force_n))
            inwards = self.pose(number)[:3, :3].T @ force_n / strength_n
            self._damages[number].press(OUTSIDE, strength_n, DENT_AREA_M2, at_m, inwards)
            self.data.xfrc_applied[self._bodies[number]] = 0.0
        self._loads.clear()

    def _nearest(self) -> int:
        tool = self.arm.measured().tcp[:3, 3]
        distances = {
            number: float(np.linalg.norm(self.pose(number)[:3, 3] - tool))
            for number, present in enumerate(self._present)
            if present
        }
        near = min(distances, key=lambda number: distances[number], default=-1)
        return near if near >= 0 and distances[near] < NEAR_M else -1
