"""A program that commits pairs of data as fast as it is told, for the recorders that are killed.

    python loaded_cell.py ENDPOINT PAUSE_S

Each commit sets both slots of `online` to the same number; prints a line once it has begun.
"""

import sys
import time

import numpy as np

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.errors import LeaseLostError

NUMBER = Aspect("number", np.ndarray, retention=400)


def commit(requests, number):
    """Set all to a number; again where a slow machine has cost the lock, which writes nothing."""
    while True:
        try:
            with Lock(*requests, wait_s=60.0) as lock:
                for request in requests:
                    lock[request] = np.full(20_000, number)
        except LeaseLostError:
            continue
        return


def main():
    endpoint, pause_s = sys.argv[1], float(sys.argv[2])
    with connect(endpoint) as cell:
        online = cell.create_world("online")
        requests = [Write(online, Entity(name), NUMBER) for name in ("left", "right")]
        number = 0
        while True:
            number += 1
            commit(requests, number)
            if number == 1:
                print("committing", flush=True)
            time.sleep(pause_s)  # how much load there is


if __name__ == "__main__":
    main()
