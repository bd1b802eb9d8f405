"""A compose project of the palletizing cell, as the tests run it."""

import json
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "actors" / "palletizing"))

import list_cell
import polling

PACKAGES = 4
WAIT_S = 180.0
"""How long an event may take on a busy machine; most take a second."""


class Stack:
    """One compose project; a context manager that removes all of it in the end.

    Args:
        engine: A container engine with the images.
        project: Name of the project.
        folder: For its settings, and for what it writes.
        options: Compose files and profiles.
        settings: Variables of the compose files.
    """

    def __init__(self, engine, project, folder, *options, **settings):
        self.engine, self.project = engine, project
        self.out = folder / f"{project}-out"
        settings |= {"ENACT_CELL_FILE": cell_file(folder), "ENACT_OUT": self.out}
        variables = folder / f"{project}.env"
        variables.write_text("".join(f"{name}={value}\n" for name, value in settings.items()))
        self._options = ("--project-name", project, "--env-file", variables, *options)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.compose("down", "--volumes", "--remove-orphans", "--timeout", 5)

    def compose(self, *words, check=True):
        """Run `docker compose` for this project."""
        return self.engine.compose(*self._options, *words, check=check)

    def name(self, service):
        """Return the name of a service's container."""
        return f"{self.project}-{service}-1"

    def docker(self, verb, service, *words, check=True):
        """Run `docker VERB CONTAINER WORDS`; return what it wrote."""
        done = self.engine.docker(verb, self.name(service), *words, check=check)
        return done.stdout + done.stderr

    def enact(self, *words, inside="feedback", check=True):
        """Run `enact` beside a service; return what it wrote."""
        return self.docker("exec", inside, "enact", *words, check=check)

    def json(self, *words, inside="feedback"):
        """Return what a reader of the command line says as JSON."""
        name = self.name(inside)
        return json.loads(self.engine.docker("exec", name, "enact", *words, "--json").stdout)

    def python(self, service, text):
        """Run Python beside a service; return what it wrote."""
        return self.docker("exec", service, "python", "-c", text).strip()

    def state(self, service):
        """Return how the engine finds a container: its restarts, health, status, exit code."""
        found = json.loads(self.engine.docker("inspect", self.name(service)).stdout)[0]
        return {**found["State"], "RestartCount": found["RestartCount"]}

    def kill_process(self, service):
        """Kill what runs in a container; by `docker kill` it would count as stopped on purpose."""
        self.docker("exec", service, "sh", "-c", "kill -KILL -1", check=False)

    def pause(self, service):
        """Freeze a container; the engine fails to while a process in it waits for a disk."""

        def frozen():
            return self.docker("pause", service, check=False) == f"{self.name(service)}\n"

        until(frozen, lambda: self.docker("pause", service, check=False))

    def log_until(self, service, text, *, times=1):
        """Return the log of a container once `text` stands in it so many times."""

        def found():
            log = self.docker("logs", service)
            return log if log.count(text) >= times else ""

        return until(found, lambda: f"{text!r} in the log:\n{self.docker('logs', service)[-3000:]}")

    def ended(self, service):
        """Wait for a container to end; return its exit code."""
        return int(self.docker("wait", service).split()[-1])


def until(found, missed):
    """Return what `found` returns as soon as that is something: an engine takes its time."""
    return polling.until(found, limit_s=WAIT_S, pause_s=0.1, missed=missed)


def cell_file(folder):
    """Write the shipped cell with few packages."""
    file = folder / "cell.toml"
    file.write_text(list_cell.shipped(PACKAGES))
    return file


def judged(out):
    """Return what was found at each place."""
    packages = json.loads((out / "report.json").read_text("utf-8"))["packages"]
    return [{**package, "frame_to_feedback_ms": 0.0} for package in packages]
