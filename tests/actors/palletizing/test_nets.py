"""Primitive nets as data: what the check refuses, that they travel, and their text."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings

from actors.palletizing.handling.net_files import net_of_text, read_net, text_of_net, write_net
from actors.palletizing.handling.nets import Axis, Execution, Net, NetError, TaskFrame, TraceStep
from enact_dist import Aspect, Entity, Lock, Read, Write
from enact_dist.world.connecting import local

from .sound_nets import as_plain, axes, net, primitive, sound_nets, way

DONE, FAILED = way("done", "error < 0.001"), way("failed", "force > 20")
SKEWED = np.diag([1.0, 2.0, 1.0, 1.0])


def one(**changes):
    """Return the primitives of a net of one."""
    return {"touch": primitive(DONE, FAILED, **changes)}


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (
            lambda: net({"a": primitive(DONE, FAILED, way("lifd", "error < 1"))}),
            "primitive a: exit 3 leads to 'lifd', which is neither a primitive nor an end; known:",
        ),
        (
            lambda: net({**one(), "lift": primitive(DONE)}),
            "net trial: primitive lift: no exit leads to it from touch",
        ),
        (
            lambda: net({"a": primitive(DONE, FAILED, way("b", "width < 0.1")),
                         "b": primitive(way("b", "width > 0.1"))}),
            "net trial: primitive b: no end can be reached from it",
        ),
        (lambda: net({"a": primitive()}), "net trial: primitive a: it has no exit"),
        (lambda: net({"a": primitive(way("done"))}), "primitive a: exit 1 to done has no condition"),
        (
            lambda: net({"a": primitive(DONE)}),
            "net trial: end failed: no exit leads to it from a",
        ),
        (
            lambda: net({"a": primitive(DONE)}, ends={"done": True}),
            "net trial: it has no failure among its ends done",
        ),
        (
            lambda: net({"a": primitive(FAILED)}, ends={"failed": False}),
            "net trial: it has no success among its ends failed",
        ),
        (
            lambda: Net("trial", "b", one(), {"done": True, "failed": False}),
            "net trial: it starts with 'b', which is no primitive; known: touch, done, failed",
        ),
        (
            lambda: net({"a b": primitive(DONE, FAILED)}),
            "net trial: 'a b' is no name; use letters, digits, _ and -",
        ),
        (
            lambda: net({"done": primitive(DONE, FAILED)}),
            "net trial: done is both a primitive and an end; rename one",
        ),
        (
            lambda: net(one(limit_s=0.0)),
            "primitive touch: limit_s is 0.0; every primitive needs a time limit over 0 s",
        ),
        (
            lambda: net(one(limit_s=math.inf)),
            "primitive touch: limit_s is inf s; 0 to 600 s is allowed",
        ),
        (
            lambda: net(one(speed_m_s=2.0)),
            "primitive touch: speed_m_s is 2 m/s; 0 to 1.5 m/s is allowed",
        ),
        (
            lambda: net(one(axes=axes(z=("force", 150.0)))),
            "net trial: primitive touch: axis z is 150 N; -100 to 100 N is allowed",
        ),
        (
            lambda: net(one(axes=axes(z=("torque", 1.0)))),
            "primitive touch: axis z: unknown mode 'torque'; known: position, velocity, force",
        ),
        (
            lambda: net(one(axes=(Axis("position", 0.0),))),
            "primitive touch: it has 1 axes; a primitive has 6: x, y, z, rx, ry, rz",
        ),
        (
            lambda: net(one(axes=axes(rx=("position", math.nan)))),
            "primitive touch: axis rx is nan rad; -3.14159 to 3.14159 rad is allowed",
        ),
        (
            lambda: net(one(tool="width", tool_value=0.3)),
            "primitive touch: tool width is 0.3 m; 0 to 0.2 m is allowed",
        ),
        (
            lambda: net(one(tool="grab")),
            "primitive touch: unknown tool command 'grab'; known: keep, width, force",
        ),
        (
            lambda: net({"a": primitive(DONE, way("failed", "force_q > 6"))}),
            "primitive a: exit 2 to failed: unknown quantity 'force_q'; known: distance, error,",
        ),
        (
            lambda: net({"a": primitive(DONE, way("failed", "force_z >= 6"))}),
            "primitive a: exit 2 to failed: force_z: unknown relation '>='; known: > <",
        ),
        (
            lambda: net({"a": primitive(DONE, way("failed", "width > 0.3"))}),
            "primitive a: exit 2 to failed: width is 0.3 m; 0 to 0.2 m is allowed",
        ),
        (
            lambda: net({"a": primitive(DONE, way("failed", "elapsed_s > 4"))}),
            "exit 2 to failed: elapsed_s > 4 s is never met: the time limit is 3 s",
        ),
        (
            lambda: net({"a": dataclasses.replace(one()["touch"], frame=TaskFrame("tray", SKEWED))}),
            "net trial: primitive a: the offset of its frame is no rigid transform",
        ),
    ],
)  # fmt: skip
def test_a_faulty_net_is_refused_in_one_line(made, message):
    """A net that cannot be run is not made; the line names net, primitive, what was found."""
    with pytest.raises(NetError) as refused:
        made()

    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@given(sound_nets())
@settings(max_examples=60, deadline=None)
def test_the_text_of_a_net_gives_it_back(random):
    """Each number of a net comes back from its text exactly."""
    text = text_of_net(random)

    again = net_of_text(text)

    assert as_plain(again) == as_plain(random)
    assert text_of_net(again) == text


def test_a_net_travels_as_a_datum():
    """A net and an execution come out of a world context as they went in."""
    sent = net(one(axes=axes(z=("velocity", -0.05)), tool="width", tool_value=0.1))
    ran = Execution(
        "trial", 3, "touch", 17, (TraceStep("touch", "done", 0.5, "error < 0.001 m"),), "done",
        np.zeros(6), 0.1, np.eye(4),
    )  # fmt: skip
    with local(worlds=["online"]) as cell:
        online, system = cell.world("online"), Entity("system")
        nets, runs = Aspect("net", Net), Aspect("execution", Execution)
        wanted = Write(online, system, nets), Write(online, system, runs)
        with Lock(*wanted, wait_s=5.0) as lock:
            lock[wanted[0]], lock[wanted[1]] = sent, ran
        reads = Read(online, system, nets), Read(online, system, runs)
        with Lock(*reads, wait_s=5.0) as lock:
            received, after = lock[reads[0]], lock[reads[1]]

    assert as_plain(received) == as_plain(sent)
    assert as_plain(after) == as_plain(ran)


TEXT = """
name = "place"
start = "touch"
[ends]
placed = true
no_floor = false
[primitives.touch]
frame = { entity = "place/3", at_m = [0.0, 0.0, 0.04], turn_deg = [0, 0, 90] }
axes = { z = "-0.05 m/s", rx = "180 deg" }
speed_m_s = 0.1
tare = true
limit_s = 3.0
exits = [
    { when = ["force_z > 6 N for 0.032 s"], to = "placed" },
    { when = ["distance > 0.03 m", "width < 0.1 m"], to = "no_floor" },
]
"""


def test_a_text_names_units_and_leaves_out_what_holds():
    """Units tell the modes, degrees are taken, and axes that are left out hold."""
    touch = net_of_text(TEXT).primitives["touch"]

    assert touch.axes == axes(z=("velocity", -0.05), rx=("position", math.pi))
    np.testing.assert_allclose(touch.frame.offset[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)
    assert touch.exits == (
        way("placed", "force_z > 6 0.032"),
        way("no_floor", "distance > 0.03", "width < 0.1"),
    )
    assert (touch.tool, touch.tare, touch.frame.follows) == ("keep", True, False)


@pytest.mark.parametrize(
    ("found", "written", "message"),
    [
        ("[ends]", "[ends", "no TOML: Expected ']' at the end of a table declaration (at line 4"),
        ('name = "place"', "name = 3", "place.toml: name: it is 3; it must be a string"),
        ("limit_s = 3.0", "", "place.toml: primitives.touch.limit_s: it is missing"),
        ("limit_s = 3.0", "limit_s = true", "touch.limit_s: it is True; it must be a number"),
        ("tare = true", "tara = true", "place.toml: primitives.touch.tara: unknown key; known:"),
        ("-0.05 m/s", "-0.05 N/m", "primitives.touch.axes.z: '-0.05 N/m' is no number with one of"),
        ("180 deg", "180 m", "axes.rx: '180 m' is no number with one of the units rad, rad/s, Nm"),
        ("force_z >", "force_q >", "exits[1].when[1]: 'force_q > 6 N for 0.032 s': unknown quantity"),
        ("6 N", "6 mm", "exits[1].when[1]: 'force_z > 6 mm for 0.032 s': force_z has the unit N"),
        ("force_z > 6 N", "force_z 6", "exits[1].when[1]: 'force_z 6 for 0.032 s' is no condition"),
        ("at_m = [0.0, 0.0, 0.04]", "at_m = [0.0]", "frame.at_m: it is [0.0]; it must be an array"),
        ("at_m = [0.0, 0.0, 0.04]", "offset = [[1]]", "frame.turn_deg: the offset holds it already"),
        ('to = "placed"', 'to = "plcd"', "place.toml: net place: primitive touch: exit 1 leads to"),
        ("tare = true", 'tool = "width 3 N"', 'touch.tool: \'width 3 N\' is neither "keep" nor'),
    ],
)  # fmt: skip
def test_a_faulty_file_names_file_and_key(tmp_path, found, written, message):
    """Each mistake in a file is one line with the file and the line or key."""
    file = tmp_path / "place.toml"
    assert found in TEXT
    file.write_text(TEXT.replace(found, written, 1), "utf-8")

    with pytest.raises(NetError) as refused:
        read_net(file)

    assert message in str(refused.value)
    assert str(file) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_that_is_no_text_is_refused(tmp_path):
    """Bytes that are no UTF-8 are named with the file; a written net is read back."""
    file = tmp_path / "net.toml"
    file.write_bytes(b'name = "\xff"')
    with pytest.raises(NetError, match=r"net\.toml: byte 8 is no UTF-8"):
        read_net(file)

    write_net(net_of_text(TEXT), file)

    assert as_plain(read_net(file)) == as_plain(net_of_text(TEXT))
