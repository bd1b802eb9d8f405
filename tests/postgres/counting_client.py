"""A counting client as a process: `python -m counting_client CELL_FILE NUMBER`.

A line ``next`` waits for an update that was asked for after it; ``end`` checks what was counted.
"""

import sys

from replicated_cell import Counting


def main():
    file, number = sys.argv[1:]
    client = Counting(file, int(number))
    for line in sys.stdin:
        if line.strip() == "end":
            client.end()
            print("right", len(client.values), client.unknown, flush=True)
            return
        print("next", client.next_update(60.0), flush=True)
    client.stop()


if __name__ == "__main__":
    main()
