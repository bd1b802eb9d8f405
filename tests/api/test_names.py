"""What a client is called and what people give as a reason: one line each, refused where it is said."""

from __future__ import annotations

import pytest

from enact_dist import connect
from enact_dist.errors import ConfigError, MisuseError

pytestmark = pytest.mark.carrier("local", "drawn")


@pytest.mark.parametrize("actor", ["a\nCRITICAL b", "\x1b[2J", "\u202egnp", "x" * 201])
def test_client_with_a_name_that_forges_lines_does_not_connect(actor):
    """Its name would stand in the logs and tables of all others."""
    with pytest.raises(ConfigError, match=r"an actor cannot be called"):
        connect("tcp/127.0.0.1:1", actor=actor)


@pytest.mark.parametrize(
    ("reason", "says"), [("r" * 501, "501 characters; at most 500"), ("a\nb", r"no line breaks")]
)
def test_reason_is_one_line_of_some_length(cell, reason, says):
    """Of a broken lock, of an aborted one, of settled alarms: the shard is not even asked."""
    for act in (
        lambda: cell.break_lock(1, shard="local", reason=reason),
        lambda: cell.force_abort(1, shard="local", reason=reason),
        lambda: cell.acknowledge_alarms(shard="local", how=reason),
    ):
        with pytest.raises(MisuseError, match=says):
            act()
