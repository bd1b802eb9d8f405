"""The processes of benches: raw floors answer, the pipeline takes sets of one tick."""

from pathlib import Path

import numpy as np
import pytest

from enact_dist.bench.cases import history, memory, pipeline
from enact_dist.bench.cases.decisions import Decider, granted_of, hand_over_us
from enact_dist.bench.cases.pipeline_worker import (
    CAMERAS,
    FRAMES,
    areas_of_frames,
    frames_of,
    head_of,
    mask_of,
    tick_of_set,
)
from enact_dist.bench.cases.security import run_security
from enact_dist.bench.cases.updates import slots, update
from enact_dist.bench.command import BENCHES
from enact_dist.bench.floors import ECHO, FDATASYNC, PUBLISH, QUERY, Floors
from enact_dist.bench.place import EMBEDDED, Place, environment
from enact_dist.bench.run import Run
from enact_dist.bench.view import case as view
from enact_dist.core.protocol.datum import Slot
from enact_dist.errors import MisuseError


@pytest.fixture
def new_run(tmp_path):
    """Return a function that makes a run in a cell of its own; ended after the test."""
    opened = []

    def make(*carriers):
        folder = tmp_path / f"run{len(opened)}"
        folder.mkdir()
        place = Place(folder, target=None, shards=1, carriers=carriers)
        floors = Floors(folder, folder)
        opened.append((place, floors))
        return Run(place, floors, seconds_s=0.03, told=lambda _text: None)

    yield make
    for place, floors in opened:
        floors.__exit__()
        place.__exit__()


def test_memory_of_a_slot_is_that_of_a_daemon_of_its_own(new_run, monkeypatch):
    """One that other benches used has freed memory, of which slots take none that is seen."""
    monkeypatch.setattr(memory, "SETTLE_S", 0.1)
    run = new_run("auto")
    run.place.cell("auto")
    measured = []
    real = memory.private_bytes
    monkeypatch.setattr(memory, "private_bytes", lambda pid: measured.append(pid) or real(pid))

    memory.run_memory(run)

    assert len(set(measured)) == 1
    assert not set(measured) & set(run.place.daemon_pids())
    slot, commits = run.rows()
    assert (slot.variant, commits.variant) == (
        "shard, one slot that holds a number",
        "shard, growth with commits",
    )
    assert 200 < slot.value < 10_000


def test_security_compares_a_cell_with_keys_to_a_plain_one(new_run):
    """Each row of the secured cell is divided by the same one of the plain cell."""
    pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")
    run = new_run("zenoh")
    run_security(run)

    rows = {row.variant: row for row in run.rows()}
    for name in ("call", "update, volatile", "30 MB read"):
        assert rows[f"{name}, plain"].ratio is None
        assert rows[f"{name}, keys, rules for 61 names"].ratio > 0
    assert rows["right, known"].median_us < rows["right, new, 1,000 rules"].median_us


def test_the_view_is_measured_beside_the_same_cell_without_a_page(new_run, monkeypatch):
    """Each update costs what the threads of the view take; no browser is needed."""
    pytest.importorskip("viser")
    monkeypatch.setattr(view, "ROUNDS", 1)
    monkeypatch.setattr(view, "SETTLE_S", 0.0)
    monkeypatch.setattr(view, "CHROMIUM", Path("/nowhere"))
    run = new_run("auto")
    run.seconds_s = 0.15
    view.run_view(run)

    rows = {row.variant: row for row in run.rows()}
    parts = [row.value for name, row in rows.items() if name.startswith("of it: ")]
    assert len(parts) == len(view.PARTS) + 1
    assert sum(parts) == pytest.approx(rows["processor time of an update"].value, abs=0.05)
    assert rows["first picture after the command"].value > 0
    assert rows["growth of memory after 20 s"].note == "too short to tell"
    assert rows["updates shown in Chromium, drawn in software"].note.endswith("missing")


def test_every_kind_of_floor_gives_times(new_run):
    """Raw transports, memory and disk; the largest sizes are left to the bench itself."""
    run = new_run(EMBEDDED)
    small = [key for key in Floors.every() if key[1].endswith(" 1 kB")]

    for _, variant in [QUERY, PUBLISH, ECHO, FDATASYNC, *small]:
        run.measure([run.floors.case(variant)], rounds=1)

    rows = run.rows()
    assert [(row.name, row.variant) for row in rows] == [
        key for key in Floors.every() if key in {QUERY, PUBLISH, ECHO, FDATASYNC, *small}
    ]
    assert all(row.median_us > 0 for row in rows)
    fast = {row.variant for row in rows if row.mb_s}
    assert fast == {"memcpy 1 kB", "write 1 kB", "zenoh reply 1 kB"}


def test_raw_query_brings_as_many_bytes_as_asked(new_run):
    """The floor of a fetch moves the bytes that it is named after."""
    raw = new_run(EMBEDDED).floors._zenoh

    assert [raw.query(size) for size in (64, 921_600)] == [64, 921_600]


def test_unknown_floor_is_refused(new_run):
    """A floor that is spelt wrongly is no silent gap in the table."""
    with pytest.raises(MisuseError, match="write 3 kB"):
        new_run(EMBEDDED).floors.case("write 3 kB")


def test_update_counts(new_run):
    """What is measured is a real update: the datum is one larger after each."""
    writes = slots(new_run(EMBEDDED).place.world(EMBEDDED), 2)
    for _ in range(3):
        update(writes)

    view = writes[0].world.view
    from enact_dist import View

    for write in writes:
        request = View(write.world, write.entity, write.aspect)
        assert view(request)[request] == 3


def test_each_commit_hands_the_slot_over():
    """The core bench times commits that grant the next of those who wait, not empty ones."""
    decider = Decider(2)
    slot = Slot("bench", "counter0", "count")
    first = granted_of(decider.acquire(0, 1, slot))
    assert decider.acquire(0, 1, slot, session=1) == []

    second = granted_of(decider.commit(first.lock, first.token, slot))

    assert second.lock.session == "bench1"
    assert second.states[0].version == 1
    assert len(hand_over_us(0.001)) >= 1


def test_environment_is_given_back(monkeypatch):
    """A forced carrier does not stay behind."""
    import os

    monkeypatch.setenv("ENACT_CARRIER", "socket")
    monkeypatch.delenv("ENACT_TEST_ONLY", raising=False)
    with environment(ENACT_CARRIER="zenoh", ENACT_TEST_ONLY="1"):
        assert os.environ["ENACT_CARRIER"] == "zenoh"
    assert os.environ["ENACT_CARRIER"] == "socket"
    assert "ENACT_TEST_ONLY" not in os.environ


def masks_at(tick):
    masks = []
    for camera in range(CAMERAS):
        image = frames_of(camera)[tick % FRAMES]
        head_of(image)[:] = tick, 123
        masks.append(mask_of(image))
    return masks


def test_mask_bears_the_tick_of_its_image():
    """Sets are told apart by what stands in the pixels, not by what anybody claims."""
    image = frames_of(3)[1]
    head_of(image)[:] = 7, 123

    mask = mask_of(image)

    assert mask.shape == (480, 640)
    assert head_of(mask).tolist() == [7, 123]
    expected = (image[1:, :, 1] > image[1:, :, 0]).astype(np.uint8)
    assert np.array_equal(mask[1:], expected)


def test_set_of_one_frame_is_told_by_heads_and_pixels():
    """A mask of another tick is found by its head, one that only claims the tick by its pixels."""
    areas = areas_of_frames()
    whole, other = masks_at(6), masks_at(7)
    assert tick_of_set(whole, areas) == 6

    by_head = [*whole[:7], other[7]]
    forged = other[7].copy()
    head_of(forged)[0] = 6

    assert tick_of_set(by_head, areas) is None
    assert tick_of_set([*whole[:7], forged], areas) is None


@pytest.mark.sampled(2)
@pytest.mark.parametrize("bench", ["core", "update", "multi", "durable", "fetch", "publish"])
def test_bench_within_the_process_judges_its_goals_alone(new_run, bench):
    """Whatever a goal is told by is measured by the bench itself."""
    assert_judged(new_run(EMBEDDED), bench)


@pytest.mark.slow
@pytest.mark.parametrize(
    "bench",
    ["update", "layers", "multi", "durable", "waiters", "fetch", "publish", "wakeup", "stopped"],
)
def test_bench_judges_its_goals_alone(new_run, bench):
    """The same over each carrier: no row is left undecided for want of another bench."""
    assert_judged(new_run("zenoh", "socket"), bench)


def assert_judged(run, bench):
    BENCHES[bench](run)

    rows = run.rows()
    assert any(row.name == bench for row in rows)
    assert [(row.name, row.variant) for row in rows if row.goal and row.met is None] == []


@pytest.mark.slow
def test_pipeline_of_17_processes_takes_sets(new_run, monkeypatch):
    """A short run: sets are taken, and every row is there."""
    monkeypatch.setattr(pipeline, "TIMES", 50)  # of 0.03 s: 15 ticks
    run = new_run("auto")

    pipeline.run_pipeline(run)

    rows = {row.variant: row for row in run.rows() if row.name == "pipeline"}
    missed = rows["missed ticks"]
    assert rows["image stored to 8 masks read"].n <= 15
    assert rows["image stored to 8 masks read"].median_us > 0
    assert rows["the same work without sharing"].value > 0
    assert missed.met is (missed.value == 0) is (not missed.note)
    assert rows["sets of more than one frame"].value == 0
    assert {f"memory of the {kind}" for kind in ("cameras", "workers", "reader", "shards")} <= set(
        rows
    )
    assert "growth of the shared folder" in rows


@pytest.mark.slow
def test_history_fills_its_cap_beside_updates(new_run, monkeypatch):
    """A short run: images with history fill shared memory up to its cap, and none is refused."""
    monkeypatch.setattr(history, "CAP_BYTES", 100_000_000)  # the images of 1.4 s
    run = new_run("auto")

    history.run_history(run)

    rows = {row.variant: row for row in run.rows() if row.name == "history"}
    memory = rows["8 cameras, 74 MB/s, shared memory at most"]
    assert memory.met
    assert 0.9 * history.CAP_BYTES / 1e6 < memory.value <= history.CAP_BYTES / 1e6
    for side in history.SIDES:
        assert rows[f"update beside 8 cameras, {side}"].median_us > 0
        assert rows[f"update, durable, {side}"].median_us > 0
    assert rows["list of 1,000 versions"].median_us > 0
    assert rows["fork of 100 slots of 0.9 MB, per slot"].goal is not None
