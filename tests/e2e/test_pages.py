"""Pages with a terminal, followed as they stand; the tutorial has its own test beside this one."""

import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest
from guides import Reader, steps
from ports import free_port

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "enact_dist" / "docs"
PORT = re.compile(r"127\.0\.0\.1:(\d+)")


def follow(page, folder, **replaced):
    """Do what a page says in a folder, at ports of its own."""
    text = page.read_text("utf-8")
    ports = {port: str(free_port()) for port in sorted(set(PORT.findall(text)))}
    with Reader(folder, {**ports, **replaced}) as reader:
        for step in steps(text):
            reader.does(step)


@pytest.mark.kept_grants
@pytest.mark.carrier("auto")
@pytest.mark.parametrize("name", ["protocol", "cell", "kept_grants"])
def test_a_page_does_what_it_says(name, tmp_path):
    """The client without the library commits; the misspelt cell is refused; a grant stays."""
    follow(DOCS / f"{name}.md", tmp_path)


@pytest.mark.slow
@pytest.mark.carrier("auto")
@pytest.mark.parametrize("page", ["enact_dist/docs/operations.md", "deploy/drills.md"])
def test_a_long_page_does_what_it_says(page, tmp_path):
    """Shards are added, backed up and restored; processes are killed and frozen."""
    follow(ROOT / page, tmp_path)


@pytest.mark.slow
@pytest.mark.carrier("zenoh")
def test_a_cell_is_secured_as_its_page_says(tmp_path):
    """It gets keys and rights, and what must fail does."""
    pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")
    if shutil.which("openssl") is None:
        pytest.skip("openssl: command not found (Debian package openssl)")
    follow(DOCS / "securing.md", tmp_path)


@pytest.mark.slow
@pytest.mark.carrier("auto")
def test_the_project_of_ones_own_runs(tmp_path):
    """From a copy of its folder, as its page says."""
    shutil.copytree(ROOT / "deploy" / "own", tmp_path, dirs_exist_ok=True)
    cell = tmp_path / "cell.toml"
    cell.write_text(cell.read_text("utf-8").replace("7490", str(free_port())), "utf-8")
    follow(DOCS / "own_actors.md", tmp_path)


@pytest.mark.slow
@pytest.mark.carrier("auto")
def test_a_cell_survives_as_its_page_says(tmp_path, monkeypatch):
    """Daemons are killed, ended and frozen, and the database's primary is lost."""
    pytest.importorskip("psycopg", reason="a store needs the extra 'postgres'")
    if not list(Path("/usr/lib/postgresql").glob("*/bin/initdb")):
        pytest.skip("initdb: not found (Debian package postgresql)")
    programs = ROOT / "deploy" / "survive"
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    ports = {"PORT1": str(free_port()), "PORT2": str(free_port())}
    for name, port in ports.items():
        monkeypatch.setenv(name, port)
    nodes = Path(tempfile.mkdtemp())
    nodes.chmod(0o755)  # root runs PostgreSQL as another user
    try:
        here = {"54321": ports["PORT1"], "54322": ports["PORT2"]}
        follow(DOCS / "surviving.md", tmp_path, **here, **{"/var/tmp/cell-db": f"{nodes}/db"})
    finally:
        subprocess.run([programs / "two_nodes", "stop", nodes / "db"], check=False)
        shutil.rmtree(nodes)
