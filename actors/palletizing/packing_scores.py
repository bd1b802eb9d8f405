"""Score the whole palletizing cell on what physics did: placements, verdicts, reactions, times.

    python -m actors.palletizing.packing_scores --packages 36 --seed 1

packs trays of packages in simulated time, over settings of how far the belt's sensor is off and of
friction, and prints each figure with its goal and the table of true kinds against verdicts.  The
same arguments give the same figures on any machine, whatever the number of processes.

Rule a change must keep: what was tuned was tuned on seeds below `HELD_OUT`; scores are of others.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.palletizing.evaluation import train
from actors.palletizing.packing import Packed, Packing
from actors.palletizing.packing_truth import KINDS
from actors.palletizing.simulation.packages import DEMO_PRODUCTS
from actors.palletizing.simulation.physical_packages import Spread, draw_packages
from actors.palletizing.simulation.sensors import SimulatedOrbitSensor
from actors.workcell.evaluation import Goal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from actors.geometry.shapes import Surface
    from actors.palletizing.packing import Step

HELD_OUT: Final = 1000
TRAY: Final = 12
"""Packages of one tray."""
SETTINGS: Final = tuple(
    (sigma_mm, friction) for sigma_mm in (2.0, 6.0, 12.0) for friction in (0.2, 0.4, 0.6)
)
"""How far the belt's sensor is off (one sigma, mm), and friction."""
GENTLE_MM: Final = 2.0
"""Up to that sigma the robot may damage nothing."""
DAMAGE_MM: Final = 1.0
"""Depth of a dent from which a package counts as damaged."""
RECOVERIES: Final = ("retry", "regrasp", "push_again")
WORSE: Final = {"ok": 0, "belt": 1, "held": 1, "moved": 1, "missing": 2, "bin": 2}
"""How bad a state is; all others are worse."""

GOALS: Final = {
    "packages": Goal("packages"),
    "by_hand_share": Goal("packages that the operator had to touch, share"),
    "shift_p95_mm": Goal("sound placements, distance from the plan, p95, mm", high=3.0),
    "turn_p95_deg": Goal("sound placements, turn, p95, degrees", high=1.5),
    "gap_p50_mm": Goal("gap to the neighbour after the push, median, mm", high=1.0),
    "pose_p95_mm": Goal("pose of sound packages as seen, p95, mm", high=0.5),
    "cycle_p50_s": Goal("cycle, simulated, median, s", high=10.0),
    "cycle_p95_s": Goal("cycle, simulated, p95, s"),
    "damaged_gentle": Goal("packages damaged at sigma 2 mm", 0, 0),
    "damaged": Goal("packages damaged"),
    "alarms_share": Goal("sound packages that were flagged, share", high=0.001),
    "recoveries": Goal("recoveries tried"),
    "recovered_share": Goal("recoveries that worked, share", low=0.9),
    "worsened": Goal("recoveries that made it worse, the operator not asked", 0, 0),
    "noticed_by_net": Goal("failures that the net noticed before the camera"),
}
for _kind in KINDS[1:]:
    GOALS[f"{_kind}_cases"] = Goal(f"{_kind}: cases")
    GOALS[f"{_kind}_recall_share"] = Goal(f"{_kind}: recall, share", low=0.99)
    GOALS[f"{_kind}_precision_share"] = Goal(f"{_kind}: precision, share", low=0.99)


@dataclass(frozen=True, slots=True)
class Tray:
    """One tray to pack.

    Attributes:
        seed: Of everything random on it.
        sigma_mm: How far the belt's sensor is off.
        friction: Of all packages.
        count: Packages on it.
        products: That come in turn.
    """

    seed: int
    sigma_mm: float
    friction: float
    count: int
    products: tuple[str, ...]


def trays_of(
    packages: int,
    *,
    seed: int = 1,
    settings: Sequence[tuple[float, float]] = SETTINGS,
    products: Sequence[str] = DEMO_PRODUCTS,
) -> list[Tray]:
    """Return the trays of a run: the settings in turn, the last tray perhaps not full."""
    trays = []
    for number, begun in enumerate(range(0, packages, TRAY)):
        sigma_mm, friction = settings[number % len(settings)]
        count = min(TRAY, packages - begun)
        trays.append(Tray(HELD_OUT * seed + number, sigma_mm, friction, count, tuple(products)))
    return trays


def packed_tray(tray: Tray, models: Mapping[str, Surface]) -> list[Packed]:
    """Pack one tray."""
    spread = Spread(pick_m=tray.sigma_mm / 1e3, friction=(tray.friction, tray.friction))
    packages = draw_packages(tray.count, seed=tray.seed, products=tray.products, spread=spread)
    return Packing(packages, models, seed=tray.seed).run()


def played(
    trays: Sequence[Tray], *, processes: int = 1, told: Callable[[str], None] = lambda _: None
) -> dict[Tray, list[Packed]]:
    """Train the products and pack trays, in this process or in several.

    Args:
        trays: What to pack.
        processes: How many run side by side.
        told: Called with what is done.
    """
    products = sorted({name for tray in trays for name in tray.products})
    told(f"training: {', '.join(products)}")
    models = {name: train(name, SimulatedOrbitSensor(seed=HELD_OUT), frames=4) for name in products}
    found = {}
    for tray, packed in _each(trays, models, processes):
        found[tray] = packed
        asked = sum(each.by_hand for each in packed)
        told(
            f"tray {len(found)} of {len(trays)}: seed {tray.seed}, sigma {tray.sigma_mm:g} mm,"
            f" friction {tray.friction:g}, operator asked about {asked} of {tray.count}"
        )
    return {tray: found[tray] for tray in trays}


def _each(
    trays: Sequence[Tray], models: Mapping[str, Surface], processes: int
) -> Iterator[tuple[Tray, list[Packed]]]:
    if processes < 2:
        for tray in trays:
            yield tray, packed_tray(tray, models)
        return
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        waiting = {pool.submit(packed_tray, tray, models): tray for tray in trays}
        for done in as_completed(waiting):
            yield waiting[done], done.result()


def scores_of(found: Mapping[Tray, Sequence[Packed]]) -> dict[str, float]:
    """Return the scores of a run by their names in `GOALS`; those without a case are left out."""
    every = [each for packed in found.values() for each in packed]
    gentle = [
        each for tray, packed in found.items() if tray.sigma_mm <= GENTLE_MM for each in packed
    ]
    sound = [each for each in every if not each.by_hand and is_sound(each)]
    scores = {"packages": float(len(every)), "by_hand_share": _share(e.by_hand for e in every)}
    shift_mm = [float(np.hypot(each.along_mm, each.across_mm)) for each in sound]
    scores |= _percentile("shift_p95_mm", shift_mm, 95)
    round_ones = {"yoghurt_cup"}
    turn_deg = [abs(each.turn_deg) for each in sound if each.product not in round_ones]
    scores |= _percentile("turn_p95_deg", turn_deg, 95)
    gaps_mm = [each.gap_mm for each in sound if np.isfinite(each.gap_mm)]
    scores |= _percentile("gap_p50_mm", np.abs(gaps_mm).tolist(), 50)
    judged = [judgement for each in every for judgement in each.judgements]
    pose_mm = [j.pose_error_mm for j in judged if j.verdict == j.truth == "ok"]
    scores |= _percentile("pose_p95_mm", pose_mm, 95)
    cycles_s = [each.cycle_s for each in every]
    scores |= _percentile("cycle_p50_s", cycles_s, 50) | _percentile("cycle_p95_s", cycles_s, 95)
    scores["damaged_gentle"] = float(sum(map(is_damaged, gentle)))
    scores["damaged"] = float(sum(map(is_damaged, every)))
    scores["alarms_share"] = _share(j.verdict != "ok" for j in judged if j.truth == "ok")
    scores |= _recoveries([step for each in every for step in each.steps])
    table = confusion(found)
    for kind in KINDS[1:]:
        true = sum(n for (truth, _), n in table.items() if truth == kind)
        flagged = sum(n for (_, verdict), n in table.items() if verdict == kind)
        scores[f"{kind}_cases"] = float(true)
        if true:
            scores[f"{kind}_recall_share"] = table[kind, kind] / true
        if flagged:
            scores[f"{kind}_precision_share"] = table[kind, kind] / flagged
    return {name: scores[name] for name in GOALS if name in scores}


def missed(scores: Mapping[str, float]) -> list[str]:
    """Return the names of the scores that do not meet their goals."""
    return [name for name, value in scores.items() if not GOALS[name].met(value)]


def confusion(found: Mapping[Tray, Sequence[Packed]]) -> Counter[tuple[str, str]]:
    """Return how often each true kind was judged as each verdict."""
    return Counter(
        (judgement.truth, judgement.verdict)
        for packed in found.values()
        for each in packed
        for judgement in each.judgements
    )


def confusion_text(table: Mapping[tuple[str, str], int]) -> str:
    """Return the table of true kinds (down) against verdicts (across)."""
    verdicts = [*KINDS, "extra"]
    lines = ["truth     " + "".join(f"{verdict:>10}" for verdict in verdicts)]
    for kind in KINDS:
        row = [table.get((kind, verdict), 0) for verdict in verdicts]
        if sum(row):
            lines.append(f"{kind:<10}" + "".join(f"{count or '.':>10}" for count in row))
    return "\n".join(lines)


def is_sound(packed: Packed) -> bool:
    """Return whether a package stands where it should in the end, undamaged as far as one sees."""
    last = packed.steps[-1].after if packed.steps else ""
    return last == "ok" and bool(np.isfinite(packed.along_mm))


def is_damaged(packed: Packed) -> bool:
    """Return whether a package has a dent that counts."""
    return max(packed.dents_mm, default=0.0) >= DAMAGE_MM


def _recoveries(steps: Sequence[Step]) -> dict[str, float]:
    tried = [step for step in steps if step.request in RECOVERIES]
    worse = [step for step in tried if _badness(step.after) > _badness(step.before)]
    noticed = [step for step in steps if step.stages and not step.succeeded]
    found = {"recoveries": float(len(tried))}
    if tried:
        found["recovered_share"] = _share(step.after == "ok" for step in tried)
    return found | {"worsened": float(len(worse)), "noticed_by_net": float(len(noticed))}


def _badness(state: str) -> int:
    return WORSE.get(state, 3)


def _share(holds: Iterable[bool]) -> float:
    values = list(holds)
    return sum(values) / len(values) if values else 0.0


def _percentile(name: str, values: Sequence[float], share: int) -> dict[str, float]:
    return {name: float(np.percentile(values, share))} if len(values) else {}


def main(argv: Sequence[str] | None = None) -> int:
    """Print scores and the table of verdicts; return 0, or 1 where a goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--packages", type=int, default=108)
    parser.add_argument("--seed", type=int, default=1, help=f"first tray: {HELD_OUT} times it")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--products", nargs="+", default=DEMO_PRODUCTS)
    parser.add_argument("--spread", type=setting, help="SIGMA_MM,FRICTION alone, such as 2,0.4")
    options = parser.parse_args(argv)
    settings = [options.spread] if options.spread else SETTINGS
    trays = trays_of(
        options.packages, seed=options.seed, settings=settings, products=options.products
    )
    found = played(
        trays, processes=options.processes, told=lambda text: print(text, file=sys.stderr)
    )
    scores = scores_of(found)
    print(confusion_text(confusion(found)))
    print(json.dumps({"scores": scores, "missed": missed(scores)}, indent=2))
    return int(bool(missed(scores)))


def setting(text: str) -> tuple[float, float]:
    """Read "SIGMA_MM,FRICTION"; an `argparse` type."""
    try:
        sigma_mm, friction = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"asked for {text!r}; a setting is SIGMA_MM,FRICTION, such as 2,0.4"
        ) from None
    return sigma_mm, friction


if __name__ == "__main__":
    sys.exit(main())
