"""The real core survives every seed: those that once broke it, and as many others as time allows.

`ENACT_SIM_SECONDS` (default 10) is how long each half of the fresh seeds goes on; two processes
run both halves at once.  The seeds are never the same twice.  `ENACT_SIM_FIRST` names the first
one, to repeat a series.
"""

from __future__ import annotations

import os

import pytest

from enact_dist.verify.simulation.command import told
from enact_dist.verify.simulation.scenario import Result, Scenario
from enact_dist.verify.simulation.series import Totals, fresh_seed, run_series
from enact_dist.verify.simulation.shrink import shrink

MISJUDGED = (7004196, 7005673, 9019225)
"""Seeds at which the judge was wrong: slots that only a prepared commit names were unknown to it, and
it took a version for one that a power failure had undone, whose stamp came again."""

WRONG = (1795934812665, 1795959492143, 1795962997662)
"""Seeds at which the core was wrong: it took the refusal of a second copy for the fate of the first;
a far grant that its client did not know of, as the answer was lost, stayed until somebody asked; so
did one whose answer came after the client had stopped listening.
"""

KNOWN_BAD = {
    "parks_without_a_look": 16,
    "counts_lost_updates_as_seen": 57,
    "keeps_one_outcome_per_session": 17,
    "blind_acknowledgement": 23,
    "makes_a_file_again_that_was_taken_back": 140,
    "makes_drafts_of_late_slices": 206,
    "believes_from_newest_sending": 22,
    "keeps_old_grants": 22,
    "surveys_before_its_own_commits": 50,
    "takes_the_first_views": 30,
    "views_do_not_wait_for_the_undecided": 30,
    "shows_what_was_deleted_outside_retention": 30,
    "takes_one_slot_for_the_whole_shard": 706,
    "counts_the_hold_from_its_own_grant": 121,
    "welcomes_early": 119,
    "believes_without_the_list": 80,
    "expects_beside_writers": 8,
    "forks_before_the_undecided": 9,
    "answers_about_the_past_at_once": 30,
    "does_not_notice_that_a_catalogue_changed": 31,
    "takes_late_copies": 17,
    "stays_after_no_answer": 76,
    "leaves_pages_of_an_earlier_start": 340,
    "asks_before_it_clears": 368,
    "keeps_grants_of_an_old_epoch": 35,
    "expires_early": 60,
    "forgets_decisions_too_early": 60,
}
"""Seeds at which wrong edits are caught that few seeds catch: those of `run_mutants.py`, less one.

The real core passes them, and each of these edits meets its own first.
"""

SECONDS = float(os.environ.get("ENACT_SIM_SECONDS", "10"))
HALVES = 2
SEEDS_MIN = 100
"""Even on a slow machine so many seeds run; fewer would prove nothing about rare events."""
SEEDS_MORE, SEEDS_MAX = 50, 3000
"""While something has not happened yet, so many run again, up to a number that shows it never does."""
SHRINK_S = 20.0

HAPPENED = (
    # What went wrong outside the core.
    "lost",
    "duplicated",
    "delayed",
    "overtaken",
    "cut",
    "partitions: both",
    "partitions: in",
    "partitions: out",
    "partitions: shards, both ways",
    "partitions: shards, one way",
    "crashes",
    "power cuts",
    "torn logs",
    "batches torn",
    "log prefixes replayed",
    "drains",
    "clients killed",
    "deaths proven",
    "goodbyes",
    "pauses",
    "pauses longer than the TTL",
    "pauses with token",
    "suspends",
    "dispatchers stalled",
    "keep-alives starved",
    "slow disk batches",
    "wall clocks set",
    "late answers",
    "faults set off",
    "calls without an answer",
    "epoch changes",
    # What the core did about it.
    "shard: fenced",
    "shard: epoch_refusals",
    "shard: orphans_freed",
    "shard: leases_expired",
    "shard: held_too_long",
    "shard: superseded",
    "shard: stale",
    "shard: stalls",
    "shard: waiters_dropped",
    "shard: grants_without_listener",
    "shard: commits_repeated",
    "shard: commits_changed",
    "shard: lock_waits",
    "commits lost as declared",
    # What it did about commits over shards.
    "locks that write on three shards",
    "decisions",
    "commits finished by participants",
    "prepared over a restart",
    "prepared and aborted",
    "shard: resolves_asked",
    "shard: finishes_repeated",
    "views over several slots checked",
    # What the clients were told, and did.
    "told: committed",
    "told: lost",
    "told: timed out",
    "told: unreachable",
    "told: unknown",
    "told: changed",
    "labels found",
    "data reused",
    "data fetched",
    # What readers were shown by capture stamp.
    "complete sets found",
    "sets of one stamp checked",
    "replaced versions shown by stamp",
    "replaced versions surveyed",
    "stamps outside retention",
    "own commits seen",
    # Where data came from, and what became of whole contexts.
    "causes that name reads",
    "causes over a restart",
    "worlds forked",
    "worlds dropped",
    "drops refused for a lock",
    "forks of what is forgotten",
    "copies of forks and drops that came late",
    "shard: forks_waited",
    # What was, and what was kept of it.
    "data shown as of long ago",
    "views of what is forgotten",
    "replaced versions listed",
    "labels changed",
    "kept versions found after a restart",
    # A type that grew while the cell ran.
    "types that have grown",
    "newer types over a restart",
    "writers of an older type refused",
    "locks refused for a newer type",
    "locks of an older type that ended later",
    "newer data read by older programs",
    # What came apart from its commit.
    "slices staged",
    "slices sent again",
    "payloads adopted",
    "payloads released",
    "payloads held to the end",
    "payloads named too early",
    "payloads adopted after a long time",
    "drafts given up for want of slices",
    "refused: no_payload",
    # What clients filled in the folder of their shard.
    "files filled",
    "data mapped",
    "drafts dropped",
    "folders full",
    "payloads without room",
    "clients forked",
    "clients that died over a file",
    "handler: files_ahead_used",
    "handler: files_ahead_removed",
    "files ahead at a crash",
    "files taken back from a client",
    # What stayed with a session between two locks.
    "shard: grants_kept",
    "shard: grants_revoked",
    "shard: grants_recalled",
    "locks begun without a call",
    "locks begun from afar",
    "words of a recall",
    "locks ended without a call",
    "late commits under a kept grant fenced",
    "steps while a shard looks at marks",
    "unknown commits that never came",
)


def fail(result: Result) -> None:
    """Fail with rule, short schedule and the line that runs it again."""
    pytest.fail("\n".join(told(shrink(result, seconds=SHRINK_S))), pytrace=False)


def missing(totals: Totals) -> list[str]:
    """Return what never happened."""
    return [name for name in HAPPENED if not totals.tally[name]]


@pytest.mark.parametrize("seed", sorted({*KNOWN_BAD.values(), *MISJUDGED, *WRONG}))
def test_seed_that_once_failed_passes(seed):
    """What was fixed stays fixed."""
    result = Scenario(seed).run()
    if result.violation:
        fail(result)


@pytest.mark.parametrize("half", range(HALVES))
def test_seeds_break_no_rule_and_meet_every_fault(half, record_property):
    """No rule is broken in any seed, and nothing that the rules are about failed to happen."""
    named = os.environ.get("ENACT_SIM_FIRST")
    first = (fresh_seed() // HALVES * HALVES if named is None else int(named)) + half

    totals = run_series(first, seconds=SECONDS, at_least=SEEDS_MIN, step=HALVES)
    while not totals.failures and missing(totals) and totals.seeds < SEEDS_MAX:
        after = first + totals.seeds * HALVES
        totals.join(run_series(after, count=SEEDS_MORE, step=HALVES))

    for result in totals.failures:
        fail(result)
    tally = totals.tally
    record_property("seeds", totals.seeds)
    record_property("commits", tally["commits"])
    print(
        f"\n{totals.seeds} seeds from {first} on, in steps of {HALVES}: {tally['commits']} checked"
        f" commits, {tally['commits'] / totals.cpu_s:.0f} per second of one core,"
        f" {totals.crashes} crashes, {totals.partitions} partitions, 0 violations"
    )
    assert not missing(totals), f"never happened in {totals.seeds} seeds: {missing(totals)}"
    assert tally["commits"] >= 50 * totals.seeds * 0.9
