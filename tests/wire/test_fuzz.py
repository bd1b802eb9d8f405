"""The decoders against inputs that nobody planned: the saved ones, and fresh ones each time.

python tests/wire/fuzz/run.py --seconds 600        # longer, by hand; see there
ENACT_FUZZ_SEED=7 python -m pytest tests/wire/test_fuzz.py
"""

from __future__ import annotations

import os
import random
import secrets
import time
from pathlib import Path

import pytest
from fuzz import targets
from fuzz.fuzzer import Finder, Finding, tried
from fuzz.seeds import SEEDS
from fuzz.targets import TARGETS

SECONDS = float(os.environ.get("ENACT_FUZZ_SECONDS", "20"))
SEED = int(os.environ.get("ENACT_FUZZ_SEED", secrets.randbelow(10**6)))
CORPUS = Path(__file__).parent / "fuzz" / "corpus"
CORPUS_BYTES_MAX = 300_000
TRIES_MIN = 100


def saved(name):
    """Return the inputs of the corpus for a target."""
    return [path.read_bytes() for path in sorted((CORPUS / name).glob("*"))]


@pytest.mark.parametrize("name", TARGETS)
def test_saved_inputs_are_taken_or_refused_by_name(name):
    """What once reached new lines, or was a finding: the named error or a value that comes back."""
    inputs = saved(name)

    for raw in inputs:
        tried(name, raw)
        tried(name, raw, watch_memory=True)

    assert inputs


def test_corpus_is_small_and_holds_nothing_else():
    """It lies in the repository: short inputs, and a folder for each target."""
    sizes = [path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()]

    assert {path.name for path in CORPUS.iterdir()} == set(TARGETS)
    assert sum(sizes) <= CORPUS_BYTES_MAX


@pytest.mark.parametrize("name", ["frame", "datum", "report", "rows", "mark", "log"])
def test_every_kind_has_a_valid_sample(name):
    """Mutation begins with an input in order for every message, type, and kind of row."""
    assert all(tried(name, raw) is not None for raw in SEEDS[name](random.Random(SEED)))


@pytest.mark.parametrize("name", TARGETS)
def test_fresh_inputs_are_taken_or_refused_by_name(name):
    """Mutations that nobody has seen yet: no other exception, no long wait, no great memory."""
    rng = random.Random(SEED)
    finder = Finder(name, saved(name) + list(SEEDS[name](rng)), rng)

    finder.run(SECONDS / len(TARGETS), at_least=TRIES_MIN)

    for raw, finding in finder.found.values():
        pytest.fail(f"ENACT_FUZZ_SEED={SEED}: {finding}\nwhole input: {raw.hex()}")
    assert finder.tries >= TRIES_MIN
    assert finder.taken > 0


def _raises(raw):
    return raw[100]


def _waits(raw):
    end_s = time.thread_time() + 0.15
    while time.thread_time() < end_s:
        pass


def _allocates(raw):
    return len(bytes(32 << 20))


@pytest.mark.parametrize(
    ("target", "said"),
    [(_raises, "IndexError"), (_waits, r"0\.1\d+ s for 3 bytes"), (_allocates, "of memory for 3")],
)
def test_decoder_that_misbehaves_is_found(monkeypatch, target, said):
    """Another exception, a tenth of a second, 16 MiB: each is a finding."""
    monkeypatch.setitem(targets.TARGETS, "frame", target)

    with pytest.raises(Finding, match=said):
        tried("frame", b"abc", watch_memory=target is _allocates)
