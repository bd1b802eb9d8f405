"""The pages of `enact_dist/docs` are true: their programs run, their links lead somewhere."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from enact_dist.config.environment import variable_of, variables_of
from enact_dist.config.read import load_config
from enact_dist.config.table import keys_of
from enact_dist.config.types import (
    ActorConfig,
    AspectConfig,
    CellConfig,
    PinTable,
    RetentionTable,
    ShardConfig,
)

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "enact_dist" / "docs").glob("*.md"))


def programs():
    """Return the Python blocks that are whole programs: they begin with their imports."""
    for page in PAGES:
        blocks = re.findall(
            r"^```python\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE
        )
        for number, code in enumerate(blocks, 1):
            if re.match(r"(from|import) ", code):
                yield pytest.param(code, id=f"{page.name}-{number}")


@pytest.mark.parametrize("code", list(programs()))
def test_program_of_a_page_runs_as_pasted(code):
    """What it prints stands beside it."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120
    )
    told = re.findall(r"^ *print\(.*#\s(.*)$", code, re.MULTILINE)
    assert (done.returncode, done.stdout.splitlines()) == (0, told), done.stderr


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda page: page.name)
def test_links_of_a_page_lead_to_files_and_headings(page):
    """Links to other sites are not followed."""
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        assert file.exists(), target
        if anchor:
            heads = re.findall(r"^#+ (.*)$", file.read_text("utf-8"), re.MULTILINE)
            names = {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}
            assert anchor in names, target


def test_readme_is_short():
    """One reads it whole; what serves one purpose only has its own page."""
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 200


def test_readme_leads_to_each_page():
    """No reader finds a page that nothing leads to."""
    readme = (ROOT / "README.md").read_text("utf-8")
    assert [page.name for page in PAGES if f"enact_dist/docs/{page.name}" not in readme] == []


def test_page_of_cell_toml_has_every_key_and_no_other():
    """Its tables name what the reader accepts, table by table and in any order."""
    page = (ROOT / "enact_dist" / "docs" / "cell.md").read_text("utf-8")
    tables = re.findall(r"^\| key .*\n\|---.*\n((?:\|.*\n)+)", page, re.MULTILINE)
    explained = [set(re.findall(r"^\| `(\w+)` \|", rows, re.MULTILINE)) for rows in tables]
    kinds = (CellConfig, ShardConfig, PinTable, AspectConfig, RetentionTable, ActorConfig)
    accepted = [set(keys_of(kind)) for kind in kinds]
    lists = {"shards", "pins", "aspects", "actors"}  # headings of the page
    assert sorted(map(sorted, explained)) == sorted(sorted(keys - lists) for keys in accepted)

    variables = set(re.findall(r"^\| `(ENACT_\w+)` \|", page, re.MULTILINE))
    of_shards = {variable_of("name", key) for key in variables_of(ShardConfig)}
    of_cell = {f"ENACT_{key}" for key in variables_of(CellConfig)}
    assert variables == of_cell | of_shards


def test_example_of_cell_toml_is_read(tmp_path):
    """What the page shows is a cell."""
    page = (ROOT / "enact_dist" / "docs" / "cell.md").read_text("utf-8")
    [text] = re.findall(r"^```toml\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    (tmp_path / "cell.toml").write_text(text, "utf-8")
    config = load_config(tmp_path / "cell.toml", environment={})
    assert [shard.name for shard in config.shards] == ["vision", "robot"]
    assert [actor.name for actor in config.actors] == ["camera", "detector"]
