"""Check the models with Spin and print the table of enact_dist/docs/proof.md.

`python tests/models/run.py` runs everything, `--model grace` one model, `--jobs 4` on more cores.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from spin_models import HOLDS, MODELS, VARIANTS, Result, Variant, verify


def main() -> int:
    """Run the variants; say what came of each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", choices=MODELS, help="only this one")
    parser.add_argument("--jobs", type=int, default=2, help="how many at a time")
    options = parser.parse_args()
    variants = [v for v in VARIANTS if options.model in (None, v.model)]
    print("| model | variant | states | depth | seconds | verdict |\n|---|---|---:|---:|---:|---|")
    bad = states = 0
    with ThreadPoolExecutor(options.jobs) as pool:
        for variant, result in zip(variants, pool.map(_verify, variants), strict=True):
            print(_row(variant, result), flush=True)
            bad += not result.as_expected(variant)
            states += result.states if variant.expects == HOLDS else 0
    good = len(variants) - bad
    print(f"\n{good} of {len(variants)} as they must be; {states:,} states without an error")
    return 1 if bad else 0


def _verify(variant: Variant) -> Result:
    with tempfile.TemporaryDirectory() as folder:
        return verify(variant, Path(folder))


def _row(variant: Variant, result: Result) -> str:
    macro = variant.defines[0] if variant.expects != HOLDS else ""
    text = f"{variant.text} (`{macro}`)" if macro else variant.text
    return (
        f"| {variant.model} | {text} | {result.states:,} | {result.depth:,}"
        f" | {result.seconds:.1f} | {result.verdict(variant)} |"
    )


if __name__ == "__main__":
    sys.exit(main())
