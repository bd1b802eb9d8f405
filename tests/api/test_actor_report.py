"""What an actor reports: counters, rates, lock waits, and how it travels."""

from __future__ import annotations

import gc
import sys

import msgpack
import pytest

from enact_dist.actor.report import (
    ActorRecord,
    ActorStatistics,
    RateMeter,
    encode_reports,
    percentile,
    read_reports,
)
from enact_dist.core.protocol.messages import REPORT_BYTES_MAX
from enact_dist.errors import CommitUnknownError, ProtocolError
from enact_dist.world.listings import unpacked_report

SECOND_NS = 1_000_000_000


def test_rate_is_over_the_last_five_seconds_when_an_actor_runs_longer():
    """Ten updates a second are 10 Hz, and 0 Hz five seconds after the last one."""
    meter = RateMeter(start_ns=0)
    for tick in range(200):
        meter.count(tick * SECOND_NS // 10)

    assert meter.rate_hz(20 * SECOND_NS) == pytest.approx(10.0)
    assert meter.rate_hz(26 * SECOND_NS) == 0.0


def test_rate_is_right_when_more_updates_came_than_are_kept():
    """1,000 Hz is shown as 1,000 Hz though only 512 stamps are kept."""
    meter = RateMeter(start_ns=0)
    for tick in range(5_000):
        meter.count(tick * SECOND_NS // 1_000)

    assert meter.rate_hz(5 * SECOND_NS) == pytest.approx(1_000.0, rel=0.01)


def test_rate_is_over_the_time_since_the_start_when_an_actor_is_young():
    """Three updates in the first second are 3 Hz, not 0.6 Hz."""
    meter = RateMeter(start_ns=0)
    for tick in range(3):
        meter.count(tick * SECOND_NS // 3)

    assert meter.rate_hz(SECOND_NS) == pytest.approx(3.0)


def test_waits_are_those_of_the_newest_attempts():
    """A slow beginning is forgotten after 512 attempts, whatever their order was."""
    record = ActorRecord("fusion", now_ns=0)
    for wait_ms in (*[1_000] * 300, *range(512, 0, -1)):
        record.waited(wait_ms * 1_000_000)

    found = record.snapshot(SECOND_NS)

    assert found.lock_wait_p50_ms == pytest.approx(256.0)
    assert found.lock_wait_p99_ms == pytest.approx(507.0)


def test_record_takes_its_memory_when_the_actor_starts():
    """Waits and updates at 10 Hz for hours leave nothing behind."""
    record = ActorRecord("fusion", now_ns=0)

    def works(updates):
        for number in range(updates):
            record.waited(number * 1_000_000)
            record.updated(took_ns=number, now_ns=number * 10**9, wall_ns=number * 10**9)

    works(10)
    gc.collect()
    before = sys.getallocatedblocks()
    works(400)

    assert sys.getallocatedblocks() - before < 100


def test_percentile_is_the_nearest_rank_when_asked_for_a_part():
    """Of 1…100 the median is 50 and the 99th percentile 99; of one entry it is that."""
    ascending = list(range(1, 101))

    assert [percentile(ascending, part) for part in (0.5, 0.99)] == [50, 99]
    assert percentile([7], 0.99) == 7
    assert percentile([], 0.5) == 0


def test_record_counts_each_ending_of_an_update_apart():
    """Own failures, refusals and unknown commits are three counters; the last error is kept."""
    record = ActorRecord("fusion", now_ns=0)
    record.waited(2_000_000)
    record.updated(took_ns=30_000_000, now_ns=SECOND_NS, wall_ns=5 * SECOND_NS)
    record.refused(TimeoutError("held by perception"))
    record.refused(CommitUnknownError("no answer"))
    record.failed(ValueError("empty cloud"))

    found = record.snapshot(SECOND_NS)

    assert (found.updates, found.failures, found.refused, found.unknown) == (1, 1, 2, 1)
    assert found.last_error == "ValueError: empty cloud"
    assert found.last_update_s == pytest.approx(0.03)
    assert found.last_update_unix_s == pytest.approx(5.0)
    assert found.lock_wait_p50_ms == pytest.approx(2.0)
    assert (found.update_p50_ms, found.update_p99_ms) == pytest.approx((30.0, 30.0))


def test_reports_come_back_equal_when_encoded_and_decoded():
    """All actors of one process travel in one report."""
    reports = [
        ActorStatistics(name="fusion", updates=3, rate_hz=9.5, last_error="ValueError: é"),
        ActorStatistics(name="feedback", state="stopped"),
    ]

    assert decode_reports(encode_reports(reports)) == tuple(reports)


def decode_reports(report: bytes) -> tuple[ActorStatistics, ...]:
    """Return reports as `enact actor ls` reads them."""
    return read_reports(unpacked_report(report))


ENDLESS = b"\x81\xa6actors\x91\x81\xa7updates\xcb\x7f\xf0" + bytes(6)


def test_long_declarations_cost_no_figures():
    """What an actor writes is left out first; how it does stays."""
    writes = tuple(f"online:part/{number}/{'x' * 200}" for number in range(64))
    (found,) = decode_reports(encode_reports([ActorStatistics("fusion", updates=7, writes=writes)]))
    (short,) = decode_reports(encode_reports([ActorStatistics("fusion", writes=writes[:2])]))

    assert (found.updates, found.writes) == (7, ())
    assert short.writes == writes[:2]


@pytest.mark.parametrize("report", [b"\x81\xa6actors\x01", ENDLESS])
def test_reports_are_refused_by_name_when_they_are_none(report: bytes):
    """What unpacks and is no report raises `ProtocolError`."""
    with pytest.raises(ProtocolError, match="actor report"):
        decode_reports(report)


@pytest.mark.parametrize(
    "report", [b"\xc1", b"\x93\x01\x02\x03", b"{}", b"\x91" * 500 + b"\x01", b""]
)
def test_bytes_of_no_table_are_no_report(report: bytes):
    """A client may send anything with its keep-alive."""
    assert decode_reports(report) == ()


@pytest.mark.parametrize(
    ("count", "errors", "shown"), [(3, True, 3), (30, True, 30), (70, False, 70)]
)
def test_report_of_a_process_with_many_actors_is_short_enough_to_be_listed(count, errors, shown):
    """Texts and figures go before the names and states of actors do."""
    error = "ValueError: " + "x" * 480 if errors else ""
    reports = [
        ActorStatistics(f"actor{number}", "running", updates=10**6, last_error=error)
        for number in range(count)
    ]

    encoded = encode_reports(reports)

    assert len(encoded) <= REPORT_BYTES_MAX
    found = decode_reports(encoded)
    assert [(one.name, one.state) for one in found] == [
        (f"actor{number}", "running") for number in range(shown)
    ]


def test_actors_beyond_a_report_are_counted():
    """Hundreds of actors in one process are no more than a number."""
    encoded = encode_reports([ActorStatistics("a" * 200, "running")] * 300)

    report = msgpack.unpackb(encoded)
    assert len(encoded) <= REPORT_BYTES_MAX
    assert len(report["actors"]) + report["left_out"] == 300
