"""Keys: valid for Zenoh whatever the names, apart from each other, and the same when taken apart."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol.datum import LockId, Token
from enact_dist.errors import ProtocolError
from enact_dist.wire.keys import (
    ANY,
    RequestKey,
    identity_of,
    notice_key,
    parse_request_key,
    queryable_key,
    quoted_identity,
    request_key,
    shard_of,
    token_key,
    token_of,
    verb_of,
)

NAMES = st.from_regex(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,20}", fullmatch=True)
FORBIDDEN = re.compile(r"[#?$]|//|^/|/$|[^\x21-\x7e]")


@given(NAMES, NAMES, st.text("*/ab", max_size=5) | st.text(max_size=40))
def test_request_key_is_valid_for_every_actor_name(cell, shard, actor):
    """No actor name brings a character or chunk into a key that Zenoh refuses."""
    key = request_key(cell, shard, "acquire", actor)

    assert not FORBIDDEN.search(key)
    assert "*" not in key
    assert key.count("/") == 4


@given(NAMES, NAMES, st.text(max_size=40))
def test_request_key_comes_apart_into_its_parts(cell, shard, identity):
    """Cell, shard, verb and identity, as it travels, are read back from the key."""
    key = request_key(cell, shard, "take_view", identity)

    expected = RequestKey(cell, shard, "take_view", quoted_identity(identity))
    assert parse_request_key(key) == expected


@given(st.text(max_size=40), st.text(max_size=40), st.integers(0, 2**22))
def test_identity_of_a_client_travels_as_it_is_and_is_no_shard(actor, host, pid):
    """Whatever the names, it stands in a key unchanged, and never reads as that of a shard."""
    identity = identity_of(actor, host, pid)

    assert quoted_identity(identity) == identity
    assert len(identity) <= 2000
    assert "@" in identity.removeprefix("shard.")
    assert token_of(token_key("cell", identity, "a1")) == (identity, "a1")


def test_identities_of_two_processes_or_two_hosts_differ():
    """One process of a name never speaks for another one."""
    assert identity_of("camera", "robot", 7) == "camera@robot:7"
    assert identity_of("", "", 0) == "client@-:0"
    assert identity_of("a@b", "c", 1) != identity_of("a", "b@c", 1)


@given(NAMES, st.text(max_size=40))
def test_request_key_of_a_key_part_is_the_same(shard, actor):
    """An answer to a wildcard takes verb and actor from the key of the question, as they stand."""
    asked = request_key(ANY, ANY, "hello", actor)

    answered = request_key("cell", shard, *asked.split("/")[-2:])

    assert answered == request_key("cell", shard, "hello", actor)


def test_keys_are_laid_out_as_documented():
    """Access rules in a router's configuration are written on these."""
    assert request_key("cell", "s0", "commit", "fusion") == "enact/cell/s0/commit/fusion"
    assert request_key("cell", "s0", "commit", "") == "enact/cell/s0/commit/-"
    assert queryable_key("cell", "s0") == "enact/cell/s0/**"
    assert notice_key("cell", "s0") == "enact/cell/@notices/s0"
    assert notice_key("cell", ANY) == "enact/cell/@notices/*"
    assert token_key("cell", "fusion", "a1b2") == "enact/cell/@sessions/fusion/a1b2"
    assert token_key("cell", ANY, ANY) == "enact/cell/@sessions/*/*"


def test_keys_of_tokens_and_notices_name_their_owner():
    """Each parser knows its own kind of key and no other."""
    assert token_of(token_key("cell", "fusion", "a1b2")) == ("fusion", "a1b2")
    assert shard_of(notice_key("cell", "s0")) == "s0"
    assert token_of(notice_key("cell", "s0")) == ("", "")
    assert shard_of(token_key("cell", "fusion", "a1b2")) == ""
    assert token_of("other/cell/@sessions/fusion/a1b2") == ("", "")
    assert token_of("enact/cell/@sessions/a1b2") == ("", "")


@pytest.mark.parametrize(
    "name", ["", "a/b", "@notices", "a*", "**", "a b", "größe", "-a", "a" * 201]
)
def test_keys_refuse_names_that_cannot_stand_in_them(name):
    """A cell or shard of that name could not be told from other keys."""
    for make in (
        lambda: request_key(name, "s0", "hello", ""),
        lambda: request_key("cell", name, "hello", ""),
        lambda: request_key("cell", "s0", name, ""),
        lambda: queryable_key("cell", name),
        lambda: notice_key(name, "s0"),
        lambda: token_key("cell", "fusion", name),
    ):
        with pytest.raises(ValueError, match="name"):
            make()


@pytest.mark.parametrize(
    "key",
    ["enact/cell/s0/*/a", "enact/cell/s0/hello/*", "enact/cell/s0/he$*/a", "enact/*/**/hello/a$*",
     "enact/cell/s0/hello/@a", "enact/cell/s0/hello/ä"],
)  # fmt: skip
def test_request_key_that_stands_for_several_askers_is_refused(key):
    """A wildcard in verb or identity would let one message count as many."""
    with pytest.raises(ProtocolError, match="names no single verb and identity"):
        parse_request_key(key)


@pytest.mark.parametrize(
    "key",
    ["", "enact", "enact/cell/s0/hello", "enact/cell/s0/hello/a/b", "other/cell/s0/hello/a",
     "enact/cell/@notices/s0/x", "enact/cell//hello/a", "enact//s0/hello/a"],
)  # fmt: skip
def test_request_key_of_another_form_is_refused(key):
    """What is no request's key is named."""
    with pytest.raises(ProtocolError, match="a request came on the key"):
        parse_request_key(key)


def test_verb_is_the_class_name_in_lower_case():
    """Verbs follow from the messages; access rules use them."""
    lock = LockId("s", 1, 1)

    assert verb_of(m.TakeView(lock, 0, 0, 0, (), 0)) == "take_view"
    assert verb_of(m.KeepAlive("s", 0, 0, (), b"")) == "keep_alive"
    assert verb_of(m.Validate(lock, Token(1, 1))) == "validate"
