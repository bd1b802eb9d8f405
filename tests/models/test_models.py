"""The models of the core hold, their wrong edits do not, and nothing in them is idle."""

from __future__ import annotations

import ast
import os
import re
from pathlib import Path

import pytest
from spin_models import BREAKS, HERE, HOLDS, MODELS, REACHES, VARIANTS, SpinError, _read, verify

CORE = Path(__file__).parents[2] / "enact_dist" / "core"
MIRRORED = re.compile(r"([\w/]+\.py):(\w+(?:, \w+(?![\w./]))*)")
LAST_LINES = "State-vector 8 byte, depth reached 9, errors: 1\n 7 states, stored\n"


def checked(variant, folder):
    """Run a variant; without spin the test is skipped, in CI it fails."""
    try:
        return verify(variant, folder)
    except FileNotFoundError as error:
        if os.environ.get("CI") == "true":
            raise
        pytest.skip(str(error))


@pytest.mark.slow
@pytest.mark.sampled(4)
@pytest.mark.parametrize("model", MODELS)
def test_model_holds_and_takes_every_step(model, tmp_path):
    """No rule breaks in any state; and no line is dead, each is executed in some state."""
    dead = []
    for number, variant in enumerate(VARIANTS):
        if (variant.model, variant.expects) == (model, HOLDS):
            (tmp_path / str(number)).mkdir()
            result = checked(variant, tmp_path / str(number))
            assert result.as_expected(variant), result.verdict(variant)
            dead.append(result.unreached)

    assert frozenset.intersection(*dead) == set()


@pytest.mark.slow
@pytest.mark.sampled(25)
@pytest.mark.parametrize(
    "variant", [v for v in VARIANTS if v.expects != HOLDS], ids=lambda variant: variant.name
)
def test_wrong_edit_breaks_its_rule_and_places_are_reached(variant, tmp_path):
    """What holds does not hold because nothing could break it, or because nothing happens."""
    result = checked(variant, tmp_path)

    assert result.as_expected(variant), result.verdict(variant)


@pytest.mark.parametrize("model", MODELS)
def test_model_has_wrong_edits_and_places_to_reach(model):
    """A model that nothing could break says nothing: three wrong edits at least, three places."""
    kinds = [variant.expects for variant in VARIANTS if variant.model == model]

    assert kinds.count(BREAKS) >= 3
    assert kinds.count(REACHES) >= 3


@pytest.mark.parametrize("model", MODELS)
def test_macros_of_a_variant_are_in_its_model(model):
    """A wrong edit whose name is misspelled would be the model as it is."""
    text = (HERE / f"{model}.pml").read_text("utf-8")
    macros = {m.split("=")[0] for v in VARIANTS if v.model == model for m in v.defines}
    tested = set(re.findall(r"#ifn?def (\w+)", text)) | set(re.findall(r"defined\((\w+)\)", text))

    assert macros <= tested


@pytest.mark.parametrize("model", MODELS)
def test_what_a_model_mirrors_is_there(model):
    """Each function of the core that a model names still exists."""
    head = (HERE / f"{model}.pml").read_text("utf-8").split("*/")[0]
    mirrored = [
        (file, name) for file, names in MIRRORED.findall(head) for name in names.split(", ")
    ]
    missing = []
    for file, name in mirrored:
        nodes = ast.walk(ast.parse((CORE / file).read_text("utf-8")))
        if name not in {node.name for node in nodes if isinstance(node, ast.FunctionDef)}:
            missing.append(f"{file}:{name}")

    assert len(mirrored) >= 8
    assert missing == []


@pytest.mark.parametrize(
    "said",
    [
        LAST_LINES + "pan:1: invalid end state (at depth 3)",
        LAST_LINES.replace("errors: 1", "errors: 0") + "error: max search depth too small",
        LAST_LINES.replace("errors: 1", "errors: 0") + "Warning: Search not completed",
        "",
    ],
)
def test_search_that_is_not_whole_proves_nothing(said):
    """Whatever ends a search early, a broken rule excepted, is an error of its own."""
    with pytest.raises(SpinError):
        _read(said, 0.0)


def test_broken_rule_is_read():
    """The first broken rule ends a search; places to reach are numbered above the rules."""
    rule = _read(LAST_LINES + "pan:1: assertion violated (rule!=9) (at depth 21)", 0.0)
    place = _read(LAST_LINES + "pan:1: assertion violated (rule!=(100+4)) (at depth 5)", 0.0)

    assert (rule.rule, rule.depth, rule.states) == (9, 21, 7)
    assert place.rule == 104
