"""Actors of one process: one that fails, is done or hangs, and what becomes of the others."""

import logging
import threading

import pytest

from enact_dist.actor.running.doing import Doing
from enact_dist.actor.running.group import ANEW, ActorGroup
from enact_dist.link.log import JsonLines, TextLines
from enact_dist.operate import supervise

PATIENCE_S = 30.0


class Actors:
    """Actors as a group runs them; what each does in its lives, by name, the last one for ever.

    "serves" until it is asked to end, "hangs" whatever it is asked; a number is the exit status
    with which it ends at once.
    """

    def __init__(self, **lives):
        self.lives = lives
        self.begun = dict.fromkeys(lives, 0)
        self.ready, self.alive, self.left, self.freed = [], 0, [], threading.Event()
        self.changed = threading.Condition()
        self.group = ActorGroup(
            "camera-3", dict.fromkeys(lives, 0.05), self._live,
            alive=self._alive, ready=lambda: self.ready.append(dict(self.begun)),
            leave=self._leave,
        )  # fmt: skip
        self.status = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.freed.set()
        self.group.end("the end of the test")
        self._thread.join(PATIENCE_S)

    def until(self, holds):
        with self.changed:
            assert self.changed.wait_for(holds, PATIENCE_S), (self.begun, self.ready, self.left)

    def ended(self):
        self._thread.join(PATIENCE_S)
        return self.status

    def _run(self):
        self.status = self.group.run()

    def _tell(self):
        with self.changed:
            self.changed.notify_all()

    def _alive(self):
        self.alive += 1
        self._tell()

    def _leave(self, status):
        self.left.append(status)
        self._tell()

    def _live(self, name, life):
        plan = self.lives[name]
        does = plan[min(self.begun[name], len(plan) - 1)]
        self.begun[name] += 1
        self._tell()
        if isinstance(does, int):
            return does
        doing = Doing(name)
        life.begin(doing)
        life.ready()
        self._tell()
        with doing.inside("update"):
            (life.stop if does == "serves" else self.freed).wait()
        return 0


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch):
    monkeypatch.setattr(supervise, "PAUSE_S_MIN", 0.01)


def test_actor_that_fails_is_started_again_and_the_others_run_on(caplog):
    """Three failures, then it serves; the other one lives once.  The process is ready then."""
    with Actors(camera=["serves"], subtraction=[1, 3, ANEW, "serves"]) as actors:
        actors.until(lambda: actors.begun["subtraction"] == 4)
        actors.until(lambda: actors.ready)
        assert actors.begun["camera"] == 1
        actors.group.end("SIGTERM")
        assert actors.ended() == 0

    assert len(actors.ready) == 1
    failed = [one.getMessage() for one in caplog.records if "failed" in one.getMessage()]
    assert [line.partition(";")[0] for line in failed] == ["actor subtraction failed"] * 2


def test_actor_that_is_done_or_can_never_run_is_not_started_again(caplog):
    """Each is told; the status is that of wrong usage, so that nothing starts the process again."""
    caplog.set_level(logging.INFO)
    with Actors(once=[0], misfit=[2]) as actors:
        assert actors.ended() == supervise.NEVER_AGAIN

    assert actors.begun == {"once": 1, "misfit": 1}
    told = {one.getMessage() for one in caplog.records}
    assert "actor once is done; it is not started again" in told
    assert "actor misfit cannot run like this and is not started again" in told


def test_process_whose_actors_are_all_done_is_done():
    """As one actor in a process of its own."""
    with Actors(first=[0], second=[0]) as actors:
        assert actors.ended() == 0


def test_actor_that_does_not_end_ends_the_process_after_the_others(caplog):
    """A thread cannot be ended alone: the others finish first, then nothing waits for it."""
    with Actors(camera=["serves"], hung=["hangs"]) as actors:
        actors.until(lambda: actors.ready)
        actors.group.end("SIGTERM")
        actors.until(lambda: actors.left)

    assert actors.left[0] == 1
    cut_off = [one.getMessage() for one in caplog.records if "cut off" in one.getMessage()]
    assert len(cut_off) == 1
    assert cut_off[0].startswith("cut off: actor hung did not end within 0.05 s of SIGTERM")


def test_actor_that_hangs_when_it_is_to_restart_takes_the_process_with_it(caplog):
    """The others are asked to end, and the log says why."""
    lives = {}

    class Restarted(Actors):
        def _live(self, name, life):
            lives[name] = life
            return super()._live(name, life)

    with Restarted(camera=["serves"], hung=["hangs"]) as actors:
        actors.until(lambda: actors.ready)
        lives["hung"].end("the word to begin anew")
        actors.until(lambda: actors.left)
        assert lives["camera"].stop.is_set()

    assert any("process camera-3 ends, since actor hung does not" in one for one in caplog.messages)


def test_second_signal_cuts_off_all_that_still_run():
    """At once, whatever their drains are."""
    with Actors(first=["hangs"], second=["hangs"]) as actors:
        actors.group._drains_s = dict.fromkeys(actors.begun, 3600.0)
        actors.until(lambda: actors.ready)
        actors.group.end("SIGTERM")
        actors.group.stop_now("SIGTERM")
        actors.until(lambda: actors.left)

    assert actors.left[0] == 1


def test_process_lives_only_while_all_its_serving_actors_do():
    """One that serves and does not look any more ends the pulse of the process."""
    with Actors(camera=["serves"], hung=["hangs"]) as actors:
        actors.until(lambda: actors.ready)
        actors.until(lambda: actors.alive)
        with actors.changed:
            seen = actors.alive  # the pulse of its `ready` may be counted once more
            assert not actors.changed.wait_for(lambda: actors.alive > seen + 1, 1.0)


def test_log_says_which_actor_of_a_process_speaks():
    """By the thread: the actor's own, and one that serves it; other threads are of the process."""
    text, objects = TextLines(["camera"]), JsonLines(process="process p", actors=["camera"])

    def lines(thread):
        record = logging.makeLogRecord({"msg": "hello", "levelname": "INFO", "name": "x"})
        record.threadName = thread
        return text.format(record), objects.format(record)

    assert lines("camera")[0].startswith("[camera] ")
    assert '"process": "actor camera"' in lines("camera lookout")[1]
    assert "[" not in lines("Thread-7")[0]
    assert '"process": "process p"' in lines("Thread-7")[1]
