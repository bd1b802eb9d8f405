"""Shards in a replicated database: no seed loses, doubles or invents an update, and wrong edits do.

`ENACT_SIM_SECONDS` (default 10) is how long fresh seeds go on; `ENACT_SIM_FIRST` names the first
one, to repeat a series.
"""

from __future__ import annotations

import os

import pytest

from enact_dist.core.failover import lease
from enact_dist.verify.simulation.hosts.world import MS, S
from enact_dist.verify.simulation.series import fresh_seed, run_series
from enact_dist.verify.takeover import daemon as daemons
from enact_dist.verify.takeover.daemon import SimulatedDaemon
from enact_dist.verify.takeover.database import SimulatedDatabase
from enact_dist.verify.takeover.run import TakeoverRun, run_takeover

SECONDS = float(os.environ.get("ENACT_SIM_SECONDS", "10")) / 4
SEEDS_MIN = 30
CAUGHT_WITHIN = 200
HAPPENED = (
    "answers of the database held up",
    "batches that stood",
    "changes that a failover lost",
    "connections cut",
    "daemons cut off from the database",
    "daemons fenced",
    "daemons frozen",
    "daemons killed",
    "failovers of the database",
    "standbys of the database lost",
    "takeovers",
    "waits for the standby cancelled",
    "locks committed",
    "locks lost",
    "locks unknown",
)


def test_no_seed_loses_doubles_or_invents_an_update():
    """New seeds each run; every kind of event has to happen in some of them."""
    first = int(os.environ.get("ENACT_SIM_FIRST", "0")) or fresh_seed()

    totals = run_series(first, seconds=SECONDS, at_least=SEEDS_MIN, run=run_takeover)

    assert not totals.failures, [
        f"enact verify --takeover --seed {one.seed}: {one.violation}" for one in totals.failures
    ]
    assert [name for name in HAPPENED if not totals.tally[name]] == []


# ---------------------------------------------------------------- wrong edits


def writes_without_a_fence(patch):
    """The database writes a batch although another daemon has the shard."""

    def putting(self, number, batch, row):
        return daemons.RowChange(row._replace(batch=number, beat=self._beat_after(row)), batch)

    patch(SimulatedDaemon, "putting", putting)


def believes_at_once(patch):
    """A batch that a new connection shows counts as confirmed."""

    def believe(self, connection, batch, sent_ns):
        self._lines[0].done()
        self._stands(batch, sent_ns)

    patch(SimulatedDaemon, "believe", believe)


def sends_again_unasked(patch):
    """A batch whose answer was lost is sent again, without a look at whether it stands."""

    def putting(self, number, batch, row):
        if row.epoch != self._epoch:
            return None
        return daemons.RowChange(
            row._replace(batch=row.batch + 1, beat=self._beat_after(row)), batch
        )

    def after_break(found, *, epoch, batch):
        return lease.BrokenBatch.MISSING if found[0] == epoch else lease.BrokenBatch.TAKEN

    patch(SimulatedDaemon, "putting", putting)
    patch(daemons, "after_break", after_break)


def counts_from_the_answer(patch):
    """The lease counts from when its confirmation came, not from when it was asked for."""
    _, beat = SimulatedDaemon._stands, SimulatedDaemon._beat

    def _beat(self, connection, done):
        def late(found):
            self.lease.until_ns = self.local_ns + lease.kept_ns(self.lease.lease_ns)
            done(found)

        beat(self, connection, late)

    patch(SimulatedDaemon, "_beat", _beat)


def answers_before_the_check(patch):
    """Answers go out whether the lease holds or not."""
    patch(lease.Silence, "passing", lambda _self, effects, _now_ns: effects)


def takes_what_it_finds(patch):
    """A takeover does not name the row that the standby saw."""

    def taking(self, _seen, epoch, found):
        return daemons.RowChange(
            lease.HolderRow(epoch, found.batch, self._beat_after(found), self.name)
        )

    patch(SimulatedDaemon, "taking", taking)


def serves_before_its_epoch_is_confirmed(patch):
    """A takeover does not wait for the database's standby."""
    replicate = SimulatedDatabase._replicate

    def _replicate(self, primary, position):
        write = primary.busy
        if write is not None and getattr(write.make, "func", None).__name__ == "taking":
            self._confirm(primary, write)
        replicate(self, primary, position)

    patch(SimulatedDatabase, "_replicate", _replicate)


def ignores_warnings(patch):
    """A commit counts as confirmed although the database warned."""
    write = SimulatedDatabase.write

    def _write(self, line, make, done):
        write(self, line, make, lambda found: done(found._replace(warned=False)))

    patch(SimulatedDatabase, "write", _write)


WRONG = {
    writes_without_a_fence: 8,
    believes_at_once: 0,
    sends_again_unasked: 3,
    counts_from_the_answer: 18,
    answers_before_the_check: 4,
    takes_what_it_finds: 0,
    serves_before_its_epoch_is_confirmed: 0,
    ignores_warnings: 43,
}
"""Wrong edits, each with a seed that caught it, which is tried first."""


@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: wrong.__name__)
def test_a_wrong_edit_is_caught(monkeypatch, wrong):
    """The judges fail with each edit: a seed known for it is tried before others."""
    wrong(monkeypatch.setattr)
    seeds = (WRONG[wrong], *range(CAUGHT_WITHIN))

    caught = next((seed for seed in seeds if run_takeover(seed).violation), None)

    print(f"{wrong.__name__}: seed {caught}")
    assert caught is not None, f"survived {CAUGHT_WITHIN} seeds: {wrong.__doc__}"


# ---------------------------------------------------------------- directed


class _OneFailover(TakeoverRun):
    """A run whose database fails over twice; the daemon that serves finds it a second later."""

    def _plan_faults(self):
        for at_s in (10, 30):
            self.world.after(at_s * S, self._fails_over)

    def _fails_over(self):
        for shard, database in self.databases.items():
            database.fail_over(away_ns=2 * S, back_ns=500 * MS, still=())
            for daemon in self.pairs[shard].daemons:
                if daemon.serving:
                    database.bar(daemon, self.world.now_ns + 3 * S)


@pytest.mark.parametrize("seed", range(4))
def test_a_failover_of_the_database_costs_no_takeover(seed):
    """The standby daemon lost the database as well, so it gives the one that serves more time."""
    result = _OneFailover(seed).run()

    assert not result.violation
    assert result.tally["failovers of the database"] >= 2
    assert result.tally["epoch changes"] == len(_OneFailover(seed).pairs)


def test_a_standby_that_counts_over_an_outage_takes_the_shard(monkeypatch):
    """Without `was_away` the failover above costs takeovers."""
    monkeypatch.setattr(lease.Standby, "was_away", lambda _self: None)

    taken = [
        _OneFailover(seed).run().tally["epoch changes"] > len(_OneFailover(seed).pairs)
        for seed in range(4)
    ]

    assert any(taken)
