"""Fuzz the decoders by hand, or grow the corpus.

    python tests/wire/fuzz/run.py --seconds 600               all targets, a share of the time each
    python tests/wire/fuzz/run.py --target frame --seconds 60
    python tests/wire/fuzz/run.py --grow --seconds 300        watch lines; write the corpus anew
    python tests/wire/fuzz/run.py --atheris frame             by libFuzzer (pip install atheris)

Findings are written into the corpus beside this file, which the tests run whole.
"""

import argparse
import hashlib
import random
import secrets
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parents[2]), str(HERE.parent)]

from fuzz.fuzzer import Finder, minimised  # noqa: E402  # the path comes first
from fuzz.seeds import SEEDS  # noqa: E402
from fuzz.targets import TARGETS  # noqa: E402

CORPUS = HERE / "corpus"
CORPUS_BYTES_MAX = 300_000
"""All of it; each target gets its share."""


def corpus(name):
    """Return the saved inputs of a target."""
    return [path.read_bytes() for path in sorted((CORPUS / name).glob("*"))]


def save(name, raw, prefix=""):
    """Put an input into the corpus."""
    folder = CORPUS / name
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / (prefix + hashlib.sha256(raw).hexdigest()[:12])
    path.write_bytes(raw)
    return path


def by_libfuzzer(name):
    """Let libFuzzer go on for ever."""
    import atheris

    with atheris.instrument_imports():
        import enact_dist.wire.frames
        import enact_dist.wire.payload  # noqa: F401
    atheris.Setup([sys.argv[0], str(CORPUS / name)], TARGETS[name])
    atheris.Fuzz()


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--target", choices=TARGETS)
    parser.add_argument("--grow", action="store_true")
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10**6))
    parser.add_argument("--atheris", choices=TARGETS)
    options = parser.parse_args()
    if options.atheris:
        by_libfuzzer(options.atheris)
    names = [options.target] if options.target else list(TARGETS)
    findings = 0
    for name in names:
        rng = random.Random(options.seed)
        pool = corpus(name) + list(SEEDS[name](rng))
        finder = Finder(name, pool, rng, grow=options.grow)
        finder.run(options.seconds / len(names))
        print(
            f"{name}: {finder.tries} inputs, {finder.taken} of them in order,"
            f" {len(finder.found)} findings",
            flush=True,
        )
        for raw, finding in finder.found.values():
            print(f"  {finding}\n  saved as {save(name, raw, 'found-')}", flush=True)
        findings += len(finder.found)
        if options.grow and not finder.found:
            old = set(corpus(name))
            few = list(minimised(name, pool, CORPUS_BYTES_MAX // len(TARGETS)))
            for path in (CORPUS / name).glob("[!f]*"):
                path.unlink()
            for raw in few:
                save(name, raw)
            print(f"  corpus: {len(few)} inputs, {sum(map(len, few))} bytes; {len(old)} before")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
