"""When all shards show a commit, and what counts for a shard that does not answer."""

from types import SimpleNamespace

import pytest

from enact_dist.core.protocol.messages import AwaitStamp, Reached
from enact_dist.recording.settling import Settling

SHOWN, NOT_YET, SILENT = Reached(True, 7), Reached(False, 5), None


class Asked:
    """A client of two shards; the right one answers as it is scripted, then shows all."""

    def __init__(self, *right):
        self.core = SimpleNamespace(session="recorder")
        self.right, self.asked = list(right), 0

    def shards(self):
        return ("left", "right")

    def ask_each(self, shards, request_of, *, timeout_s):
        assert timeout_s > 0
        assert all(isinstance(request_of(shard, 1, 1), AwaitStamp) for shard in shards)
        self.asked += 1
        answer = self.right.pop(0) if self.right else SHOWN
        return {"left": SHOWN, "right": answer}


@pytest.mark.parametrize("late", [NOT_YET, SILENT])
def test_end_asks_a_shard_again_until_it_shows_the_commit(late):
    """A busy host delays one answer; the recording would end without that shard's versions."""
    client = Asked(late, late, SHOWN)
    Settling(client).wait_shown(7, wait_s=60.0)
    assert (client.asked, client.right) == (3, [])


def test_end_gives_a_shard_up_when_the_time_is_over():
    """A shard whose host is gone must not hold up the end of a recording."""
    client = Asked(*[SILENT] * 1000)
    Settling(client).wait_shown(7, wait_s=0.0)
    assert client.asked == 1


def test_running_recording_does_not_wait_for_a_silent_shard():
    """What is to be fetched from the others is forgotten soon."""
    client = Asked(SILENT)
    settling = Settling(client)
    settling.told(7)
    assert settling.settled_ns(0.0) == 7
