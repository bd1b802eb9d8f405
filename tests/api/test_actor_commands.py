"""Commands to actors: one slot of a world context for all of them."""

import queue
import threading
from types import SimpleNamespace

from enact_dist import Actor, View
from enact_dist.actor.running.commands import ACTOR, COMMANDS, CommandListener, send


def test_commands_of_sessions_that_are_gone_do_not_stay(cell):
    """An actor that was killed takes none; the next command drops what is left of it."""
    online = cell.world("online")
    words = View(online, ACTOR, COMMANDS)

    send(online, {"token": "1"}, session="killed", live=["killed"])
    send(online, {"token": "2"}, session="other", live=["other", "killed"])
    assert set(online.view(words)[words]) == {"killed", "other"}

    send(online, {"token": "3"}, session="third", live=["other", "third"])
    assert set(online.view(words)[words]) == {"other", "third"}


class Tuned(Actor):
    gain: float = 1.0


def test_what_is_no_command_is_passed_over_and_the_next_one_is_heard(cell):
    """Any client may write the slot; the actor goes on to listen."""
    online = cell.world("online")
    actor, told = Tuned(), queue.SimpleQueue()
    run = SimpleNamespace(
        words_in="online",
        name="tuned",
        answer=told.put,
        doing=SimpleNamespace(between=threading.Lock()),
    )
    with CommandListener(actor, run, cell, restart=None):
        for word in (7, "text", {"token": "1", "set": {"gain": "2.5"}}):
            send(online, word, session=cell.session, live=[cell.session])
            view = View(online, ACTOR, COMMANDS)
            while word == 7 and cell.session in online.view(view).get(view, {}):
                continue
        assert told.get(timeout=30.0) == "1 done"
    assert actor.gain == 2.5
