"""Latencies beside a disturbance, held against those without it, in several rounds."""

from statistics import median

ROUNDS = 5
"""Odd, so that the median is that of one round."""
P99_S_MAX = 0.050
"""What a disturbance may add to the p99 of a round, in seconds; at least four times a calm p99."""
LONGEST_S_MAX = 0.150
"""What it may add to the longest of a round, likewise."""


def judge(measure, disturbance, what):
    """Assert what a disturbance adds in the median round.

    Other load falls upon some rounds, and upon the calm half of them as well; what the product does
    by itself it does in each.

    Args:
        measure: Returns latencies in seconds.
        disturbance: Returns a context manager around what disturbs.
        what: A name for the output.
    """
    rounds = []
    for _ in range(ROUNDS):
        calm_s = sorted(measure())
        with disturbance():
            rounds.append((calm_s, sorted(measure())))
    for calm_s, beside_s in rounds:
        print(f"{what}: calm {_shown(calm_s)}; disturbed {_shown(beside_s)}, n = {len(beside_s)}")
    for place_of, added_s_max in ((_p99, P99_S_MAX), (max, LONGEST_S_MAX)):
        calm_s = median(place_of(calm) for calm, _ in rounds)
        added_s = median(place_of(beside) - place_of(calm) for calm, beside in rounds)
        assert added_s < max(added_s_max, 4 * calm_s), f"{what}: {added_s * 1e3:.1f} ms more"


def _p99(times_s):
    """Return the 99th percentile of sorted times."""
    return times_s[len(times_s) * 99 // 100]


def _shown(times_s):
    return (
        f"p50 {median(times_s) * 1e3:.2f} p99 {_p99(times_s) * 1e3:.2f}"
        f" longest {times_s[-1] * 1e3:.2f} ms"
    )
