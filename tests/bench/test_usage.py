"""What is counted as growth, and why a tick was missed."""

import mmap
import os

import pytest

from enact_dist.bench.cases.pipeline import ticks_of
from enact_dist.bench.usage import Sampled, Usage, Used, folder_use, private_bytes, slope

MS = 1_000_000


def test_slope_is_not_moved_by_a_hiccup():
    """One sample that lies far off says nothing about growth."""
    points = [(float(second), 3.0 * second) for second in range(20)]
    points[7] = (7.0, 1e9)

    assert slope(points) == pytest.approx(3.0, rel=0.1)


def test_growth_leaves_the_warm_up_out(tmp_path):
    """A process that takes its memory in the first 10 s does not grow."""
    usage = Usage({}, tmp_path)
    for second in range(60):
        private = min(second, 9) * 1_000_000 + 500 * second
        usage.samples.append(Sampled(float(second), {"camera": Used(0.0, private, 0)}, 0, 0))

    assert usage.growth(lambda one: one.kinds["camera"].private) == pytest.approx(500.0)


def test_growth_of_a_short_run_is_not_told(tmp_path):
    """Less than as long again as the warm-up is no proof that nothing grows."""
    usage = Usage({}, tmp_path)
    usage.samples += [Sampled(float(second), {}, 0, 0) for second in range(19)]

    assert usage.growth(lambda one: one.files) is None


def test_usage_sees_memory_and_files(tmp_path):
    """A megabyte more is seen as one, in the process as in the folder."""
    before = private_bytes(os.getpid())
    # Of the heap it might be memory that was freed before, and so was counted already.
    fresh = mmap.mmap(-1, 8_000_000, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    fresh.write(b"x" * len(fresh))
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "payload").write_bytes(fresh[:1_000_000])

    assert private_bytes(os.getpid()) - before > 6_000_000
    fresh.close()
    count, size = folder_use(tmp_path)
    assert (count, size >= 1_000_000) == (1, True)


def told(tick, *, begun=1, ended=2, made=5, read=8):
    """Return what all say of one tick; times in ms after the tick was due, None: not at all."""
    due = tick * 100 * MS
    return (
        [tick, due + begun * MS, due + ended * MS] if ended is not None else None,
        [tick, due + made * MS] if made is not None else None,
        [tick, due + read * MS, (read - begun) * MS] if read is not None else None,
    )


@pytest.mark.parametrize(
    ("lacks", "reason"),
    [
        ({"ended": None, "made": None, "read": None}, "no image was stored"),
        ({"made": None, "read": None}, "a worker passed over its image"),
        ({"read": None}, "the reader passed over its set"),
        (
            {"begun": 150, "ended": 151, "made": 152, "read": 155},
            "late, mostly by the camera's wake-up",
        ),
        ({"ended": 95, "made": 100, "read": 105}, "late, mostly by the image's commit"),
        ({"made": 95, "read": 105}, "late, mostly by the worker"),
        ({"read": 120}, "late, mostly by the reader"),
    ],
)
def test_missed_tick_has_a_reason(lacks, reason):
    """The first of the chain that let it go, or the stage that took longest."""
    all_told = [told(0), told(1, **lacks), told(2)]
    cameras, segmenters, sets = (
        [part for part in parts if part is not None] for parts in zip(*all_told, strict=True)
    )

    found = ticks_of(
        [{"ticks": cameras}],
        [{"ticks": segmenters}],
        {"sets": sets, "torn": []},
        ticks=range(3),
        start_ns=0,
        period_ns=100 * MS,
    )

    assert found.reasons == {reason: 1}
    assert found.missed == 1
    assert found.latencies_us[0] == 7000.0
    assert found.stages_us["worker"][0] == 3000.0


def test_set_of_two_frames_is_torn_and_missed():
    """What only claims to belong together is no set."""
    camera, segmenter, _ = told(0)

    found = ticks_of(
        [{"ticks": [camera]}],
        [{"ticks": [segmenter]}],
        {"sets": [], "torn": [0]},
        ticks=range(1),
        start_ns=0,
        period_ns=100 * MS,
    )

    assert (found.torn, found.missed) == (1, 1)
