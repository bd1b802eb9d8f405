"""Faults have names, runs repeat with some of them, failures become small."""

from __future__ import annotations

import mutants
import mutants_one_shard as one
import mutants_over_shards as over
import pytest

from enact_dist.cli.main import build_parser
from enact_dist.verify.simulation.command import part_of
from enact_dist.verify.simulation.scenario import Scenario
from enact_dist.verify.simulation.schedule import WHOLE, PartOfRun
from enact_dist.verify.simulation.shrink import command, reduced, shrink


def run(seed, part=WHOLE):
    return Scenario(seed, part=part, through_wire=False, asserts=False).run()


def failing():
    """Return the first run that breaks a rule after there was much to leave out."""
    results = (run(seed) for seed in range(400))
    return next(r for r in results if r.violation and len(r.faults) > 30 and len(r.locks) > 15)


@pytest.mark.parametrize("needed", [set(), {3}, {3, 17, 18}, set(range(40))])
def test_list_is_reduced_to_what_is_needed(needed):
    """Delta debugging leaves exactly what the failure needs, in its order."""
    names = [str(number) for number in range(40)]

    def keep(some):
        return some if needed <= {int(name) for name in some} else None

    assert reduced(names, keep) == [name for name in names if int(name) in needed]


def test_run_with_all_its_faults_and_locks_is_the_same_run():
    """A part that leaves nothing out changes nothing."""
    whole = run(11)
    part = PartOfRun(
        only=frozenset(fault.name for fault in whole.faults),
        locks=frozenset(whole.locks),
        until_s=25.0,
    )

    again = run(11, part)
    assert len(whole.faults) > 20
    assert (again.faults, again.locks, again.simulated_s) == (
        whole.faults,
        whole.locks,
        whole.simulated_s,
    )
    # A fault that found nothing to do (a crash of a shard that was down) is not planned again.
    planned = whole.tally["events"] - again.tally["events"]
    assert planned in range(5)
    assert again.tally - whole.tally == {}


def test_run_without_faults_has_none():
    """Every fault of a run has a name: with an empty list nothing goes wrong."""
    tally = run(11, PartOfRun(only=frozenset())).tally

    assert tally["commits"] > 0
    for name in ("lost", "duplicated", "delayed", "crashes", "power cuts", "pauses", "cut"):
        assert tally[name] == 0
    for name in ("late answers", "slow disk batches", "dispatchers stalled", "clients killed"):
        assert tally[name] == 0


def test_fault_that_is_left_out_changes_nothing_before_it():
    """Places have luck of their own: up to the fault that is left out, two runs are one."""
    whole = run(11)
    gone = whole.faults[len(whole.faults) // 2]
    rest = run(11, PartOfRun(only=frozenset(f.name for f in whole.faults if f is not gone)))

    before = [fault for fault in whole.faults if fault.at_ns < gone.at_ns]
    assert len(before) > 10
    assert [fault for fault in rest.faults if fault.at_ns < gone.at_ns] == before
    assert gone.name not in {fault.name for fault in rest.faults}


@pytest.mark.parametrize("mutant", [over.forgets_decisions_at_a_restart, one.expects_in_vain])
def test_failure_shrinks_to_a_short_schedule_of_the_same_rule(mutant):
    """What is left breaks the same rule and is much smaller, in faults and in locks."""
    with mutants.planted(mutant):
        whole = failing()
        small = shrink(whole, seconds=120.0, run=run)
        again = run(whole.seed, small.part)

    assert again == small.result
    assert again.rule == whole.rule
    assert len(again.faults) <= len(whole.faults) // 3
    assert len(again.locks) <= len(whole.locks) * 2 // 3
    assert small.command.startswith(f"enact verify --seed {whole.seed} --only ")
    assert run(whole.seed, small.part).violation == ""


@pytest.mark.parametrize(
    "part",
    [
        WHOLE,
        PartOfRun(only=frozenset()),
        PartOfRun(
            only=frozenset({"crash.1", "c1-s0.37"}), locks=frozenset({"c1/0.5", "c2_1/1.12"})
        ),
        PartOfRun(clients=frozenset({1, 3}), until_s=3.5),
    ],
)
def test_printed_command_asks_for_the_same_part(part):
    """The line that is printed can be typed."""
    words = command(17, part).split()

    assert words[:2] == ["enact", "verify"]
    arguments = build_parser().parse_args(words[1:])
    assert arguments.seed == 17
    assert part_of(arguments) == part
