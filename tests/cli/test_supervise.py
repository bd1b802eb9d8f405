"""The supervisor: order of start and end, restarts, and children that never outlive it."""

import errno
import json
import os
import subprocess
import sys
import threading
from dataclasses import replace
from types import SimpleNamespace

import pytest

from enact_dist.link.log import says_ready
from enact_dist.operate import supervise
from enact_dist.operate.supervise import Supervisor, Task


def task(name, kind, code):
    return Task(name, kind, (sys.executable, "-c", code))


SERVE = (
    "import signal, sys; signal.signal(signal.SIGTERM, lambda *_: sys.exit(print('leaving')));"
    "print('ready: serving'); signal.pause()"
)


class LogEvent:
    """Lines of the log; `stop` is set when one contains the mark for the wanted time.

    Of those before a line that contains `after` none is counted.
    """

    def __init__(self, mark, times=1, after=""):
        self.lines = []
        self.stop = threading.Event()
        self._mark, self._left, self._after = mark, times, after

    def __call__(self, name, line):
        self.lines.append(f"{name}: {line}")
        if self._after in self.lines[-1]:
            self._after = ""
        if self._mark in self.lines[-1] and not self._after:
            self._left -= 1
            if self._left == 0:
                self.stop.set()

    def run(self, *tasks, **options):
        return Supervisor(tasks, self).run(self.stop, **options)


def test_actors_start_after_the_shards_are_ready_and_leave_before_them():
    """The first line of an actor comes after the shard's; at the end it is the other way round."""
    story = LogEvent("actor: ready")

    status = story.run(task("actor", "actor", SERVE), task("shard", "shard", SERVE))

    assert status == 0
    assert story.lines == [
        "shard: ready: serving", "actor: ready: serving", "actor: leaving", "shard: leaving"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("line", "ready"),
    [
        ("ready: shard left of cell line at tcp/127.0.0.1:7481", True),
        ('{"event": "shard.ready", "text": "ready: shard left"}', True),
        ('{"text": "ready: actor fusion", "event": "actor.ready"}', True),
        ('{"event": "", "text": "ready: says no .ready"}', False),
        ('{"event": "shard.ready", "text": "ready: shar', False),
        ("standing by for shard left of cell line", True),
        ('{"event": "shard.standby", "text": "standing by for shard left"}', True),
        ("is it ready: no", False),
    ],
)
def test_word_of_a_child_that_serves_is_known_in_either_log(line, ready):
    """Text or object; what only quotes it, and half an object, are none."""
    assert says_ready(line) is ready


def test_actors_start_after_a_shard_whose_log_is_json(monkeypatch):
    """Its first line says nothing, its second that it is ready: nobody waits any longer."""
    monkeypatch.setattr(supervise, "READY_S", 3600.0)
    lines = [{"event": "", "text": "ready: not"}, {"event": "shard.ready", "text": "ready: yes"}]
    printed = "".join(f"print({json.dumps(line)!r}, flush=True);" for line in lines)
    silent = SERVE.replace("print('ready: serving')", f"{printed}1")
    story = LogEvent("actor: ready")

    story.run(task("actor", "actor", SERVE), task("shard", "shard", silent))

    assert story.lines[2] == "actor: ready: serving"


def test_child_that_failed_is_started_again_with_growing_pauses():
    """A crash is logged with its status, and each pause is twice the one before."""
    story = LogEvent("exit status 5", times=3)

    story.run(task("shard", "shard", "raise SystemExit(5)"))

    assert story.lines == [
        f"shard: exit status 5; started again in {pause_s:.1f} s" for pause_s in (0.2, 0.4, 0.8)
    ]


def test_pause_is_told_as_it_was_chosen():
    """A supervisor that gets no time between the end of a child and its line says no other one."""
    story = LogEvent("exit status 5")

    class Judged(Supervisor):
        def _judge(self, child, status):
            child.restart_at_s -= 0.15
            super()._judge(child, status)

    Judged([task("shard", "shard", "raise SystemExit(5)")], story).run(story.stop)

    assert story.lines == ["shard: exit status 5; started again in 0.2 s"]


def test_killed_child_is_started_again_by_name_of_the_signal():
    """A child that was killed from outside is reported as such."""
    story = LogEvent("started again")

    story.run(task("shard", "shard", "import os; os.kill(os.getpid(), 9)"))

    assert "shard: ended by SIGKILL; started again in 0.2 s" in story.lines


def test_actor_that_is_done_is_not_started_again():
    """An actor that ends with status 0 has finished; the shards go on."""
    story = LogEvent("again: exit status 5", times=3, after="once: done")
    again = task("again", "actor", "raise SystemExit(5)")  # is started again twice meanwhile

    story.run(task("shard", "shard", SERVE), task("once", "actor", "print('worked')"), again)

    assert story.lines.count("once: worked") == 1
    assert "once: done; it is not started again" in story.lines


def test_shard_that_can_never_run_ends_everything():
    """Status 2 is a wrong configuration: the run ends with status 1 and says which shard."""
    story = LogEvent("never")

    status = story.run(task("good", "shard", SERVE), task("bad", "shard", "raise SystemExit(2)"))

    assert status == 1
    assert story.lines[-1] == ": stopped: shard bad cannot run"


@pytest.mark.parametrize(
    ("status", "said"),
    [
        (0, "exit status 0"),
        (3, "exit status 3"),
        (-15, "ended by SIGTERM"),
        (-44, "ended by signal 44"),
    ],
)
def test_end_by_a_signal_is_named(status, said):
    """Nobody should have to look up what -15 is, in one line or another."""
    assert supervise.ended_how(status) == said


def test_child_that_a_signal_ends_while_it_drains_is_said_to():
    """It has no handler of its own; a kill by hand and one of the supervisor read the same."""
    story = LogEvent("ready:")

    story.run(task("plain", "shard", "import signal; print('ready:'); signal.pause()"))

    assert story.lines[-1] == "plain: ended by SIGTERM"


def test_second_signal_kills_what_does_not_leave():
    """Whoever asks twice does not wait for a child that ignores SIGTERM."""
    deaf = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready:'); signal.pause()"
    story = LogEvent("ready:")

    story.run(task("deaf", "shard", deaf), count=lambda: 2)

    assert "deaf: did not end in time and is killed" in story.lines


def test_child_that_drains_long_is_waited_for_and_no_other(monkeypatch, tmp_path):
    """Each is given the drain that it was told of; one that is not ended by then is killed."""
    monkeypatch.setitem(supervise.END_S, "shard", 0.5)
    gate = tmp_path / "gate"
    os.mkfifo(gate)
    deaf = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready:'); signal.pause()"
    slow = SERVE.replace("lambda *_: ", f"lambda *_: open({str(gate)!r}).read() or ")
    story = LogEvent("ready:", times=2)

    def tell(name, line):
        story(name, line)
        if "deaf: did not end in time" in story.lines[-1]:
            gate.write_text("")  # read by now, or as soon as it is

    tasks = [task("deaf", "shard", deaf), replace(task("slow", "shard", slow), drain_s=600.0)]
    Supervisor(tasks, tell).run(story.stop)

    assert "deaf: did not end in time and is killed" in story.lines
    assert "slow: leaving" in story.lines
    assert "slow: did not end in time and is killed" not in story.lines


def test_children_go_on_when_nobody_reads_the_log():
    """A closed pipe behind the log stops neither the children nor the orderly end."""
    stop = threading.Event()
    said = []

    def say(name, line):
        said.append(line)
        stop.set()
        raise BrokenPipeError

    assert Supervisor([task("shard", "shard", SERVE)], say).run(stop) == 0
    assert said == ["ready: serving"]


def test_line_that_cannot_be_printed_is_counted_and_stops_nobody():
    """Of a full disk, or in a character set that lacks a letter: the next line is printed."""
    stop, said = threading.Event(), []

    def say(name, line):
        if not stop.is_set():
            stop.set()
            raise OSError(errno.ENOSPC, "no space left")
        said.append((name, line))

    assert run_in_time(Supervisor([task("shard", "shard", SERVE)], say), stop) == 0
    assert said == [("", "1 lines of this log were lost"), ("shard", "leaving")]


def test_end_of_a_child_is_noticed_though_its_output_cannot_be_read(monkeypatch):
    """A supervisor that is short of descriptors still ends."""

    def refused():
        raise OSError(errno.EMFILE, "too many open files")

    monkeypatch.setattr(supervise, "select", SimpleNamespace(epoll=refused))
    story = LogEvent("done; it is not started again")

    ended = run_in_time(Supervisor([task("one", "actor", "")], story), story.stop)

    assert ended == 0
    assert "one: cannot read its output any more: [Errno 24] too many open files" in story.lines


def run_in_time(supervisor, stop):
    """Run a supervisor; return what it returned, None where it does not end."""
    ended = []
    thread = threading.Thread(target=lambda: ended.append(supervisor.run(stop)), daemon=True)
    thread.start()
    thread.join(120)
    return ended[0] if ended else None


HOLDS = (
    "import os, subprocess, sys;"
    "held = subprocess.Popen([sys.executable, '-c', 'import signal; signal.pause()']);"
    "print('holder', held.pid, flush=True); os.kill(os.getpid(), 9)"
)


def test_death_is_noticed_while_a_grandchild_holds_the_output(request):
    """The end of a child is that of its process, whoever still has its end of the pipe."""
    story = LogEvent("started again")
    say, held = story.__call__, []

    def note(name, line):
        if line.startswith("holder"):
            held.append(int(line.split()[1]))
        say(name, line)

    request.addfinalizer(lambda: [os.kill(pid, 9) for pid in held])
    running = threading.Thread(
        target=Supervisor([task("shard", "shard", HOLDS)], note).run, args=(story.stop,)
    )
    running.start()
    heard = story.stop.wait(60)
    story.stop.set()
    for pid in held[:] if not heard else ():
        held.remove(pid)
        os.kill(pid, 9)  # or the supervisor would wait for it, too
    running.join(60)

    assert heard
    assert "shard: ended by SIGKILL; started again in 0.2 s" in story.lines


def test_last_words_of_a_child_come_before_its_end():
    """All that a child has written is in the log before its death is told."""
    story = LogEvent("started again")
    code = "import os; print('x' * 60_000); print('last', flush=True); os.kill(os.getpid(), 9)"

    story.run(task("shard", "shard", code))

    assert story.lines[1] == "shard: last"
    assert "ended by SIGKILL" in story.lines[2]


def test_pids_name_the_running_children():
    """Who looks on can find the processes."""
    story = LogEvent("ready:")
    supervisor = Supervisor([task("shard", "shard", SERVE)], story)
    seen = {}

    def count():
        seen.update(supervisor.pids())
        return 1

    supervisor.run(story.stop, count=count)

    assert set(seen) == {"shard"}
    assert supervisor.pids() == {}


def test_child_ends_when_its_supervisor_was_killed(tmp_path):
    """Even kill -9 of the supervisor leaves no child behind."""
    child = (
        "from enact_dist.operate.supervise import end_with_supervisor; end_with_supervisor();"
        "import os, signal; print('ready:', os.getpid()); signal.pause()"
    )
    code = (
        "import sys, threading; from enact_dist.operate.supervise import Supervisor, Task;"
        f"Supervisor([Task('x', 'shard', (sys.executable, '-c', {child!r}))],"
        "lambda name, line: print(line, flush=True)).run(threading.Event())"
    )
    above = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        pid = int(above.stdout.readline().removeprefix("ready:"))
        child_end = os.pidfd_open(pid)
        above.kill()
        above.wait()

        import select

        assert select.select([child_end], [], [], 10)[0] == [child_end]
        os.close(child_end)
    finally:
        above.kill()
        above.wait()
        above.stdout.close()


def test_child_of_a_supervisor_that_is_gone_refuses_to_start(monkeypatch):
    """Between fork and the first line the supervisor may have died."""
    from enact_dist.errors import EnactError

    monkeypatch.setenv(supervise.SUPERVISOR_VARIABLE, "1")
    monkeypatch.setattr(os, "getppid", lambda: 4711)
    with pytest.raises(EnactError, match="is gone"):
        supervise.end_with_supervisor()
