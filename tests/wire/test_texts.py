"""Control characters and marks of direction: refused in every text of a request, shown escaped."""

from __future__ import annotations

import json
import random
from typing import Any, get_args

import msgpack
import pytest

from enact_dist.core.protocol.datum import LockId
from enact_dist.core.protocol.messages import Break, Fenced, Hello, ListAudit, Request
from enact_dist.errors import ProtocolError
from enact_dist.verify.frames.hostile import Hostile
from enact_dist.wire.frames import decode_frame, encode_frame
from enact_dist.wire.limits import REASON_CHARACTERS_MAX
from enact_dist.wire.texts import is_safe, shown, shown_json

UNSAFE = [
    "a\nCRITICAL enact.shard: forged", "\x1b[2J\x1b[H", "\x1b]0;title\x07", "\0", "a\tb", "\x7f",
    "\x9b31m", "\u202egnp.exe", "\u2066x", "\u200f", "\u2028", "\u061c",
]  # fmt: skip
SAFE = ["", "camera 1", "größe", "[bold red]x[/]", "事件", "\U0001f916", "e\u0301", "\u00a0"]


def texts_of(raw: Any, path: tuple[int, ...] = ()) -> list[tuple[int, ...]]:
    """Return the places of all texts in an array."""
    if isinstance(raw, str):
        return [path]
    if not isinstance(raw, list):
        return []
    return [found for index, one in enumerate(raw) for found in texts_of(one, (*path, index))]


def put(raw: list[Any], path: tuple[int, ...], text: str) -> list[Any]:
    """Return the array with another text in one place."""
    head, *rest = path
    changed = text if not rest else put(raw[head], tuple(rest), text)
    return [*raw[:head], changed, *raw[head + 1 :]]


def requests() -> dict[type, list[Any]]:
    """Return the header of a request of each kind, with as many texts in it as chance has put."""
    hostile, found = Hostile(random.Random(7)), {}
    while len(found) < len(get_args(Request)) or min(map(len, found.values())) < 3:
        request = hostile.request({})
        try:
            header, payload = encode_frame(request)
            decode_frame(header, bytes(payload or b""))
        except ProtocolError:
            continue
        if payload is None:
            found.setdefault(type(request), []).append(msgpack.unpackb(header))
        elif type(request) not in found:
            found[type(request)] = [None] * 3  # its bodies are not taken apart here
    return found


def test_text_of_any_request_is_refused_with_an_unsafe_character():
    """In each place of each kind, however deep: a name, a list of names, a slot of a write."""
    tried = 0
    for kind, headers in requests().items():
        for raw in headers:
            for path in texts_of(raw):
                for text in ("a\nb", "\u202e"):
                    tried += 1
                    with pytest.raises(ProtocolError, match=r"character U\+(000A|202E)"):
                        decode_frame(msgpack.packb(put(raw, path, text)))
        assert kind
    assert tried > 200


@pytest.mark.parametrize("text", UNSAFE)
def test_unsafe_text_does_not_arrive(text):
    """Each of what a terminal or a log would act on."""
    hello = Hello("s", 0, 1, text, "host", 1, False)

    assert not is_safe(text)
    with pytest.raises(ProtocolError, match="a text came with the character"):
        decode_frame(encode_frame(hello)[0])


@pytest.mark.parametrize("text", SAFE)
def test_any_other_text_arrives_and_is_shown_as_it_is(text):
    """Letters of all languages, signs, what is markup elsewhere."""
    hello = Hello("s", 0, 1, text, "host", 1, False)

    assert decode_frame(encode_frame(hello)[0]) == hello
    assert shown(text) == text


def test_answers_are_not_refused():
    """What a shard has kept since a release that took such texts must still be told."""
    fenced = Fenced(LockId("s", 0, 1), "broken: a\nb")
    assert decode_frame(encode_frame(fenced)[0]) == fenced


@pytest.mark.parametrize("kind", [lambda text: Break(1, text, 1), ListAudit])
def test_reason_has_its_length(kind):
    """It is kept for good."""
    fits = kind("r" * REASON_CHARACTERS_MAX)
    assert decode_frame(encode_frame(fits)[0]) == fits
    with pytest.raises(ProtocolError, match="500"):
        decode_frame(encode_frame(kind("r" * (REASON_CHARACTERS_MAX + 1)))[0])


@pytest.mark.parametrize("text", UNSAFE)
def test_unsafe_text_is_shown_escaped(text):
    """Nothing that acts is left, in a line, in several, and in JSON that still says the same."""
    assert is_safe(shown(text))
    assert shown(shown(text)) == shown(text)
    assert is_safe(shown(text, lines=True).replace("\n", "").replace("\t", ""))
    told = shown_json(json.dumps({"text": text}, ensure_ascii=False))
    assert is_safe(told)
    assert json.loads(told) == {"text": text}
