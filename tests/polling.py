"""Wait for what no event reports: the one place where tests ask again and again."""

import time


def until(question, *, limit_s=120.0, pause_s=0.005, missed=lambda: "it never came true"):
    """Ask again until the answer is true; return it.

    Args:
        question: Called without arguments.
        limit_s: After how long the test fails.
        pause_s: Between two questions; longer for those that cost much.
        missed: Called for what the failure shows.
    """
    end_s = time.monotonic() + limit_s
    while not (found := question()):
        assert time.monotonic() < end_s, missed()
        time.sleep(pause_s)
    return found
