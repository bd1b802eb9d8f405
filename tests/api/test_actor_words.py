"""Commands to actors: one slot of a world context for all of them."""

from enact_dist import View
from enact_dist.actor_words import ACTOR, WORDS, tell


def test_commands_of_sessions_that_are_gone_do_not_stay(cell):
    """An actor that was killed takes none; the next command drops what is left of it."""
    online = cell.world("online")
    words = View(online, ACTOR, WORDS)

    tell(online, {"token": "1"}, session="killed", live=["killed"])
    tell(online, {"token": "2"}, session="other", live=["other", "killed"])
    assert set(online.view(words)[words]) == {"killed", "other"}

    tell(online, {"token": "3"}, session="third", live=["other", "third"])
    assert set(online.view(words)[words]) == {"other", "third"}
