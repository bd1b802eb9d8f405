"""The log check tells damage in the middle from a torn tail, by SQLite's own files."""

import random
import shutil
import sqlite3
import struct

import pytest

from enact_dist.link.folder.wal_check import FRAME_HEADER_BYTES, HEADER_BYTES, WalVerdict, check_wal


def make_log(path, *, page_bytes=4096, commits=12, generations=1):
    """Write a database through SQLite and return a copy of its log as a crash leaves it."""
    rng = random.Random(page_bytes)
    connection = sqlite3.connect(path / "db", isolation_level=None)
    for pragma in (f"page_size={page_bytes}", "journal_mode=WAL", "wal_autocheckpoint=0"):
        connection.execute(f"PRAGMA {pragma}")
    connection.execute("CREATE TABLE t (x)")
    for generation in range(generations):
        if generation:
            connection.execute("PRAGMA wal_checkpoint(RESTART)").fetchall()
        for _ in range(commits // (generation + 1)):
            body = rng.randbytes(rng.randrange(3 * page_bytes))
            connection.execute("INSERT INTO t VALUES (?)", (body,))
    log = path / "copy-wal"
    shutil.copy(path / "db-wal", log)
    connection.close()
    return log


def frames_by_the_book(raw):
    """Count the frames that check, word by word as the file format's description says."""
    header = struct.unpack(">8I", raw[:32])
    order = "<" if header[0] == 0x377F0682 else ">"

    def summed(data, s0, s1):
        words = struct.unpack(f"{order}{len(data) // 4}I", data)
        for first, second in zip(words[::2], words[1::2], strict=True):
            s0 = (s0 + first + s1) & 0xFFFFFFFF
            s1 = (s1 + second + s0) & 0xFFFFFFFF
        return s0, s1

    seed = summed(raw[:24], 0, 0)
    assert seed == header[6:8]
    count, length = 0, 24 + header[2]
    for begin in range(32, len(raw) - length + 1, length):
        frame = raw[begin : begin + length]
        words = struct.unpack(">6I", frame[:24])
        seed = summed(frame[:8] + frame[24:], *seed)
        if words[2:4] != header[4:6] or seed != words[4:6]:
            break
        count += 1
    return count


@pytest.mark.parametrize("page_bytes", [512, 1024, 4096, 65536])
@pytest.mark.parametrize("generations", [1, 2])
def test_sound_log_has_as_many_frames_as_the_format_says(tmp_path, page_bytes, generations):
    """Every page length, with and without remains of an older generation: sound, all counted."""
    log = make_log(tmp_path, page_bytes=page_bytes, generations=generations)
    raw = log.read_bytes()
    expected = frames_by_the_book(raw)
    assert expected > 5
    assert check_wal(log) == WalVerdict(expected, page_bytes, None)
    older = len(raw) > HEADER_BYTES + expected * (FRAME_HEADER_BYTES + page_bytes)
    assert older == (generations > 1)


@pytest.mark.parametrize("length", [None, 0, 1, 31, 32])
def test_log_without_frames_is_sound(tmp_path, length):
    """No log, an empty one and a cut header: nothing was ever acknowledged from there."""
    log = make_log(tmp_path)
    if length is None:
        log.unlink()
    else:
        log.write_bytes(log.read_bytes()[:length])
    verdict = check_wal(log)
    assert (verdict.frames, verdict.damaged_at) == (0, None)


def test_cut_log_is_a_torn_tail(tmp_path):
    """At every frame's end and within frames: the whole frames count, no damage."""
    log = make_log(tmp_path)
    raw, length = log.read_bytes(), FRAME_HEADER_BYTES + 4096
    for number in range((len(raw) - HEADER_BYTES) // length):
        for within in (0, 1, 23, 24, 2000, length - 1):
            log.write_bytes(raw[: HEADER_BYTES + number * length + within])
            assert check_wal(log) == WalVerdict(number, 4096, None)


def test_rubbish_behind_the_last_frame_is_a_torn_tail(tmp_path):
    """Random bytes, zeros and a torn frame prove nothing."""
    log = make_log(tmp_path)
    raw, length = log.read_bytes(), FRAME_HEADER_BYTES + 4096
    whole = check_wal(log).frames
    torn = raw[-length : -length // 2]
    for tail in (random.Random(1).randbytes(3 * length), bytes(3 * length), torn):
        log.write_bytes(raw + tail)
        assert check_wal(log) == WalVerdict(whole, 4096, None)


def test_flipped_bit_is_damage_where_frames_follow(tmp_path):
    """Any bit of a frame: damage with the frame's offset, unless no later frame proves it."""
    rng = random.Random(2)
    log = make_log(tmp_path)
    raw, length = log.read_bytes(), FRAME_HEADER_BYTES + 4096
    frames = (len(raw) - HEADER_BYTES) // length
    for number in range(frames):
        for within in (*range(0, 24, 4), 24, 4119, rng.randrange(length)):
            begin = HEADER_BYTES + number * length
            log.write_bytes(flipped(raw, begin + within, rng))
            verdict = check_wal(log)
            if number < frames - 2:
                assert verdict == WalVerdict(number, 4096, begin), (number, within)
            elif number == frames - 1:
                assert verdict == WalVerdict(number, 4096, None)


def test_flipped_bit_in_the_header_is_damage(tmp_path):
    """Each byte of the header: the frames that follow prove that it was sound."""
    rng = random.Random(3)
    log = make_log(tmp_path)
    raw = log.read_bytes()
    for offset in range(HEADER_BYTES):
        log.write_bytes(flipped(raw, offset, rng))
        assert check_wal(log).damaged_at == 0, offset


def test_header_without_frames_that_belong_to_it_is_no_damage(tmp_path):
    """A torn header before nothing but rubbish: SQLite takes the log for empty, rightly."""
    log = make_log(tmp_path)
    header = log.read_bytes()[:HEADER_BYTES]
    rng = random.Random(4)
    log.write_bytes(flipped(header, 20, rng) + rng.randbytes(20_000))
    assert check_wal(log).damaged_at is None


def flipped(raw, offset, rng):
    """Return `raw` with one bit of a byte turned over."""
    changed = bytearray(raw)
    changed[offset] ^= 1 << rng.randrange(8)
    return bytes(changed)
