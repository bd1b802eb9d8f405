"""Runs of many seeds in several processes."""

import os

from enact_dist.verify.simulation.series import run_series

CTRL_C = """\
import os, signal, sys
if "spawn_main" in " ".join(sys.orig_argv):
    os.kill(os.getpid(), signal.SIGINT)
"""


def test_ctrl_c_is_for_the_process_that_counts_and_not_for_its_workers(tmp_path, monkeypatch):
    """A terminal sends it to all of them; one that was just starting showed a traceback."""
    (tmp_path / "sitecustomize.py").write_text(CTRL_C, encoding="utf-8")
    paths = [str(tmp_path), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))

    totals = run_series(1, count=2, jobs=2)

    assert (totals.seeds, totals.interrupted) == (2, False)
