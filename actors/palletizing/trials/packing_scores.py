"""Score the whole palletizing cell on what physics did: placements, verdicts, reactions, times.

`enact bench palletizing` packs trays of packages in simulated time, over settings of how far the
belt's sensor is off and of friction, and prints each figure with its goal and the table of true
kinds against verdicts.  The same arguments give the same figures on any machine, whatever the
number of processes.

Rules a change must keep: what was tuned was tuned on seeds below `HELD_OUT`; scores are of others.
How well the robot packs is scored on trays on which nothing was provoked, verdicts and recoveries
on all.  What has no case has no figure: it neither meets nor misses its goal.
"""

from __future__ import annotations

import json
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.palletizing.handling.reactions import NO_NET
from actors.palletizing.simulation.knocks import draw_knocks
from actors.palletizing.simulation.packages import DEMO_PRODUCTS
from actors.palletizing.simulation.physical_packages import Spread, draw_packages
from actors.palletizing.simulation.physics import OUTSIDE
from actors.palletizing.simulation.sensors import SimulatedOrbitSensor
from actors.palletizing.trials.evaluation import train
from actors.palletizing.trials.packing import Packing
from actors.palletizing.trials.packing_pictures import Strips
from actors.palletizing.trials.packing_records import line_of, packed_of
from actors.palletizing.trials.truth import DENTED, KINDS, SOUND_MM, badness
from actors.workcell.scores.evaluation import Goal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from actors.geometry.shapes import Surface
    from actors.palletizing.trials.packing_records import Judgement, Packed, Step

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
NOTED: Final = "trays.jsonl"
"""File with a line of JSON per packed tray."""
EVERY: Final = 4
"""Of so many trays one is disturbed, if errors are to be provoked; no divisor of the number of
settings, so that each of them has its turn."""

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
    "dented": Goal("places with a dent of 1.5 to 4 mm"),
    "dented_flagged_share": Goal("of these flagged as deformed, share"),
    "flagged_share": Goal("deviations that were flagged, as whatever kind, share", low=0.99),
    "provoked": Goal("packages that an error was provoked of"),
    "recoveries": Goal("recoveries tried"),
    "refused": Goal("recoveries that the robot refused before it moved"),
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
        provoked: Errors that each package is provoked to in turn, see `simulation.knocks`.
    """

    seed: int
    sigma_mm: float
    friction: float
    count: int
    products: tuple[str, ...]
    provoked: tuple[str, ...] = ()


def trays_of(
    packages: int,
    *,
    seed: int = 1,
    settings: Sequence[tuple[float, float]] = SETTINGS,
    products: Sequence[str] = DEMO_PRODUCTS,
    provoke: Sequence[str] = (),
) -> list[Tray]:
    """Return the trays of a run: the settings in turn, the last tray perhaps not full.

    Args:
        packages: How many, all trays together.
        seed: The first tray has `HELD_OUT` times that.
        settings: How far the belt's sensor is off (mm), and friction.
        products: That come in turn.
        provoke: Errors that are provoked on one of `EVERY` trays.
    """
    trays = []
    for number, begun in enumerate(range(0, packages, TRAY)):
        provoked = tuple(provoke) if number % EVERY == EVERY - 1 else ()
        sigma_mm, friction = settings[number % len(settings)]
        count = min(TRAY, packages - begun)
        held_out = HELD_OUT * seed + number
        trays.append(Tray(held_out, sigma_mm, friction, count, tuple(products), provoked))
    return trays


def packed_tray(
    tray: Tray, models: Mapping[str, Surface], pictures: Path | None = None
) -> list[Packed]:
    """Pack one tray.

    Args:
        tray: What to pack.
        models: Trained surface of each product.
        pictures: Folder for pictures of what is provoked; none are drawn when absent.
    """
    spread = Spread(pick_m=tray.sigma_mm / 1e3, friction=(tray.friction, tray.friction))
    packages = draw_packages(tray.count, seed=tray.seed, products=tray.products, spread=spread)
    knocks = draw_knocks(tray.count, kinds=tray.provoked, seed=tray.seed)
    if not (pictures and knocks):
        return Packing(packages, models, seed=tray.seed, knocks=knocks).run()
    strips = Strips(pictures, tray.seed, knocks)
    packing = Packing(packages, models, seed=tray.seed, knocks=knocks, watch=strips.take)
    strips.of(packing.cell)
    return packing.run()


def played(
    trays: Sequence[Tray],
    *,
    processes: int = 1,
    told: Callable[[str], None] = lambda _: None,
    out: Path | None = None,
) -> dict[Tray, list[Packed]]:
    """Train the products and pack trays, in this process or in several.

    Args:
        trays: What to pack.
        processes: How many run side by side.
        told: Called with what is done.
        out: Folder; what became of each tray is added to its `trays.jsonl` at once, and pictures of
            the first tray on which errors are provoked are put there.  Trays that are there
            already are not packed again.
    """
    found = kept(out) if out else {}
    left = [tray for tray in trays if tray not in found]
    if len(left) < len(trays):
        told(f"{len(trays) - len(left)} of {len(trays)} trays are there already")
    drawn = next((tray for tray in trays if tray.provoked), None)
    for tray, packed in _packed(left, processes, told, out, drawn):
        found[tray] = packed
        asked = sum(each.by_hand for each in packed)
        told(
            f"tray {sum(tray in found for tray in trays)} of {len(trays)}: seed {tray.seed}, sigma"
            f" {tray.sigma_mm:g} mm, friction {tray.friction:g}, operator asked about {asked} of"
            f" {tray.count}"
        )
    return {tray: found[tray] for tray in trays}


def kept(folder: Path) -> dict[Tray, list[Packed]]:
    """Return what became of the trays that are noted in a folder, see `played`."""
    file = folder / NOTED
    found = {}
    for line in file.read_text().splitlines(keepends=True) if file.exists() else []:
        if not line.endswith("\n"):
            break  # the process was killed while it wrote this one
        noted = json.loads(line)
        lists = {name: tuple(noted["tray"][name]) for name in ("products", "provoked")}
        found[Tray(**{**noted["tray"], **lists})] = packed_of(json.dumps(noted["packed"]))
    return found


def _packed(
    trays: Sequence[Tray],
    processes: int,
    told: Callable[[str], None],
    out: Path | None,
    drawn: Tray | None,
) -> Iterator[tuple[Tray, list[Packed]]]:
    """Train the products, pack trays, note and yield each as soon as it is packed."""
    products = sorted({name for tray in trays for name in tray.products})
    if not trays:
        return
    told(f"training: {', '.join(products)}")
    models = {name: train(name, SimulatedOrbitSensor(seed=HELD_OUT), frames=4) for name in products}
    for tray, packed in _each(trays, models, processes, {drawn: out}):
        if out:
            _note(
                out / NOTED,
                f'{json.dumps({"tray": asdict(tray)})[:-1]}, "packed": {line_of(packed)}}}\n',
            )
        yield tray, packed


def _note(file: Path, line: str) -> None:
    """Add a line to a file, in place of a last one that was cut short."""
    with file.open("a+b") as noted:
        noted.seek(0)
        noted.truncate(noted.read().rfind(b"\n") + 1)
        noted.write(line.encode())


def _each(
    trays: Sequence[Tray],
    models: Mapping[str, Surface],
    processes: int,
    pictures: Mapping[Tray | None, Path | None],
) -> Iterator[tuple[Tray, list[Packed]]]:
    if processes < 2:
        for tray in trays:
            yield tray, packed_tray(tray, models, pictures.get(tray))
        return
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        waiting = {
            pool.submit(packed_tray, tray, models, pictures.get(tray)): tray for tray in trays
        }
        for done in as_completed(waiting):
            yield waiting[done], done.result()


def scores_of(found: Mapping[Tray, Sequence[Packed]]) -> dict[str, float | None]:
    """Return the scores of a run by their names in `GOALS`; None: there was no case."""
    every = [each for packed in found.values() for each in packed]
    own = [each for tray, packed in found.items() if not tray.provoked for each in packed]
    gentle = [
        each
        for tray, packed in found.items()
        if tray.sigma_mm <= GENTLE_MM and not tray.provoked
        for each in packed
    ]
    sound = [each for each in own if not each.by_hand and is_sound(each)]
    round_ones = {"yoghurt_cup"}
    judged = [judgement for each in every for judgement in each.judgements]
    cycles_s = [each.cycle_s for each in own]
    scores: dict[str, float | None] = {
        "packages": float(len(every)),
        "by_hand_share": _share(e.by_hand for e in own),
        "shift_p95_mm": _percentile([np.hypot(e.along_mm, e.across_mm) for e in sound], 95),
        "turn_p95_deg": _percentile(
            [abs(e.turn_deg) for e in sound if e.product not in round_ones], 95
        ),
        "gap_p50_mm": _percentile([abs(e.gap_mm) for e in sound if np.isfinite(e.gap_mm)], 50),
        "pose_p95_mm": _percentile(
            [j.pose_error_mm for j in judged if j.verdict == j.truth == "ok"], 95
        ),
        "cycle_p50_s": _percentile(cycles_s, 50),
        "cycle_p95_s": _percentile(cycles_s, 95),
        "damaged_gentle": float(sum(map(is_damaged, gentle))) if gentle else None,
        "damaged": float(sum(map(is_damaged, own))) if own else None,
        "alarms_share": _share(j.verdict != "ok" for j in judged if _row_of(j) == "ok"),
        "dented": float(sum(_row_of(j) == DENTED for j in judged)),
        "dented_flagged_share": _share(
            j.verdict == "deformed" for j in judged if _row_of(j) == DENTED
        ),
        "flagged_share": _share(j.verdict != "ok" for j in judged if j.truth != "ok"),
        "provoked": float(sum(bool(each.knock) for each in every)),
    }
    scores |= _recoveries(every)
    table = confusion(found)
    for kind in KINDS[1:]:
        true = sum(n for (truth, _), n in table.items() if truth == kind)
        flagged = sum(n for (_, verdict), n in table.items() if verdict == kind)
        flagged -= table[DENTED, kind] if kind == "deformed" else 0
        scores[f"{kind}_cases"] = float(true)
        scores[f"{kind}_recall_share"] = table[kind, kind] / true if true else None
        scores[f"{kind}_precision_share"] = table[kind, kind] / flagged if flagged else None
    return {name: scores[name] for name in GOALS}


def missed(scores: Mapping[str, float | None]) -> list[str]:
    """Return the names of the scores that do not meet their goals; what has no case is none."""
    return [n for n, value in scores.items() if value is not None and not GOALS[n].met(value)]


def confusion(found: Mapping[Tray, Sequence[Packed]]) -> Counter[tuple[str, str]]:
    """Return how often each true kind was judged as each verdict; see `DENTED`."""
    return Counter(
        (_row_of(judgement), judgement.verdict)
        for packed in found.values()
        for each in packed
        for judgement in each.judgements
    )


def confusion_text(table: Mapping[tuple[str, str], int]) -> str:
    """Return the table of true kinds (down) against verdicts (across)."""
    verdicts = [*KINDS, "extra"]
    lines = ["truth     " + "".join(f"{verdict:>10}" for verdict in verdicts)]
    for kind in ("ok", DENTED, *KINDS[1:]):
        row = [table.get((kind, verdict), 0) for verdict in verdicts]
        if sum(row):
            lines.append(f"{kind:<10}" + "".join(f"{count or '.':>10}" for count in row))
    return "\n".join(lines)


def _row_of(judgement: Judgement) -> str:
    """Return what was true of a place, as a row of the table."""
    slight = judgement.truth == "ok" and judgement.dent_mm >= SOUND_MM
    return DENTED if slight else judgement.truth


def is_sound(packed: Packed) -> bool:
    """Return whether a package stands where it should in the end, undamaged as far as one sees."""
    last = packed.steps[-1].after if packed.steps else ""
    return last == "ok" and bool(np.isfinite(packed.along_mm))


def is_damaged(packed: Packed) -> bool:
    """Return whether a package has, or had until it was replaced, a dent of the cell's making."""
    dents = zip(packed.dents_mm, packed.dented_by, strict=True)
    return any(depth_mm >= DAMAGE_MM and by != OUTSIDE for depth_mm, by in dents)


def _recoveries(packages: Sequence[Packed]) -> dict[str, float | None]:
    steps = [step for each in packages for step in each.steps]
    knocked = [_knocked(each) for each in packages if each.knock]
    # A knock right after a package was put down is not held against the request that put it there.
    asked = [step for step in steps if step.request in RECOVERIES and step not in knocked]
    tried = [step for step in asked if not _is_refused(step)]
    worse = [s for s in tried if s.harmed or badness(s.after) > badness(s.before)]
    noticed = [s for s in steps if s.stages and not (s.succeeded or _has_no_net(s.stages[-1]))]
    return {
        "recoveries": float(len(tried)),
        "refused": float(len(asked) - len(tried)),
        "recovered_share": _share(step.after == "ok" for step in tried),
        "worsened": float(len(worse)) if tried else None,
        "noticed_by_net": float(len(noticed)),
    }


def _is_refused(step: Step) -> bool:
    """Return whether no net ran: nothing was recognised, or none could be grounded."""
    return all(map(_has_no_net, step.stages))


def _has_no_net(stage: tuple[str, str]) -> bool:
    """Return whether no net could be grounded for a stage."""
    return stage[1].startswith(NO_NET)


def _knocked(packed: Packed) -> Step | None:
    """Return the step in which a package was knocked: the first that put it down."""
    placing = (s for s in packed.steps if any(stage == "place" for stage, _ in s.stages))
    return next(placing, None)


def _share(holds: Iterable[bool]) -> float | None:
    values = list(holds)
    return sum(values) / len(values) if values else None


def _percentile(values: Sequence[float], share: int) -> float | None:
    return float(np.percentile(values, share)) if len(values) else None
