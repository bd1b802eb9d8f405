"""The pages of `enact_dist/docs` are true: their programs run, their links lead somewhere."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

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
