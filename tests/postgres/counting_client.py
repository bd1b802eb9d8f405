"""A counting client as a process: `python -m counting_client CELL_FILE NUMBER`.

A line ``next`` waits for an update that was asked for after it, for 60 s or as many as it says;
``longest`` tells the longest pause between two updates, and what was raised; ``end`` checks what
was counted.
"""

import sys
from itertools import pairwise

from replicated_cell import Counting


def main():
    file, number = sys.argv[1:]
    client = Counting(file, int(number))
    for line in sys.stdin:
        if line.strip() == "end":
            client.end()
            print("right", len(client.values), client.unknown, flush=True)
            return
        if line.strip() == "longest":
            pauses = [after - before for before, after in pairwise(client.done_s)]
            kinds = sorted({type(error).__name__ for error in client.errors})
            print("longest", f"{max(pauses):.2f} s", *kinds, flush=True)
            continue
        wait_s = float(line.strip().removeprefix("next") or 60.0)
        print("next", client.next_update(wait_s), flush=True)
    client.stop()


if __name__ == "__main__":
    main()
