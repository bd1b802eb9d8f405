"""The guide to a cell of one's own, done as it stands: files, commands, and what these say."""

import json
import re
from pathlib import Path

import pytest
from guides import Reader, Step, missing, steps
from ports import free_port

PAGE = (Path(__file__).parents[2] / "enact_dist" / "docs" / "own_cell.md").read_text("utf-8")

TEST = "test_a_part_is_found_where_both_cameras_see_it"


@pytest.mark.slow
@pytest.mark.carrier("auto")
def test_the_guide_does_what_it_says(tmp_path):
    """And each motion was made once, through the ends of a shard and of an actor."""
    ports = {port: str(free_port()) for port in ("7501", "7502", "7600")}
    with Reader(tmp_path, ports) as reader:
        for step in steps(PAGE):
            reader.does(step)
        reader.does(Step(command=f"python -c 'import test_handling; test_handling.{TEST}()'"))
        tree = reader.does(Step(command="enact why online robot/result --depth 4 --json"))
    motions = re.findall(
        r"^simulated robot: (\w+) at (.*)$", (tmp_path / "devices.txt").read_text(), re.MULTILINE
    )

    assert len(motions) >= 5
    assert len(set(motions)) == len(motions)
    assert {outcome for outcome, _ in motions} == {"picked"}
    assert len(captured := images_of(json.loads(tree))) == 2
    assert len(set(captured.values())) == 1


def images_of(version):
    """Return the capture stamps of the images that a version was made of, by camera."""
    found = {}
    if version["aspect"] == "image":
        found[version["entity"]] = version["captured_ns"]
    for cause in version.get("children", ()):
        found |= images_of(cause)
    return found


def test_a_page_is_its_files_and_commands():
    """In the order of the page; code that names no file is for reading."""
    page = "```python a.py\nA = 1\n```\ntext\n```python\nno()\n```\n```console\n$ one\n1 s\n$ two &\n```\n"

    assert steps(page) == [
        Step(file="a.py", text="A = 1\n"),
        Step(command="one", says=("1 s",)),
        Step(command="two &"),
    ]


@pytest.mark.parametrize(
    ("says", "output", "lacks"),
    [
        (("a 1 s", "b"), "x\na  27 ms\ny b\n", None),
        (("b", "a"), "a\nb\n", "a"),
        (("v… done",), "v12  done", None),
        (("picked",), "missed\n", "picked"),
    ],
)
def test_what_a_command_has_to_say(says, output, lacks):
    """Its lines in their order, whatever their numbers and gaps."""
    assert missing(says, output) == lacks
