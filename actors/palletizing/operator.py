"""The operator: answers what the cell asks, at a terminal or by a script."""

from __future__ import annotations

import queue
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from actors.palletizing.control.controller import open_controller
from actors.palletizing.vocabulary import (
    DECISION,
    PACKAGES,
    QUESTION,
    REQUEST,
    SIGHTING,
    SYSTEM,
    USER,
    Decision,
)
from enact_dist import Actor, Entity, View, ViewEach, World, Write

if TYPE_CHECKING:
    from collections.abc import Sequence

    from actors.palletizing.vocabulary import Question
    from enact_dist import Lock


SCRIPT: Final = "script"
"""Who has decided, where no person has."""
LOOKS: Final = 6
"""A script lets the cell look so often for one place, those by itself included: whatever hides the
package needs a person."""


class Hands(Protocol):
    """A person's hands, where a simulated cell has none."""

    def remove(self, number: int) -> None:
        """Take a package out of the cell."""
        ...


class Operator(Actor):
    """Ask the questions of the cell, and write each answer as a decision, so that `why` shows it.

    Args:
        answers: Words in the order of preference, such as "reject removed", or a file with them:
            of a question's choices the first of these is taken, or else the first choice.  In
            place of another look it stops when the cell has looked `LOOKS` times for a place.
            Empty: a person is asked at the terminal of this process.
        hands: Address of what removes a package for the answer "removed", see `Hands`; empty: the
            person does so before answering.
    """

    online = World("online")
    question = View(online, USER, QUESTION)
    request = View(online, SYSTEM, REQUEST)
    sightings = ViewEach(online, PACKAGES, SIGHTING)
    decision = Write(online, SYSTEM, DECISION)
    every_s = 0.2

    def __init__(self, answers: str = "", hands: str = "") -> None:
        path = Path(answers) if answers else None
        self.answers = path.read_text().split() if path and path.is_file() else answers.split()
        self.hands: Hands | None = open_controller(hands) if hands else None
        self._terminal, self._asked = Terminal(), -1
        self._answer: Decision | None = None

    def update(self, lock: Lock) -> None:
        """Answer the newest question, if it has no answer."""
        question, before = lock.get(self.question), lock.get(self.decision)
        if question is None or (before is not None and before.request >= question.request):
            return
        if self.answers and before is not None and before.choice == "stop":
            return  # what a script has stopped goes on when a person says so
        if question.request != self._asked:
            self._terminal.ask(question)
            self._asked, self._answer = question.request, None
        if self._answer is None:
            self._answer = self._decided(question, lock)
        if self._answer is not None:
            lock[self.decision] = self._answer

    def _decided(self, question: Question, lock: Lock) -> Decision | None:
        """Return the answer, None if there is none yet; what it wants done by hand is done."""
        if self.answers:
            looks = lock[self.request].tried.count("look")
            by, (choice, why) = SCRIPT, scripted(question, self.answers, looks)
        else:
            by, choice, why = "terminal", self._terminal.typed(question), ""
        if not choice:
            return None
        if choice == "removed" and self.hands is not None:
            package = lock[self.request].package
            seen = lock[self.sightings].get(Entity(package)) if package else None
            if seen is not None:
                self.hands.remove(seen.first_stop)
        print(f"  {choice}{why}", flush=True)
        return Decision(question.request, choice, by)


class Terminal:
    """Where a person reads questions and types answers."""

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[str] | None = None

    def ask(self, question: Question) -> None:
        """Print a question; what was typed before is no answer to it."""
        print(f"{question.text}\n  {' | '.join(question.choices)}", flush=True)
        while self._lines is not None and not self._lines.empty():
            self._lines.get_nowait()

    def typed(self, question: Question) -> str:
        """Return what was typed, if it is a choice; never wait for it, since a lock would."""
        if self._lines is None:
            self._lines = queue.SimpleQueue()
            threading.Thread(target=_read, args=(self._lines,), daemon=True).start()
        try:
            word = self._lines.get_nowait().strip()
        except queue.Empty:
            return ""
        if word in question.choices:
            return word
        print(f"  {word!r} is none of {', '.join(question.choices)}", flush=True)
        return ""


def scripted(question: Question, answers: Sequence[str], looks: int) -> tuple[str, str]:
    """Return the answer of a script, and why, if it is none of its own.

    Args:
        question: What is asked.
        answers: Words in the order of preference.
        looks: How often the cell has looked for the place.
    """
    wanted = (word for word in answers if word in question.choices)
    choice = next(wanted, question.choices[0])
    if choice == "look" and looks >= LOOKS and "stop" in question.choices:
        return "stop", f": after {looks} looks the script looks no more"
    return choice, ""


def _read(lines: queue.SimpleQueue[str]) -> None:
    for line in sys.stdin:
        lines.put(line)
