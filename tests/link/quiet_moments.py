"""Goals of latency on a machine that does other things as well."""

from enact_dist.errors import LeaseLostError

ATTEMPTS = 6


def met_once(attempt):
    """Let `attempt()` assert its goal several times: other load only ever adds to a latency.

    What the product does by itself it does each time.
    """
    for _ in range(ATTEMPTS - 1):
        try:
            return attempt()
        except (AssertionError, LeaseLostError) as missed:
            print(f"again: {missed}")
    return attempt()


def judge(calm_s, beside_s, what):
    """Hold sorted latencies beside a disturbance against as many without one, just before."""
    calm_p99_s, p99_s = (times[len(times) * 99 // 100] for times in (calm_s, beside_s))
    print(
        f"{what}: calm p50 {calm_s[len(calm_s) // 2] * 1e3:.2f} p99 {calm_p99_s * 1e3:.2f}"
        f" max {calm_s[-1] * 1e3:.2f} ms, disturbed p50 {beside_s[len(beside_s) // 2] * 1e3:.2f}"
        f" p99 {p99_s * 1e3:.2f} max {beside_s[-1] * 1e3:.2f} ms, n = {len(beside_s)}"
    )
    # What other load adds without the disturbance, it may add with it, and some more by chance.
    assert p99_s - calm_p99_s < max(0.050, 4 * calm_p99_s)
    assert beside_s[-1] - calm_s[-1] < max(0.150, 4 * calm_s[-1])
