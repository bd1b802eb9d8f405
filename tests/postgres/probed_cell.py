"""A replicated cell whose daemons serve probes."""

import os
import urllib.error
import urllib.request

from polling import until
from ports import free_port
from replicated_cell import SHARD, ReplicatedCell

from enact_dist.config.environment import variable_of

DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def value(page, name):
    """Return the value of a metric."""
    (line,) = [line for line in page.splitlines() if line.startswith(name + "{")]
    return float(line.rpartition(" ")[2])


class ProbedCell(ReplicatedCell):
    """A cell whose daemons serve probes."""

    def __init__(self, folder, url, name):
        super().__init__(folder, url, os.environ, name=name)
        self.ports = (free_port(), free_port())

    def start(self, place, **options):
        self._environment[variable_of(SHARD, "METRICS")] = str(self.ports[place])
        return super().start(place, **options)

    def ask(self, place, path):
        """Return status and text of a probe."""
        try:
            where = f"http://127.0.0.1:{self.ports[place]}{path}"
            with DIRECT.open(where, timeout=30) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    def shows(self, place, name, condition):
        """Wait until a metric has a value."""

        def found():
            return value(self.ask(place, "/metrics")[1], name)

        until(lambda: condition(found()), missed=lambda: (name, found()))

    def becomes(self, place, path, status):
        """Wait until a probe answers with a status."""
        until(lambda: self.ask(place, path)[0] == status, missed=lambda: self.ask(place, path))
