"""What is checked of each model with Spin, and how.

A variant is one run: a model with some macros defined, searched exhaustively.  Either it *holds*,
or it is a small wrong edit that must *break* a rule, or it must *reach* a place, so that what holds
does not hold because nothing happens.
"""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).parent
HOLDS, BREAKS, REACHES = "holds", "breaks", "reaches"
DEPTH_MAX = 200_000
MINUTES_MAX = 10
GOAL_BASE = 100
"""Reached places are reported as rules from here on."""

RULES = {
    1: "I1 no two holders",
    2: "I2 each version is built on the one before",
    3: "I3 all or nothing",
    4: "I4 nothing told is lost",
    5: "I5 what is told is true",
    6: "I6 strict serializability",
    7: "I7 no two believers",
    9: "I9 never committed and aborted",
    10: "I10 prepared keeps its lock",
    11: "I11 nothing of an epoch that is over",
    12: "I12 nothing is left",
    13: "I13 no waiter is bypassed",
    16: "I16 nothing is executed twice",
    17: "I17 a commit in flight keeps its lock",
    18: "I18 no commit is seen half",
}


class SpinError(Exception):
    """Spin, the compiler or the search itself failed; nothing is known about the model."""


@dataclass(frozen=True, slots=True)
class Variant:
    """One run.

    Attributes:
        model: File name without ending.
        text: What this run is about.
        expects: `HOLDS`, `BREAKS` or `REACHES`.
        defines: Macros, as `spin -D` takes them.
        rule: Which rule breaks, or which place is reached.
    """

    model: str
    text: str
    expects: str
    defines: tuple[str, ...] = ()
    rule: int = 0

    @property
    def name(self) -> str:
        """Name for tables and test ids: the mutant's or goal's macro stands first."""
        return f"{self.model}-{self.expects}-{'-'.join(self.defines) or 'plain'}"


@dataclass(frozen=True, slots=True)
class Result:
    """What came of a run.

    Attributes:
        states: States stored.
        depth: Depth reached; where a rule broke, the length of the way there.
        seconds: CPU time of spin, compiler and search together.
        rule: The rule that broke first, 0 for none; places reached from `GOAL_BASE` on.
        unreached: Source lines that no state of this run executes.
    """

    states: int
    depth: int
    seconds: float
    rule: int
    unreached: frozenset[int] = field(default=frozenset())

    def verdict(self, variant: Variant) -> str:
        """Say in a few words what came of it."""
        if not self.rule:
            return "holds" if variant.expects == HOLDS else "NOT CAUGHT"
        if self.rule > GOAL_BASE:
            return "reached"
        right = variant.expects == BREAKS and self.rule == variant.rule
        return f"{'broken' if right else 'BROKEN'}: {RULES[self.rule]}"

    def as_expected(self, variant: Variant) -> bool:
        """Whether the run ended as it must."""
        wanted = {HOLDS: 0, BREAKS: variant.rule, REACHES: GOAL_BASE + variant.rule}
        return self.rule == wanted[variant.expects]


def _wrong_and_reached(
    model: str,
    mutants: list[tuple[str, tuple[str, ...], int, str]],
    goals: list[tuple[int, tuple[str, ...], str]],
) -> list[Variant]:
    """Return the wrong edits and places of a model, each with the size in which it is found."""
    breaks = [Variant(model, text, BREAKS, (m, *size), rule) for m, size, rule, text in mutants]
    return breaks + [Variant(model, t, REACHES, (f"GOAL={n}", *size), n) for n, size, t in goals]


def _commits() -> list[Variant]:
    model, one = "commit_over_shards", ("CLIENTS=1", "LOCKS=2", "KINDS=4")
    mutants = [
        ("NO_FENCE", 3, "whoever once had the lock may prepare and commit"),
        ("PREPARED_ENDS", 3, "a lease or a release ends what is prepared"),
        ("IN_FLIGHT_ENDS", 17, "a lease ends a commit that the disk works on"),
        ("FORGETS_OUTCOMES", 5, "a repeated commit finds no record of the first"),
        ("FORGETS_DECISIONS", 9, "a primary that has committed answers that it has not"),
        ("ABORTS_OPEN", 3, "a primary that has not decided yet says that it never will"),
        ("COMMITS_WITHOUT_VOTES", 3, "a client commits before its participant has prepared"),
        ("SKIPS_VALIDATION", 6, "reads on the other shard are not validated"),
        ("GUESSES", 5, "a client takes silence after the commit for a no"),
        ("PROMISES_EARLY", 3, "Prepared is answered before its record is durable"),
        ("TELLS_EARLY", 3, "the participant hears of a decision before it is durable"),
        ("NEVER_TELLS", 12, "neither a decision is told nor is it asked for"),
        ("FORGETS_PREPARED", 3, "a restarted participant has lost what it has prepared"),
        ("RESTORES_NO_LOCK", 10, "a restarted participant has what it prepared, not its lock"),
    ]
    late_mutants = [("FINISHED_EARLY", one, 9, "Finished is said before the end is durable")]
    late_goals = [(5, one, "a late resolve after all is finished and forgotten")]
    goals = [
        (1, "a read is validated"),
        (2, "a client is told that it has committed"),
        (3, "a commit under a lost lock is fenced"),
        (4, "a commit never arrived before its shard restarted"),
        (6, "a participant restarts between prepare and finish"),
        (7, "a primary restarts after its decision, its client gone"),
        (8, "an abort that the disk had not kept is asked for again"),
        (9, "presumed abort ends what is prepared"),
    ]
    return [
        Variant(model, "2 clients, 1 lock each, 1 restart of each shard", HOLDS),
        Variant(model, "1 client, 2 locks, 1 restart of each shard", HOLDS, one),
        *(Variant(model, text, BREAKS, (macro,), rule) for macro, rule, text in mutants),
        *(Variant(model, text, REACHES, (f"GOAL={goal}",), goal) for goal, text in goals),
        *_wrong_and_reached(model, late_mutants, late_goals),
    ]


def _grace() -> list[Variant]:
    model = "grace"
    mutants = [
        ("NO_GRACE", "a restarted shard grants at once"),
        ("SHORT_GRACE", "the grace is shorter than a belief"),
        ("BLIND_ACKNOWLEDGEMENT", "any hello counts as an acknowledgement of the epoch"),
        ("OLD_GRANT", "a client takes a grant of an epoch that is over"),
        ("KEEPS_GRANTS", "a client acknowledges without dropping what it holds"),
        ("WELCOMES_EARLY", "a session acts before its record is durable"),
    ]
    goals = [
        (1, (), "the grace ends early: all have acknowledged"),
        (2, (), "a lock is held in the second epoch"),
        (3, (), "a grant of an epoch that is over is refused"),
        (4, (), "a goodbye ends the grace"),
        (5, (), "a keep-alive renews a belief that was over"),
        (6, (), "the grace ends by time"),
    ]
    return [
        Variant(model, "2 clients, 1 restart, any number of locks", HOLDS),
        *_wrong_and_reached(model, [(macro, (), 7, t) for macro, t in mutants], goals),
    ]


def _cuts() -> list[Variant]:
    model = "cuts"
    steady = ("RESTARTS=0", "ELSEWHERE=1")
    restart = ("COMMITS=1", "CLOCK_MAX=4")
    observer = (*restart, "OBSERVER=1")
    mutants = [
        ("FIRST_VIEWS", steady, "views are taken as they come"),
        ("IGNORES_UNDECIDED", steady, "a view's end does not stay below what is undecided"),
        ("CLOCK_STAYS", steady, "asked as of a stamp, a shard does not move its clock past it"),
        ("STAMPS_ALONE", steady, "a commit's stamp does not come after those prepared"),
        ("OLD_EPOCHS_COUNT", restart, "an answer of an epoch that is over counts"),
        ("NO_GRACE", restart, "a restarted shard does not wait for whom it answered"),
        ("NO_CONFIRMATION", observer, "an observer does not ask whether somebody restarted"),
    ]
    goals = [
        (1, steady, "one round trip settles the cut"),
        (2, steady, "a shard goes back to a state that is past"),
        (3, restart, "a cut stands though a shard has restarted since"),
        (4, restart, "an answer of an epoch that is over does not count"),
        (5, steady, "an undecided commit stands in the way"),
        (6, steady, "no cut is found"),
        (7, observer, "an observer's first answers are confirmed"),
        (8, observer, "an observer's first answers are not confirmed"),
    ]
    return [
        Variant(model, "2 commits, stamps up to 6, views elsewhere too", HOLDS, steady),
        Variant(model, "1 commit, stamps up to 4, 1 restart", HOLDS, restart),
        Variant(model, "the same, seen by an observer", HOLDS, observer),
        *_wrong_and_reached(model, [(m, size, 18, text) for m, size, text in mutants], goals),
    ]


def _expected_views() -> list[Variant]:
    model, one = "expected_views", ("ONE_SHARD=1",)
    mutants = [
        ("EXPECTS_NOTHING", (), "the views are not expected: both commit"),
        ("BESIDE_WRITERS", (), "an expected view does not mind who holds the slot for writing"),
        ("CALLED_ALONE", (), "a lock that views elsewhere is said to lie on one shard"),
        ("EXPECTS_NOTHING", one, "the same on one shard: both commit"),
        ("OVERLOOKS_IN_FLIGHT", one, "a commit that the disk works on is overlooked"),
    ]
    goals = [
        (1, (), "an expectation is refused at the other shard"),
        (2, one, "an expectation is refused by the commit itself"),
        (3, (), "both commit, one after the other"),
        (3, one, "both commit, one after the other, on one shard"),
    ]
    return [
        Variant(model, "2 shards, 2 clients, 2 locks each", HOLDS),
        Variant(model, "1 shard, 2 clients, 2 locks each", HOLDS, one),
        *_wrong_and_reached(model, [(m, size, 6, text) for m, size, text in mutants], goals),
    ]


def _kept_grants() -> list[Variant]:
    model = "kept_grants"
    living, restart, one = ("NO_DEATH",), ("EPOCHS=2",), ("ONE_SESSION",)
    steady = ("STEADY", *living)
    more, silent = ("LOCKS0=3", "LOCKS1=2", *steady), ("NO_RELEASES", "LOCKS1=2", *steady)
    renumbered = (*one, *restart, "LOCKS1=2", *steady)
    mutants = [
        ("USES_WITHOUT_MARK", steady, 7, "a use begins by the cell alone"),
        ("REVOKES_IN_USE", steady, 7, "the shard revokes without asking about the mark"),
        ("MARK_BEFORE_CELL", steady, 7, "it asks about the mark, then clears the cell"),
        ("NO_LOOK_BEFORE", steady, 13, "a use begins without a look at the cell"),
        ("NO_SEQ_CHECK", steady, 2, "any seq commits under a kept grant"),
        ("LATE_READS", steady, 7, "a late Validate ends a kept grant that is in use"),
        ("KEEPS_AFTER_UNKNOWN", steady, 2, "the entry stays after a commit without an answer"),
        ("SHOWS_OLD", steady, 2, "its own commit does not change the entry"),
        ("KEEPS_WITH_WAITER", steady, 12, "a grant is kept though another lock waits"),
        ("LEAVES_MARK", steady, 12, "a use without an answer does not give its mark back"),
        ("NO_REPAIR", steady, 12, "a tick does not look after what was recalled"),
        ("SETS_CELL_AGAIN", more, 7, "a commit after the recall sets the cell again"),
        ("BREAKS_SILENTLY", living, 6, "a kept grant that is broken leaves its number in the cell"),
        ("KEEP_ALIVE_ENDS_KEPT", steady, 7, "a keep-alive frees a grant whose first lock is over"),
        ("SUPERSEDES_KEPT", (*one, *steady), 7, "so does a newer lock of the thread"),
        ("IN_FLIGHT_ENDS", steady, 2, "a grant whose commit the store works on is revoked"),
        ("KEEPS_OVER_EPOCH", (*restart, *steady), 6, "an epoch is acknowledged, the entry stays"),
        ("DROPS_ENTRIES_ALONE", (*restart, *steady), 6, "an entry that was just taken stays"),
        ("BELIEVES_FOREVER", (*restart, *living), 6, "a use begins though its lease is over"),
        ("NUMBERS_START_AGAIN", renumbered, 7, "an epoch uses the old bytes again"),
    ]
    goals = [
        (1, steady, "a recall between the mark and the look at the cell"),
        (2, steady, "the look after a use finds that it was recalled"),
        (3, steady, "a late commit under a kept grant that its client has forgotten"),
        (4, steady, "a recall in use"),
        (5, steady, "a recall while idle"),
        (6, steady, "a tick ends what was recalled"),
        (7, (*restart, *steady), "a restart beside a kept grant"),
        (8, steady, "a session's own kept grant is in its way"),
        (9, living, "a lease ends while the mark is held"),
    ]
    return [
        Variant(model, "2 sessions, 2 locks each", HOLDS, ("LOCKS1=2", *living)),
        Variant(model, "3 locks and 2; no lease ends", HOLDS, more),
        Variant(model, "2 locks each; no lease ends, no Release comes", HOLDS, silent),
        Variant(model, "2 locks and 1, deaths, 1 restart", HOLDS, restart),
        Variant(model, "1 session, 2 threads, 2 locks and 1, 1 restart", HOLDS, (*one, *restart)),
        *_wrong_and_reached(model, mutants, goals),
    ]


def _kept_far() -> list[Variant]:
    model = "kept_far"
    living, restart, one = ("NO_DEATH",), ("EPOCHS=2",), ("ONE_SESSION",)
    steady = ("STEADY", *living)
    more, writes = ("LOCKS0=3", "LOCKS1=2", *steady), ("WRITES_ALONE", *steady)
    mutants = [
        ("RELEASES_IN_USE", writes, 7, "word of a recall ends the grant under its block"),
        ("REVOKES_AT_ONCE", writes, 7, "the shard does not wait for the client"),
        ("RELEASES_AND_KEEPS", writes, 7, "a grant is given back, and its entry stays"),
        ("ENDING_IS_NO_USE", writes, 7, "word between a commit and its answer finds no use"),
        ("LATE_READS", writes, 7, "a late Validate ends a kept grant that is in use"),
        ("KEEP_ALIVE_ENDS_KEPT", writes, 7, "a keep-alive frees a grant whose first lock is over"),
        ("SUPERSEDES_KEPT", (*one, *steady), 7, "so does a newer lock of the thread"),
        ("BELIEVES_FOREVER", living, 6, "blocks begin and end alone though the lease is over"),
        ("KEEPS_OVER_EPOCH", (*restart, *steady), 6, "an epoch is acknowledged, the entry stays"),
        ("NO_SEQ_CHECK", steady, 2, "any seq commits under a kept grant"),
        ("KEEPS_AFTER_UNKNOWN", steady, 2, "the entry stays after a commit without an answer"),
        ("SHOWS_OLD", steady, 2, "its own commit does not change the entry"),
        ("IN_FLIGHT_ENDS", steady, 2, "a grant whose commit the store works on is given back"),
        ("PUTS_BACK_RECALLED", steady, 13, "what was heard in a block is forgotten with it"),
        ("KEEPS_WITH_WAITER", steady, 12, "a grant is kept though another lock waits"),
        ("TELLS_ONCE", steady, 12, "word of a recall that is lost is not repeated"),
        ("IGNORES_UNKNOWN", steady, 12, "word of a grant that nobody remembers is ignored"),
    ]
    goals = [
        (1, steady, "a block ends whose grant was recalled meanwhile"),
        (2, steady, "a block that only reads ends without a message"),
        (3, steady, "word comes in a block"),
        (4, steady, "word comes between two blocks"),
        (5, steady, "word comes of a grant that its client has forgotten"),
        (6, steady, "a late commit under a kept grant that its client has forgotten"),
        (7, (*restart, *steady), "a restart beside a kept grant"),
        (8, steady, "a recalled grant is given back"),
        (9, living, "a lease ends whose grant was recalled"),
    ]
    return [
        Variant(model, "2 sessions, 2 locks each", HOLDS, ("LOCKS1=2", *living)),
        Variant(model, "3 locks and 2; no lease ends", HOLDS, more),
        Variant(model, "2 locks and 1, deaths, 1 restart", HOLDS, restart),
        Variant(model, "1 session, 2 threads, 2 locks and 1, 1 restart", HOLDS, (*one, *restart)),
        *_wrong_and_reached(model, mutants, goals),
    ]


def _kept_order() -> list[Variant]:
    model, three, far = "kept_order", ("THREADS=3", "LOCKS=2"), ("FAR",)
    mutants = [
        ("NEVER_REVOKES", (), 12, "a kept grant ends with its next use only"),
        ("OWN_NOT_REVOKED", (), 12, "a kept grant does not end for a lock of the same session"),
        ("TAKES_EARLY", (), 12, "a lock over two shards takes what is kept at once, out of turn"),
        ("NO_ORDER", (), 12, "one client begins with the other shard"),
        ("HEARS_BETWEEN_LOCKS", far, 12, "word of a recall is heard between two locks only"),
    ]
    goals = [
        (1, (), "a lock begins from what is kept"),
        (2, (), "a lock over two shards ends what its own session keeps"),
        (3, (), "a lock over two shards is granted"),
        (4, (), "a lock ends what another session keeps"),
        (5, (), "what is kept ends with its use"),
        (6, far, "word of a recall ends what is kept"),
    ]
    return [
        Variant(model, "2 sessions, 2 shards, 4 locks each", HOLDS, ("LOCKS=4",)),
        Variant(model, "the same, one of them with 2 threads, 2 locks each", HOLDS, three),
        Variant(model, "no common memory, 4 locks each", HOLDS, ("FAR", "LOCKS=4")),
        Variant(
            model, "the same, one of them with 2 threads, 2 locks each", HOLDS, ("FAR", *three)
        ),
        *_wrong_and_reached(model, mutants, goals),
    ]


def _standing_locks() -> list[Variant]:
    model = "standing_locks"
    mutants = [
        ("TAKES_COPY", "a late copy of an ended lock enters the queue again", 1),
        ("ALWAYS", "granted without news", 2),
        ("NO_LOOK", "the shard compares at changes only, not when a request comes", 12),
        ("NO_FIRE", "a change does not look at what is parked", 12),
        ("ASKS_ONCE", "the client does not ask again", 12),
        ("FORGETS_NEWS", "what a lost update was for counts as seen", 12),
    ]
    goals = [
        (1, "a change lets a parked lock enter the queue"),
        (2, "a request comes with news already there"),
        (3, "a slice of waiting ends without news"),
        (4, "a lost grant is asked for again"),
        (5, "a commit is fenced"),
        (6, "a late copy of an ended lock is refused"),
    ]
    return [
        Variant(model, "1 actor, 3 changes, 2 losses", HOLDS),
        Variant(model, "the same, 4 changes, 3 losses", HOLDS, ("FIRES=4", "LOSSES=3")),
        *(Variant(model, text, BREAKS, (macro,), rule) for macro, text, rule in mutants),
        *(Variant(model, text, REACHES, (f"GOAL={goal}",), goal) for goal, text in goals),
    ]


def _takeover() -> list[Variant]:
    model = "takeover"
    database, locks = ("CLIENTS=0", "BEATS=2"), ("BATCHES=0", "BEATS=2", "LATE=0")
    twice = ("CLIENTS=0", "EPOCHS=3", "BEATS=1", "LATE=0")
    all_well = (*database, "FAULTS=2", "EPOCHS=4")
    mutants = [
        ("NO_FENCE", database, 11, "a batch is written although another daemon has the shard"),
        ("NO_NUMBER", database, 16, "the fence does not name the batch before"),
        ("BELIEVES_AT_ONCE", database, 4, "a batch that a new connection shows is confirmed"),
        ("SERVES_EARLY", database, 6, "a takeover serves before the copy has its epoch"),
        ("IGNORES_WARNINGS", database, 4, "a commit counts although the database warned"),
        ("FROM_THE_ANSWER", locks, 7, "a lease counts from when its confirmation came"),
        ("ANSWERS_UNCHECKED", locks, 7, "answers go out whether the lease holds or not"),
        ("CHECKS_FIRST", locks, 7, "the lease is checked when a question comes"),
        ("KEEPS_WHOLE_LEASE", locks, 7, "the holder counts without a margin for drift"),
        ("WAITS_NO_MARGIN", locks, 7, "the standby waits without a margin for drift"),
        ("COUNTS_ON", locks, 7, "a standby counts on after it had lost the database"),
        ("TAKES_BLINDLY", locks, 7, "a takeover does not name the row that was seen"),
        ("TAKES_ELSEWHERE", locks, 7, "a takeover goes to another primary than the looks"),
        ("GIVES_BACK_EARLY", locks, 7, "a daemon answers on after it gave its shard back"),
        ("NO_GRACE", locks, 7, "a daemon that has taken a shard over grants at once"),
        ("GIVES_UP", all_well, 12, "a standby that came too late looks no more"),
        ("NEVER_ASKS", all_well, 12, "a daemon does not ask what became of a batch"),
    ]
    goals = [
        (1, database, "a batch that stands is believed after a beat"),
        (2, database, "a batch that is missing is sent again"),
        (3, database, "a failover loses a batch"),
        (4, database, "a takeover comes too late"),
        (5, database, "a daemon finds that another has the shard"),
        (6, database, "a lease that was over is renewed in the same epoch"),
        (7, locks, "the grace ends early: both clients have come"),
        (8, locks, "the grace ends by time"),
        (9, locks, "a grant by one daemon while the other does not know yet"),
        (10, database, "a late batch of an epoch that is over is refused"),
        (11, database, "a shard that was given back is taken at once"),
    ]
    return [
        Variant(model, "2 daemons, 1 batch, 1 takeover", HOLDS, database),
        Variant(model, "the same, 2 takeovers, fewer renewals", HOLDS, twice),
        Variant(model, "2 clients, any number of locks, no batch", HOLDS, locks),
        Variant(model, "2 clients and 1 batch, fewer renewals", HOLDS, ("BEATS=1", "LATE=0")),
        Variant(model, "2 faults, then the shard is served", HOLDS, all_well),
        *_wrong_and_reached(model, mutants, goals),
    ]


VARIANTS = (
    *_commits(),
    *_grace(),
    *_cuts(),
    *_expected_views(),
    *_kept_grants(),
    *_kept_far(),
    *_kept_order(),
    *_standing_locks(),
    *_takeover(),
)
MODELS = tuple(dict.fromkeys(variant.model for variant in VARIANTS))


def verify(variant: Variant, folder: Path) -> Result:
    """Search all states of one variant, in a folder of its own.

    Raises:
        SpinError: Something failed, or the search was not exhaustive.
        FileNotFoundError: There is no spin, or no gcc.
    """
    defines = [f"-D{define}" for define in variant.defines]
    _, spin_s = _run(folder, "spin", *defines, "-a", str(HERE / f"{variant.model}.pml"))
    # A wrong edit is found soon: it is not worth the compiler's time.
    effort = "-O1" if variant.expects == HOLDS else "-O0"
    sizes = ("-DSAFETY", "-DNOCLAIM", "-DVECTORSZ=512")
    _, gcc_s = _run(folder, "gcc", effort, "-w", *sizes, "-o", "pan", "pan.c")
    said, search_s = _run(folder, "./pan", f"-m{DEPTH_MAX}", "-w22", f"-Q{MINUTES_MAX}")
    return _read(said, spin_s + gcc_s + search_s)


def _run(folder: Path, *command: str) -> tuple[str, float]:
    """Run a command; return what it said and its CPU time in seconds."""
    with (folder / "said").open("w+") as said:
        child = subprocess.Popen(command, cwd=folder, stdout=said, stderr=said)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        text = said.read()
    if child.returncode:
        raise SpinError(f"{command[0]} ended with {child.returncode}:\n{text}")
    return text, usage.ru_utime + usage.ru_stime


def _number(pattern: str, said: str) -> int:
    found = re.search(pattern, said)
    if found is None:
        raise SpinError(f"nothing like {pattern!r} in what the search said:\n{said}")
    return int(found[1])


def _read(said: str, seconds: float) -> Result:
    """Read what a search printed.  Only a broken rule may end it early."""
    states = _number(r"(\d+) states, stored", said)
    depth = _number(r"depth reached (\d+)", said)
    errors = _number(r"errors: (\d+)", said)
    broken = re.search(
        r"assertion violated \(rule!=\(?(?:(\d+)\+)?(\d+)\)?\) \(at depth (\d+)\)", said
    )
    if broken is not None:
        return Result(states, int(broken[3]), seconds, int(broken[1] or 0) + int(broken[2]))
    whole = "Search not completed" not in said and "max search depth too small" not in said
    if errors or not whole:
        raise SpinError(f"the search went wrong:\n{said}")
    lines = re.findall(r"\.pml:(\d+), state \d+, \"(.*)\"", said)
    dead = {int(line) for line, text in lines if text != "-end-" and "assert" not in text}
    return Result(states, depth, seconds, 0, frozenset(dead))
