"""`enact verify`: what it prints, what a failure looks like, how it ends."""

from enact_dist.cli.main import main
from enact_dist.core.state.commits import Commits
from enact_dist.verify.simulation.series import run_series


def test_seeds_run_and_are_told_as_one_json_object(enact):
    """A program finds the figures of the README under the names that it knows."""
    result = enact("verify", "--seeds", "4", "--first", "20", "--jobs", "1", "--json")

    told = result.json
    assert result.status == 0
    assert (told["seeds"], told["first"], told["violations"]) == (4, 20, [])
    assert told["commits"] == told["tally"]["commits"] > 50
    assert told["crashes"] > 0
    assert told["partitions"] > 0
    assert told["simulated_s"] > 60


def test_seeds_are_the_same_on_one_process_and_on_two(enact):
    """How many processes share the work changes nothing but the time."""
    words = ("verify", "--seeds", "4", "--first", "20", "--json")
    one, two = enact(*words, "--jobs", "1").json, enact(*words, "--jobs", "2").json

    assert one["tally"] == two["tally"]
    assert one["seeds"] == two["seeds"] == 4


def test_first_seed_is_never_the_same_twice(enact):
    """Who says nothing gets seeds that nobody has run, and is told which."""
    firsts = {enact("verify", "--seeds", "1", "--jobs", "1", "--json").json["first"] for _ in "12"}

    assert len(firsts) == 2


def test_time_ends_a_series(enact):
    """With a time and no number, seeds run until the time is over."""
    result = enact("verify", "--seconds", "0.001", "--jobs", "1")

    assert result.status == 0
    assert "1 seeds from " in result.out
    assert "0 violations" in result.out


def test_failure_is_told_with_a_short_schedule_and_its_command(enact, monkeypatch):
    """A shard that forgets outcomes: status 1, and the printed command shows the same rule."""
    monkeypatch.setattr(Commits, "_recorded", lambda _commits, _lock: None)

    result = enact("verify", "--seeds", "20", "--first", "0", "--jobs", "1", "--shrink", "20")

    assert result.status == 1
    assert "broken at" in result.out
    assert "still breaks with" in result.out
    (line,) = (line for line in result.out.splitlines() if line.startswith("again: "))
    again = enact(*line.split()[2:], "--json")
    assert again.status == 1
    assert again.json["violations"][0]["rule"] in result.out


def test_one_seed_tells_its_story(enact):
    """Faults with their names, locks with what they asked for, and how they ended."""
    result = enact("verify", "--seed", "5")

    assert result.status == 0
    for text in ("s0 starts with epoch", "[", "asks for", "ends as committed", "faults end"):
        assert text in result.out


def test_part_of_a_run_needs_its_seed(enact):
    """`--only` without a seed says what is missing."""
    result = enact("verify", "--only", "crash.0")

    assert result.status == 2
    assert "--seed" in result.err


def test_client_is_named_by_number(enact):
    """A client named otherwise is refused with the way to name it."""
    result = enact("verify", "--seed", "5", "--clients", "c1")

    assert result.status == 2
    assert "--clients 1,3" in result.err


def test_interrupt_tells_what_was_done_so_far(capsys, monkeypatch):
    """Ctrl-C ends the series; what ran until then is counted and the status says so."""

    def interrupted(first, *, on_progress, **options):
        def stop(totals):
            on_progress(totals)
            if totals.seeds == 2:
                raise KeyboardInterrupt

        return run_series(first, on_progress=stop, **options)

    monkeypatch.setattr("enact_dist.verify.simulation.command.run_series", interrupted)

    assert main(["verify", "--seeds", "9", "--jobs", "2"]) == 130
    out = capsys.readouterr().out
    assert "2 seeds from" in out
    assert "(interrupted)" in out
