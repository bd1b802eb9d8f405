"""The hostile client of a flood: `attacking CELL ATTACK VICTIM_SESSION`.

It says ``begun`` once its first round is over, or has gone on for `BEGUN_S`; goes on until a line
comes; and says ``told {json}`` with what its messages came to.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections import Counter
from pathlib import Path
from typing import Final

from enact_dist.config.read import load_config
from enact_dist.errors import LinkError
from enact_dist.verify.floods.attacker import FIRST, Attacker
from enact_dist.verify.floods.attacks import ATTACKS, Attack
from enact_dist.verify.floods.raw import RawZenoh, fresh_session

BEGUN_S: Final = 3.0


def _attack(attack: Attack, attacker: Attacker, stop: threading.Event) -> None:
    """Repeat rounds until stopped; each round reopens what the last one found closed."""
    while not stop.is_set():
        try:
            attack.round(attacker)
        except (LinkError, OSError) as error:
            attacker.tally[type(error).__name__] += 1
        _begun.set()
        attacker.tally["rounds"] += 1


_begun = threading.Event()


def main(file: str, name: str, victim: str) -> None:
    """Attack until a line comes on the standard input, or its end."""
    (attack,) = (attack for attack in ATTACKS if attack.name == name)
    config = load_config(Path(file))
    stop = threading.Event()
    with RawZenoh(config, mode=attack.mode) as zenoh:
        session = fresh_session()
        attacker = Attacker(
            config, zenoh, zenoh.welcome(FIRST, session), session, victim, zenoh.tally
        )
        rounds = threading.Thread(target=_attack, args=(attack, attacker, stop), daemon=True)
        rounds.start()
        _begun.wait(BEGUN_S)
        print("begun", flush=True)
        sys.stdin.readline()
        stop.set()
        told = {"tally": Counter(zenoh.tally), "heard": Counter(attacker.heard)}
        print("told", json.dumps(told), flush=True)
        os._exit(0)  # threads that still wait for a shard must not delay the exit


if __name__ == "__main__":
    main(*sys.argv[1:])
