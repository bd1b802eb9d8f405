"""A missing right as the error that a program gets."""

from __future__ import annotations

import pytest

from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import Refused
from enact_dist.core.rights.rules import UNPROVEN, Rights
from enact_dist.errors import LinkError, PermissionDeniedError
from enact_dist.link.refusals import error_of

RIGHTS = Rights([], hint="cell.toml, line 41")


def error(right, what, subject="camera"):
    return error_of(RIGHTS.refuse(subject, "camera@h:1", right, what))


def test_the_error_names_subject_right_slot_and_rule():
    """In words for people, and in attributes for programs."""
    found = error("write", Slot("online", "plan/1", "joints"))
    assert isinstance(found, PermissionDeniedError)
    assert str(found) == (
        "camera may not write online:plan/1/joints: it declares no such request and no"
        " [[rights.allow]] gives it; `enact actor check --rights`, or add it (cell.toml, line 41)"
    )
    assert (found.identity, found.right, found.rule) == ("camera", "write", "cell.toml, line 41")
    assert (found.world, found.entity, found.aspect) == ("online", "plan/1", "joints")


@pytest.mark.parametrize(
    ("right", "what"),
    [("break", "locks"), ("fork", "online -> w"), ("keep", "day/1"), ("write", "aspect joints")],
)
def test_a_right_on_no_slot_leaves_the_slot_out(right, what):
    """Locks, worlds, labels and aspects have no slot."""
    found = error(right, what, "@vision")
    assert isinstance(found, PermissionDeniedError)
    assert (found.identity, found.right, found.rule) == ("@vision", right, "cell.toml, line 41")
    assert (found.world, found.entity, found.aspect) == ("", "", "")


def test_a_name_without_proof_may_try_again():
    """A `LinkError`: over the socket, the same name could be proven."""
    found = error("read", "online:a/b", UNPROVEN)
    assert isinstance(found, LinkError)
    assert "camera@h:1 asked to read online:a/b over Zenoh" in str(found)


def test_another_ones_session_names_no_right():
    """It is refused as forbidden, though no rule would allow it."""
    found = error_of(
        Refused("permission", "session a belongs to b; c asked and may not speak for it")
    )
    assert isinstance(found, PermissionDeniedError)
    assert (found.identity, found.right) == ("", "")


def test_attributes_come_from_facts_whatever_the_text_says():
    """A text may be reworded, and a peer may send facts of any kind."""
    world = error_of(Refused("unknown_world", "reworded", ("online", "lab")))
    assert world.known == ("online", "lab")
    assert error_of(Refused("clock_skew", "reworded", ("2.5",))).ahead_s == 2.5
    for facts in ((), ("soon",)):
        assert error_of(Refused("clock_skew", "9.9 s ahead", facts)).ahead_s == 0.0
    right = error_of(Refused("permission", "reworded", ("cam", "read", "line 4")))
    assert (right.identity, right.right, right.rule, right.world) == ("cam", "read", "line 4", "")
