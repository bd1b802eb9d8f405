"""Pictures of nets: every state and exit is in them, coloured by outcome, with the run."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import pytest

from actors.palletizing.handling.grounding import SKELETONS
from actors.palletizing.handling.net_picture import WIDTH, svg_of_net

from .sound_nets import net, primitive, way
from .spring_arm import SpringArm, run
from .test_grounding import FRAMES, grounded

NOTE_PX = 6.3
"""Width of a letter of a note, in the middle."""
SVG = "{http://www.w3.org/2000/svg}"


def states(svg):
    """Return the drawn boxes by the state they stand for."""
    return {box.get("data-name"): box for box in ET.fromstring(svg).iter(f"{SVG}rect")
            if box.get("data-name")}  # fmt: skip


def ways(svg):
    """Return the drawn lines as (from, to, class)."""
    lines = [p for p in ET.fromstring(svg).iter(f"{SVG}path") if p.get("data-to")]
    return {(line.get("data-from"), line.get("data-to")): line.get("class") for line in lines}


@pytest.mark.parametrize("skeleton", SKELETONS)
def test_every_state_and_every_exit_is_drawn_once(skeleton):
    """Boxes do not overlap; colours tell what can succeed, what only fails, and the ends."""
    drawn = grounded(skeleton)
    svg = svg_of_net(drawn)

    boxes = states(svg)
    assert boxes.keys() == drawn.primitives.keys() | drawn.ends.keys()
    spots = {(box.get("x"), box.get("y")) for box in boxes.values()}
    assert len(spots) == len(boxes)
    wanted = {(name, e.to) for name, p in drawn.primitives.items() for e in p.exits}
    assert ways(svg).keys() == wanted
    for name, success in drawn.ends.items():
        assert boxes[name].get("class") == ("success" if success else "failure")
    for name in drawn.primitives:
        hopeful = any(drawn.outcome(end) for end in drawn.reachable(name))
        assert boxes[name].get("class") == ("goes on" if hopeful else "can only fail")
    texts = {text.text for text in ET.fromstring(svg).iter(f"{SVG}text")}
    assert {str(e) for p in drawn.primitives.values() for e in p.exits} <= texts


@pytest.mark.parametrize("skeleton", SKELETONS)
def test_what_a_primitive_does_fits_into_its_box(skeleton):
    """Names of entities are as long as those of a running cell; boxes name the parameter."""
    drawn = grounded(skeleton)
    frames = {
        name: replace(p.frame, entity=f"{p.frame.entity}-5449387aad6b60a4")
        for name, p in drawn.primitives.items()
    }
    long = replace(
        drawn,
        primitives={name: replace(p, frame=frames[name]) for name, p in drawn.primitives.items()},
        grounded={name: f"{entity}-5449387aad6b60a4" for name, entity in drawn.grounded.items()},
    )
    notes = [t.text for t in ET.fromstring(svg_of_net(long)).iter(f"{SVG}text")
             if t.get("class") == "note"]  # fmt: skip
    assert max(map(len, notes)) * NOTE_PX < WIDTH - 10.0


def test_a_run_is_the_thick_line():
    """The exits that were taken, how long each primitive took, and the end it came to."""
    pushed = run(grounded("push_into_contact"), SpringArm(), FRAMES.__getitem__).execution()
    svg = svg_of_net(grounded("push_into_contact"), pushed)

    assert {line for line, kind in ways(svg).items() if kind == "run"} == {
        (step.primitive, step.to) for step in pushed.trace
    }
    thick = {name for name, box in states(svg).items() if box.get("stroke-width") == "3.0"}
    assert thick == {step.primitive for step in pushed.trace} | {"no_neighbour"}
    assert "push_into_contact (package/17, place/3): no_neighbour" in svg
    assert f"push  {pushed.trace[3].elapsed_s:.2f} s" in svg


def test_a_run_that_ended_by_time_shows_where():
    """The primitive that took too long is marked with the result."""
    waiting = net({"trial": primitive(
        way("done", "width < 0.01"), way("failed", "force > 50"), limit_s=0.2)})  # fmt: skip
    svg = svg_of_net(waiting, run(waiting, SpringArm()).execution())

    assert states(svg)["trial"].get("fill") == "#ffb347"
    assert "timeout:trial" in svg


def test_names_and_conditions_are_escaped():
    """What stands in a net is text in the picture, whatever it holds."""
    strange = net({"a": primitive(way("done", "error < 1"), way("failed", "error > 1"),
                                  frame='<b>&"')})  # fmt: skip
    texts = {text.text for text in ET.fromstring(svg_of_net(strange)).iter(f"{SVG}text")}

    assert '<b>&", 3 s at most' in texts
