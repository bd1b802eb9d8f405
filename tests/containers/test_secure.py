"""The compose file with keys and rights, by its one switch: what is refused, and the same verdicts.

The refusals come while the cell trains, and change nothing of what it finds.
"""

import pytest

pytest.importorskip("open3d", exc_type=ImportError)

from stack import PACKAGES, Stack, judged

pytestmark = [pytest.mark.containers, pytest.mark.sampled(1, of="profiles in containers")]

PLAIN = "deploy/compose.yaml"
SWITCH = f"{PLAIN}:deploy/compose.secure.yaml"

SHAKE_HANDS = """
import socket, ssl
context = ssl.create_default_context(cafile="/keys/ca.pem")
{own}
try:
    with context.wrap_socket(
        socket.create_connection(("shard-left", 7447), 10), server_hostname="shard-left"
    ) as link:
        link.recv(1)
    print("let in")
except ssl.SSLError as error:
    print(error.reason)
"""
"""A shard that accepts the certificate sends nothing, and closes the connection after a second."""
OWN = 'context.load_cert_chain("/keys/feedback.crt", "/keys/feedback.key")'


@pytest.fixture(scope="module")
def stack(engine, images, alone, tmp_path_factory):
    """The project, up, as one variable of the environment makes it."""
    with Stack(engine, "secure", tmp_path_factory.mktemp("secure"), COMPOSE_FILE=SWITCH) as stack:
        stack.compose("up", "--detach")
        for shard in ("shard-left", "shard-right"):
            stack.log_until(shard, "ready: ")
        yield stack


def test_a_program_without_a_key_is_refused(stack):
    """A container of the same network: the plain one, and one that has the authority's certificate."""
    plain = stack.compose(
        *("--file", PLAIN, "run", "--rm", "--no-deps", "-T"),
        *("enact", "shard", "check", "--timeout", "2"),
        check=False,
    )

    assert plain.returncode
    assert "left: unreachable" in plain.stdout + plain.stderr
    assert stack.python("feedback", SHAKE_HANDS.format(own=OWN)) == "let in"
    assert "CERTIFICATE_REQUIRED" in stack.python("feedback", SHAKE_HANDS.format(own=""))


def test_a_write_without_a_right_is_refused_by_name(stack):
    """What the planning writes the feedback may not; the operator may, whose key is elsewhere."""
    assert stack.ended("planning") == 0
    put = ("world", "put", "training", "product/milk_carton/scan", "99")
    probe = ("world", "put", "online", "probe/mark", "1", "--new")

    said = stack.enact(*put, check=False)
    ada = stack.compose("run", "--rm", "--no-deps", "-T", "enact", *probe)

    assert "feedback may not write training:product/milk_carton/scan" in said
    assert "probe/mark set, v1" in ada.stdout
    assert stack.docker("exec", "feedback", "ls", "/keys").split() == [
        *("ca.pem", "feedback.crt", "feedback.key")
    ]


def test_a_second_up_keeps_the_keys(stack):
    """And leaves running containers alone."""
    before = stack.docker("exec", "feedback", "cat", "/keys/feedback.crt"), stack.state("feedback")

    stack.compose("up", "--detach", "--no-recreate", "shard-left", "feedback")

    after = stack.docker("exec", "feedback", "cat", "/keys/feedback.crt"), stack.state("feedback")
    assert after[0] == before[0]
    assert after[1]["StartedAt"] == before[1]["StartedAt"]
    assert stack.docker("logs", "keys").count("each of these names has a key") >= 1


def test_with_keys_and_rights_verdicts_are_those_without(stack, alone):
    """Every actor has the rights that it needs, and every container the key."""
    assert stack.ended("demo") == 0, stack.docker("logs", "demo")
    assert judged(stack.out) == alone()
    assert stack.docker("logs", "feedback").count("place/") == PACKAGES
