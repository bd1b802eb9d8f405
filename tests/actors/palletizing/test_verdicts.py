"""Claims about verdicts, on simulated packages with a known truth."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("open3d", exc_type=ImportError)

from actors.palletizing.evaluation import confusion, graded, judge
from actors.palletizing.simulation.packages import (
    KINDS,
    VERDICT_OF_KIND,
    Truth,
    on_the_tray,
    package_sequence,
)
from actors.palletizing.simulation.sensors import SimulatedTraySensor

SEED = 59
PRODUCTS = ("milk_carton", "meal_tray")


@pytest.fixture(scope="module")
def cases(trained):
    """Twelve packages, two trays, judged with the trained surfaces."""
    packages = package_sequence(12, seed=SEED)
    return judge(packages, {name: trained(name) for name in PRODUCTS}, seed=SEED)


def test_verdicts_of_a_mixed_sequence_are_right(cases):
    """All 12 verdicts are those of the truth; the sequence holds sound and deviating packages."""
    assert {case.package.truth.kind for case in cases} >= {"ok", "dent", "moved", "missing"}
    assert all(case.correct for case in cases), confusion(cases)


def test_sound_packages_are_found_where_they_stand(cases):
    """The registered position of a sound package is right within 3 mm."""
    errors = [case.pose_error_mm for case in cases if case.package.truth.kind == "ok"]

    assert max(errors) < 3.0


def test_verdicts_do_not_depend_on_the_truth_labels(trained, cases):
    """With all labels swapped every finding stays as it was, only the score changes."""
    models = {name: trained(name) for name in PRODUCTS}
    packages = [case.package for case in cases[:4]]
    swapped = [dataclasses.replace(package, truth=Truth("missing", 0.0)) for package in packages]

    again = judge(swapped, models, seed=SEED)

    for case, other in zip(cases, again, strict=False):
        assert other.finding.verdict == case.finding.verdict
        assert other.finding.deviation_mm == case.finding.deviation_mm
    assert not all(case.correct for case in again)


@pytest.mark.parametrize(
    ("kind", "amount"), [("dent", 5), ("bulge", 5), ("crush", 10), ("moved", 20)]
)
def test_least_deviation_is_found(trained, kind, amount):
    """The smallest deviation that is promised is found on both products."""
    packages = graded(kind, amount, 2, seed=3, products=PRODUCTS)

    found = judge(packages, {name: trained(name) for name in PRODUCTS}, seed=3)

    assert [case.finding.verdict for case in found] == [VERDICT_OF_KIND[kind]] * 2


@pytest.mark.parametrize(("kind", "amount"), [("dent", 1), ("moved", 3)])
def test_what_the_sensor_cannot_see_is_not_claimed(trained, kind, amount):
    """A dent of half the sensor's spread and a shift of 3 mm raise no alarm."""
    packages = graded(kind, amount, 2, seed=3, products=PRODUCTS)

    found = judge(packages, {name: trained(name) for name in PRODUCTS}, seed=3)

    assert [case.finding.verdict for case in found] == ["ok", "ok"]


def test_dent_is_measured(trained):
    """The reported depth of a dent of 12 mm is right within 3 mm, its region lies on the product."""
    packages = graded("dent", 12, 1, seed=6, products=["milk_carton"])

    (case,) = judge(packages, {"milk_carton": trained("milk_carton")}, seed=6)

    assert case.finding.deviation_mm == pytest.approx(12.0, abs=3.0)
    assert case.finding.region.sum() > 100


def test_sequence_is_a_function_of_the_seed():
    """The same seed gives the same packages and images, another seed others."""
    one, same, other = (package_sequence(4, seed=seed) for seed in (5, 5, 6))

    images = [SimulatedTraySensor(each, seed=5).capture(3).depth_mm for each in (one, same, other)]

    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0] != images[2]).any()


def test_packages_never_penetrate_each_other():
    """No two things on a tray overlap, whatever is drawn."""
    for packages in (
        package_sequence(160, seed=9),
        graded("moved", 40.0, 16, seed=4, products=PRODUCTS),
    ):
        for stop in range(7, len(packages), 8):
            boxes = [
                (mesh[0][:, :2].min(axis=0), mesh[0][:, :2].max(axis=0))
                for package in on_the_tray(packages, stop)
                for mesh in package.meshes()
            ]
            for number, (low, high) in enumerate(boxes):
                for other_low, other_high in boxes[:number]:
                    assert (low >= other_high).any() or (other_low >= high).any()


def test_sequence_holds_every_kind():
    """A long sequence holds all deviations, and about as many sound packages."""
    kinds = [package.truth.kind for package in package_sequence(200, seed=1)]

    assert set(kinds) == {"ok", *KINDS}
    assert 80 < kinds.count("ok") < 120
