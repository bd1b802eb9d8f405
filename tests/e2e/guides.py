"""Pages whose files and commands are run as they stand, in their order.

A block of code whose first line names a file (```python devices.py) is that file.  A block of the
language `console` is a terminal: what follows `$ ` is run by bash in the folder of the files, the
other lines have to stand in its output in this order, whatever their numbers are; `…` stands for
anything.  A command that ends with `&` goes on until the end of the page.  A block behind a comment
`<!-- not run: … -->` is left out.
"""

import os
import re
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

PATIENCE_S = 120.0
_BLOCK = re.compile(r"^```(\w+)(?: (\S+))?\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_NOT_RUN = re.compile(r"^<!-- not run: .*? -->\n```.*?^```$", re.DOTALL | re.MULTILINE)
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?: (?:ms|s|B|kB|MB)\b)?")


@dataclass
class Step:
    """A file to write, or a command to run with what it has to say."""

    file: str = ""
    text: str = ""
    command: str = ""
    says: tuple[str, ...] = ()


def steps(page):
    """Return what a page tells its reader to do, in order."""
    found = []
    for kind, name, text in _BLOCK.findall(_NOT_RUN.sub("", page)):
        if name:
            found.append(Step(file=name, text=text))
        for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:] if kind == "console" else ():
            command, *says = part.splitlines()
            found.append(Step(command=command, says=tuple(line for line in says if line)))
    return found


def missing(says, output):
    """Return the first line that does not stand in an output after those before it, or None."""
    lines = iter(output.splitlines())
    for wanted in says:
        pattern = re.compile(_pattern(wanted))
        if not any(pattern.search(line) for line in lines):
            return wanted
    return None


def _pattern(line):
    parts = re.split(f"({_NUMBER.pattern}|…|\\s+)", line.rstrip())
    return "".join(map(_part, parts))


def _part(text):
    if text == "…":
        return ".*"
    if text.isspace():
        return r"\s+"
    return r"[\d.]+(?: (?:ms|s|B|kB|MB)\b)?" if _NUMBER.fullmatch(text) else re.escape(text)


class Reader:
    """Does what a page says, in a folder; a context manager that ends what still runs.

    Args:
        folder: Where its files are written and its commands run.
        replaced: Texts of the page that are others here, such as ports.
    """

    def __init__(self, folder: Path, replaced: dict[str, str]) -> None:
        self.folder, self.replaced = folder, replaced
        self.running: list[subprocess.Popen] = []
        programs = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        self.environment = os.environ | {"PATH": programs, "PYTHONUNBUFFERED": "1"}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in reversed(self.running):
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            process.wait(PATIENCE_S)

    def does(self, step):
        """Write a file, or run a command; return what it said."""
        if step.file:
            (self.folder / step.file).write_text(self._here(step.text), "utf-8")
            return ""
        command = self._here(step.command)
        if command.endswith("&"):
            self.running.append(self._begin(f"exec {command.rstrip('& ')}"))
            return ""
        process = self._begin(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        try:
            output, _ = process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            output, _ = process.communicate()
        wanted = missing(map(self._here, step.says), output)
        assert wanted is None, f"$ {command}\n{output}\nlacks, in this order: {wanted}"
        return output

    def _begin(self, command, **options):
        return subprocess.Popen(
            ["bash", "-c", command], cwd=self.folder, env=self.environment, **options
        )

    def _here(self, text):
        for before, after in self.replaced.items():
            text = text.replace(before, after)
        return text
