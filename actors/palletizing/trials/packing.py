"""The whole palletizing cell in one process, in simulated time: physics, sensors, decisions.

    run = Packing(draw_packages(12, seed=59), models, seed=59)
    packed = run.run()

It does what the actors do, with the same functions, as fast as it goes: a package arrives, the belt
sensor sees it, nets are grounded and executed, the hand goes aside, the tray sensor looks, every
place whose neighbourhood has changed is judged, and what was seen decides what follows.  Only the
operator differs: here he is a rule.

Rules a change must keep: decisions see pictures and measurements only, never the truth of physics;
truth is noted beside each verdict, for the score (`packing_scores`).
"""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.poses import coordinates, inverse
from actors.geometry.surfaces.depth import fused
from actors.palletizing.control.execution import Executor
from actors.palletizing.handling.grounding import Job, aside_net, easier_turn, ground
from actors.palletizing.handling.nets import NetError
from actors.palletizing.handling.reactions import NO_NET, Case, Reaction, react, worst
from actors.palletizing.handling.stages import along_and_across, felt, felt_on, fills, gap_before
from actors.palletizing.placing.finger_room import Gripper
from actors.palletizing.placing.grasps import grasp_of, size_of
from actors.palletizing.placing.rows import contacts_between, planned_rows
from actors.palletizing.sight.belt_sight import BeltWatch
from actors.palletizing.sight.sensor import FRAMES
from actors.palletizing.sight.tray_watch import TrayWatch
from actors.palletizing.simulation.cell.scene import ARM, HOME_RAD, CellLayout
from actors.palletizing.simulation.knocks import OPEN_S, knock_at
from actors.palletizing.simulation.physical_packages import MATERIALS
from actors.palletizing.simulation.physical_sensors import PhysicalBeltSensor, PhysicalTraySensor
from actors.palletizing.simulation.physics import PhysicalCell
from actors.palletizing.trials.packing_records import Judgement, Packed, Step
from actors.palletizing.trials.truth import KINDS, badness, gap_m, state_of, top_dent_mm, truth_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy.typing as npt

    from actors.geometry.shapes import DepthFrame, Surface
    from actors.palletizing.handling.nets import Net
    from actors.palletizing.placing.rows import Slot
    from actors.palletizing.sight.belt_sight import BeltSight
    from actors.palletizing.sight.tray_watch import Seen
    from actors.palletizing.simulation.cell.truth import PackageTruth
    from actors.palletizing.simulation.knocks import Knock
    from actors.palletizing.simulation.physical_packages import PhysicalPackage

    F64 = npt.NDArray[np.float64]

STAGES: Final = {
    "look": (),
    "pack": ("grasp_from_belt", "place", "push_into_contact"),
    "retry": ("grasp_from_belt", "place", "push_into_contact"),
    "regrasp": ("regrasp", "place", "push_into_contact"),
    "push_again": ("push_into_contact",),
    "reject": ("remove_to_reject",),
}
"""Skeletons that a request runs, one after the other."""
FRAME_CYCLES: Final = 8
"""Cycles of control between two images: 30 a second."""
SETTLING_CYCLES: Final = 75
"""Until what a person has put down stands still."""
HELD_N: Final = 40.0
"""With which the fingers move to a width at most."""
WAIT_S: Final = 8.0
"""A package that the belt does not bring within that time does not come."""


class Packing:
    """A closed loop over the packages of one tray.

    Args:
        packages: What comes, in its order.
        models: Trained surface of each product.
        seed: Of physics and sensors.
        layout: Where things stand.
        told: Called with a line per step.
        knocks: What happens to packages from outside, by number, after they were first put down.
        watch: Called with a package and a moment worth a picture: "before" a knock, "error" when
            the camera looks at what it did, "after" the reaction.

    Raises:
        ValueError: The packages do not find room on one tray.
    """

    def __init__(
        self,
        packages: Sequence[PhysicalPackage],
        models: Mapping[str, Surface],
        *,
        seed: int,
        layout: CellLayout | None = None,
        told: Callable[[str], None] = lambda _: None,
        knocks: Mapping[int, Knock] | None = None,
        watch: Callable[[int, str], None] = lambda _number, _moment: None,
    ) -> None:
        self._knocks, self._watch = dict(knocks or {}), watch
        self._put, self._gone, self._by_hand = set[int](), set[int](), set[int]()
        self.layout, self._told = layout or CellLayout(), told
        self.cell = PhysicalCell(packages, seed=seed, layout=self.layout)
        self._packages = tuple(packages)
        self._sizes = {name: size_of(model) for name, model in models.items()}
        self._grasps = {
            name: grasp_of(model, mass_kg=MATERIALS[name].mass_kg) for name, model in models.items()
        }
        self._contacts = contacts_between(models)
        self.slots = self._planned()
        if self.slots[-1].tray:
            fits = sum(slot.tray == 0 for slot in self.slots)
            raise ValueError(f"{len(packages)} packages for one tray, which takes {fits}")
        shown = self.cell.shown
        self._belt = PhysicalBeltSensor(shown, seed=seed, layout=self.layout)
        tray = PhysicalTraySensor(shown, seed=seed, layout=self.layout)
        self.watch = TrayWatch(tray.capture_empty(), models)
        self._tray = tray
        self._pictures: list[DepthFrame] = []
        belt_from_tray = inverse(self.layout.base_from_belt) @ self.layout.base_from_tray
        self._belt_watch = BeltWatch(self._belt.capture_empty(), models, belt_from_tray)
        self._frames = self.layout.frames()
        self._set_places()
        self._last_rad: F64 | None = None
        self._turned, self._felt_m, self._drop_at_s = False, 0.0, inf
        self._flagged = dict[int, str]()
        self._belt_seen, self._arrived_cycles, self._on_belt = True, 0, np.eye(4)
        self.cell.arm.start()

    def run(self) -> list[Packed]:
        """Pack all packages; return what became of them."""
        self._feed()
        packed = [
            Packed(package.number, package.product, package.friction) for package in self._packages
        ]
        for each in packed:
            self._flagged.clear()
            began_s = self.cell.time_s
            self.pack(each, packed)
            self._feed_after(each.number)
            done = {each.number}
            while (place := worst(self._flagged, but=done)) is not None:
                done.add(place)
                self.pack(packed[place], packed, request="look")
            each.cycle_s = self.cell.time_s - began_s
        truth = self.cell.truth().packages
        for each in packed:
            self._finish(each, truth)
        return packed

    # One package

    def pack(self, packed: Packed, all_packed: Sequence[Packed], *, request: str = "pack") -> None:
        """Do what is to be done about one package until it stands, or the operator was asked.

        Args:
            packed: The package; gets the steps.
            all_packed: All packages; get the verdicts on their places.
            request: What to begin with: "pack", or "look" at one that is on the tray.
        """
        number = packed.number
        tried, short_mm = dict[str, int](), 0.0
        self._felt_m = 0.0
        while request:
            began_s, before = self.cell.time_s, self._states()
            stages, case = self._act(request, number, short_mm)
            knock = self._knocked(number)
            self._run_net(aside_net(turned=self._turned))
            seen = self._look(number, all_packed)
            if knock is not None:
                packed.knock = knock.kind
                self._watch(number, "error")
            case = self._case(case, number, seen, tried)
            reaction = react(case)
            packed.rejected = request == "reject" and case.success and seen.verdict == "missing"
            if packed.rejected:
                reaction = Reaction("go_on", "it is in the reject bin")
            choice = self._asked(reaction, case, packed)
            after = self._states()
            harmed = [n for n in before if n != number and badness(after[n]) > badness(before[n])]
            if choice == "replaced":
                self._replace(packed, all_packed)
            step = Step(
                request, tuple(stages), case.success, reaction.kind, reaction.reason, choice,
                self.cell.time_s - began_s, before.get(number, "coming"),
                after.get(number, "coming"), len(harmed), self.cell.time_s,
            )  # fmt: skip
            packed.steps.append(step)
            self._told(f"{number} {packed.product}: {step}")
            again = choice if choice in STAGES else reaction.kind
            request = again if again in STAGES else ""
            short_mm = max(0.0, -case.along_mm)
            self._felt_m = felt_on(self._felt_m, case.result, self._grasps[packed.product])
            if request:
                tried[request] = tried.get(request, 0) + 1
        if packed.rejected:
            self._drop_place(number)
        if packed.knock:
            self._watch(number, "after")

    def _knocked(self, number: int) -> Knock | None:
        """Let happen to a package what is to happen to it, once; return what it was, if it was."""
        knock = self._knocks.get(number)
        if knock is None or number not in self._put:
            return None
        del self._knocks[number]
        if knock.kind != "missing" and self.cell.truth().packages[number].where == "tray":
            self._watch(number, "before")
            push = self.layout.base_from_tray[:3, :3] @ self.slots[number].push
            knock_at(self.cell, self._packages[number], knock, push)
            self._rest(SETTLING_CYCLES)
        return knock

    def _planned(self) -> list[Slot]:
        """Return the place of each package; one that was rejected keeps its old one."""
        staying = [package for package in self._packages if package.number not in self._gone]
        rows = planned_rows([each.product for each in staying], self._sizes, self._contacts)
        found = dict(zip((each.number for each in staying), rows, strict=True))
        return [found.get(n) or self.slots[n] for n in range(len(self._packages))]

    def _set_places(self) -> None:
        for number, slot in enumerate(self.slots):
            pose = self.layout.base_from_tray @ slot.tray_from_product
            self._frames[f"place/{number}"] = pose

    def _drop_place(self, number: int) -> None:
        """Leave no gap where a package was rejected: the places after it are planned anew."""
        self._gone.add(number)
        self._flagged.pop(number, None)
        self.slots = self._planned()
        self._set_places()

    def _act(
        self, request: str, number: int, short_mm: float
    ) -> tuple[list[tuple[str, str]], Case]:
        """Run the nets of a request; return their results, and how the last one ended."""
        stages: list[tuple[str, str]] = []
        if request == "pack" and not self._comes(number):
            return stages, Case("grasp_from_belt", "not_seen", success=False)
        if request in {"pack", "retry"}:
            grasp = self._grasps[self._packages[number].product]
            self._frames[f"package/{number}"] = felt(self._on_belt, grasp, self._felt_m)
        job = self._job(number)
        if request == "push_again":
            job = replace(job, gap_m=gap_before(short_mm / 1e3))
        success, result = True, "seen"
        for skeleton in STAGES[request]:
            if skeleton == "push_into_contact" and not self.slots[number].push.any():
                continue
            if skeleton in {"grasp_from_belt", "regrasp"}:
                near = self.cell.arm.measured().q
                turned = easier_turn(job, arm=ARM, frames=self._frames.__getitem__, near_rad=near)
                self._turned = turned
                job = replace(job, turned=turned)
            if skeleton == "place":
                self._put.add(number)
                if number in self._knocks and self._knocks[number].kind == "missing":
                    self._watch(number, "before")
                    self._drop_at_s = self.cell.time_s + self._knocks[number].amount
            result, success = self._execute(skeleton, job)
            stages.append((skeleton, result))
            if not success:
                break
            if skeleton == "place":
                self._feed_after(number)
        return stages, Case(stages[-1][0] if stages else request, result, success)

    def _job(self, number: int) -> Job:
        slot, product = self.slots[number], self._packages[number].product
        return Job(
            package=f"package/{number}",
            grasp=self._grasps[product],
            size_m=self._sizes[product],
            place=f"place/{number}",
            push=self.layout.base_from_tray[:3, :3] @ slot.push,
            bin="bin",
            turned=self._turned,
            product=product,
            beside=tuple(
                (entity, self._frames[entity], self._sizes[self._packages[other].product])
                for other, seen in self.watch.seen.items()
                if other not in {number, *self._gone} and seen.pose is not None
                for entity in [f"package/{other}"]
            ),
        )

    def _execute(self, skeleton: str, job: Job) -> tuple[str, bool]:
        """Ground a skeleton and execute its net; return its result and whether it succeeded."""
        frames, arm = self._frames.__getitem__, self.cell.arm
        try:
            net = ground(
                skeleton, job, arm=ARM, gripper=Gripper(), frames=frames, near_rad=arm.measured().q
            )
        except NetError as error:
            return f"{NO_NET} {error}", False
        return self._run_net(net)

    def _run_net(self, net: Net) -> tuple[str, bool]:
        arm = self.cell.arm
        executor = Executor(
            net, ARM, self._frames.__getitem__,
            posture_rad=np.array(HOME_RAD), from_rad=self._last_rad,
        )  # fmt: skip
        while True:
            command = executor.step(arm.measured(), self.cell.time_s)
            self._last_rad = command.q
            arm.command(command.q)
            if command.grip is not None and command.grip.kind == "width":
                arm.grip_width(command.grip.value, HELD_N)
            elif command.grip is not None:
                arm.grip_force(command.grip.value)
            self._cycle()
            if command.result and command.at_rest:
                return command.result, bool(net.outcome(command.result))

    def _rest(self, cycles: int = 1) -> None:
        """Let time pass, the arm where it is."""
        for _ in range(cycles):
            if self._last_rad is not None:
                self.cell.arm.command(self._last_rad)
            self._cycle()

    def _cycle(self) -> None:
        """Let one cycle pass; take pictures of the belt while a package stands there unseen."""
        if self.cell.time_s >= self._drop_at_s:
            self.cell.fail("gripper", OPEN_S)
            self._drop_at_s = inf
        self.cell.step()
        if not self._belt_seen and self.cell.arrived():
            self._arrived_cycles += 1
            if self._arrived_cycles % FRAME_CYCLES == 0:
                self._pictures.append(self._belt.capture(0))
                self._belt_seen = len(self._pictures) == FRAMES

    # Seeing

    def _feed(self) -> None:
        self.cell.feed()
        self.cell.run_belt()
        self._pictures, self._belt_seen, self._arrived_cycles = [], False, 0

    def _feed_after(self, number: int) -> None:
        """Let the package after this one come, unless it has."""
        if self._is_newest(number) and self.cell.coming:
            self._feed()

    def _is_newest(self, number: int) -> bool:
        """Return whether no package has come after one: later, the next one may lie there."""
        return self.cell.coming == len(self._packages) - number - 1

    def _comes(self, number: int) -> bool:
        """Wait until a package stands in the light barrier; return whether it is the right one."""
        until_s = self.cell.time_s + WAIT_S
        while not self._belt_seen and self.cell.time_s < until_s:
            self._rest()
        sight = self._sight(number, self._pictures) if self._belt_seen else None
        return sight is not None and sight.known

    def _look_at_belt(self, number: int) -> BeltSight | None:
        """Take new pictures of the belt; return what may be this package, None if nothing is."""
        pictures = []
        for _ in range(FRAMES):
            self._rest(FRAME_CYCLES)
            pictures.append(self._belt.capture(number))
        return self._sight(number, pictures)

    def _sight(self, number: int, pictures: Sequence[DepthFrame]) -> BeltSight | None:
        sight = self._belt_watch.sight(fused(pictures), self._packages[number].product)
        if sight is not None and sight.known:
            self._on_belt = self.layout.base_from_belt @ sight.belt_from_product
        return sight

    def _look(self, number: int, all_packed: Sequence[Packed]) -> Seen:
        """Look at the tray, judge each place whose neighbourhood has changed; return this one's."""
        places = {
            each: (self._packages[each].product, self.slots[each].tray_from_product)
            for each in range(number + 1)
            if each not in self._gone
        }
        pictures = []
        for _ in range(FRAMES):
            self._rest(FRAME_CYCLES)
            pictures.append(self._tray.capture(number))
        found = self.watch.judged(fused(pictures), places, newest=number)
        truth = self.cell.truth().packages
        for place, seen in found.items():
            # An empty place that nothing came to, and what a person has put down, prove little.
            empty = place not in self._put and seen.verdict == "missing"
            if not empty and place not in self._by_hand:
                all_packed[place].judgements.append(self._judgement(place, seen, truth[place]))
        for place, seen in found.items():
            self._flagged[place] = seen.verdict
            if seen.pose is not None:
                self._frames[f"package/{place}"] = self.layout.base_from_tray @ seen.pose
        return found[number]

    def _case(self, case: Case, number: int, seen: Seen, tried: Mapping[str, int]) -> Case:
        """Return the case with what was seen."""
        grasp = self._grasps[self._packages[number].product]
        width_m = self.cell.arm.measured().width_m
        held = self.cell.arm.gripping and fills(width_m, grasp)
        where = "hand" if held else "tray" if seen.verdict != "missing" else ""
        unfit = ""
        if not where and self._is_newest(number):
            sight = self._look_at_belt(number)
            where, unfit = ("", "") if sight is None else ("belt", sight.unfit)
        along = across = 0.0
        if seen.pose is not None:
            along, across = along_and_across(self.slots[number], seen.pose)
        return replace(
            case, verdict=seen.verdict, along_mm=along, across_mm=across, turn_deg=seen.turn_deg,
            seen=where, tried=dict(tried), unfit=unfit,
        )  # fmt: skip

    # The operator

    def _asked(self, reaction: Reaction, case: Case, packed: Packed) -> str:
        """Return what the operator chose, who answers by rule and sets right what he touches."""
        if reaction.kind not in {"ask", "stop"}:
            return ""
        packed.by_hand = True
        return "replaced"

    def _replace(self, packed: Packed, all_packed: Sequence[Packed]) -> None:
        """Let a person put a sound package to a place, and look at what is there then.

        The person also puts back what else does not stand where it should.
        """
        number = packed.number
        states = self._states()
        off = [n for n in sorted(self._put - self._gone) if n != number and states[n] != "ok"]
        for each in [number, *(n for n in off if states[n] in KINDS)]:
            self._note_dents(all_packed[each])
            all_packed[each].by_hand = True
            self._by_hand.add(each)
            pose = self.layout.base_from_tray @ self.slots[each].tray_from_product
            self.cell.replace(each, pose)
        self._rest(SETTLING_CYCLES)
        self._look(number, all_packed)

    # The truth, for the score

    def _states(self) -> dict[int, str]:
        """Return what is true of all packages that have come."""
        return {
            truth.number: state_of(truth, self.slots[truth.number].tray_from_product)
            for truth in self.cell.truth().packages
            if truth.where != "coming"
        }

    def _note_dents(self, packed: Packed) -> None:
        dents = self.cell.truth().packages[packed.number].dents
        packed.dents_mm += tuple(dent.depth_mm for dent in dents)
        packed.dented_by += tuple(dent.by for dent in dents)

    def _judgement(self, place: int, seen: Seen, truth: PackageTruth) -> Judgement:
        planned = self.slots[place].tray_from_product
        shift_m, turn_rad = truth.beside_plan(planned)
        error_m = float("nan")
        if seen.pose is not None:
            error_m = float(np.hypot(*(seen.pose - truth.tray_from_product)[:2, 3]))
        return Judgement(
            place=place,
            verdict=seen.verdict,
            truth=truth_of(truth, planned),
            shift_mm=1e3 * shift_m,
            turn_deg=float(np.degrees(turn_rad)),
            pose_error_mm=1e3 * error_m,
            dent_mm=top_dent_mm(truth),
            at_s=self.cell.time_s,
        )

    def _finish(self, packed: Packed, truth: Sequence[PackageTruth]) -> None:
        own, slot = truth[packed.number], self.slots[packed.number]
        self._note_dents(packed)
        if own.where != "tray":
            return
        off = coordinates(slot.tray_from_product, own.tray_from_product)
        packed.along_mm, packed.across_mm = along_and_across(slot, own.tray_from_product)
        packed.turn_deg = float(np.degrees(off[5]))
        if slot.push.any():
            packed.gap_mm = 1e3 * gap_m(packed.number, self.slots, truth)
