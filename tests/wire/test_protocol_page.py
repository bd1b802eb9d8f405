"""`enact_dist/docs/protocol.md`, from which another language is written, says what the code does.

Where a table differs, the failure prints the one that belongs there.
"""

import dataclasses
import re
import types
import typing
from pathlib import Path

import msgpack
import numpy as np
import pytest

from enact_dist import errors
from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol import refused
from enact_dist.core.protocol.datum import Datum
from enact_dist.core.state import tenure
from enact_dist.link.memory.use_marks import PAGE_BYTES, page_name
from enact_dist.link.refusals import error_of
from enact_dist.link.socket import frames as stream
from enact_dist.terms import Access
from enact_dist.wire import limits, tree_writer
from enact_dist.wire.frames import CODES, decode_frame, encode_frame
from enact_dist.wire.payload import encode_datum

PAGE = Path(__file__).parents[2] / "enact_dist" / "docs" / "protocol.md"
TEXT = PAGE.read_text("utf-8")
SCALARS = {int: "int", str: "str", bytes: "bin", bool: "bool"}


def table(heading):
    """Return the cells of the first table below a heading, without its two lines of titles."""
    section = re.search(rf"^#+ {heading}\n(.*?)(?=^#|\Z)", TEXT, re.MULTILINE | re.DOTALL)
    assert section, f"no heading {heading!r}"
    rows = re.search(r"^\|.*\n\|[-| ]+\n((?:\|.*\n)+)", section[1], re.MULTILINE)
    assert rows, f"no table below {heading!r}"
    return [
        tuple(cell.strip().replace("`", "") for cell in line.strip("|").split(" | "))
        for line in rows[1].splitlines()
    ]


def compare(heading, rows, columns=None):
    """Compare a table with its rows of the code; where they differ, show the right one."""
    there = [row if columns is None else row[:columns] for row in table(heading)]
    wanted = [tuple(map(str, row)) for row in rows]
    right = "\n".join(f"| {' | '.join(row)} |" for row in wanted)
    assert there == wanted, f"the table below {heading!r} should be\n\n{right}\n"


def fields_of(kind):
    """Return names and annotations of a message or a part, in the order of the wire."""
    hints = typing.get_type_hints(kind)
    if not dataclasses.is_dataclass(kind):
        return [(name, hints[name]) for name in kind._fields]
    return [(field.name, hints[field.name]) for field in dataclasses.fields(kind)]


def text_of(kind):
    """Return how the page writes the type of a field: `int`, `[Item]`, `Datum?`."""
    if isinstance(kind, types.UnionType):
        (inner,) = (one for one in typing.get_args(kind) if one is not types.NoneType)
        return f"{text_of(inner)}?"
    if typing.get_origin(kind) is tuple:
        return f"[{text_of(typing.get_args(kind)[0])}]"
    return SCALARS.get(kind, kind.__name__)


def fields_text(kind):
    return ", ".join(f"{name}: {text_of(of)}" for name, of in fields_of(kind)) or "-"


def sample_of(kind):
    """Return the emptiest value of an annotation."""
    if kind is Datum:
        return Datum(b"", b"", 0)
    if isinstance(kind, types.UnionType):
        return None
    if kind in SCALARS or typing.get_origin(kind) is tuple:
        return (typing.get_origin(kind) or kind)()
    return kind(*(sample_of(of) for _, of in fields_of(kind)))


def code_of(kind):
    """Return the code of a message as it is sent."""
    _, code, *fields = msgpack.unpackb(encode_frame(sample_of(kind))[0])
    assert len(fields) == len(fields_of(kind))
    return code


def parts_of(kinds):
    """Return the parts that the fields of messages consist of, each once, by name."""
    found = {}
    for kind in kinds:
        for _, annotation in fields_of(kind):
            of = annotation
            while isinstance(of, types.UnionType) or typing.get_origin(of) is tuple:
                of = typing.get_args(of)[0]
            if of not in SCALARS and of is not Datum and of not in found.values():
                found[of.__name__] = of
                found |= parts_of([of])
    return found


REQUESTS = sorted(typing.get_args(m.Request), key=code_of)
ANSWERS = sorted(typing.get_args(m.Answer), key=code_of)


@pytest.mark.parametrize(
    ("heading", "kinds"), [("Requests", REQUESTS), ("Answers", ANSWERS), ("Notices", [m.Notice])]
)
def test_messages_have_the_codes_and_fields_of_the_page(heading, kinds):
    """In the order of their codes; none that is gone, none that is missing."""
    compare(heading, [(code_of(kind), kind.__name__, fields_text(kind)) for kind in kinds], 3)


def test_each_message_stands_on_the_page():
    """No code belongs to a message that no table has."""
    assert set(CODES) == {*REQUESTS, *ANSWERS, m.Notice}


def test_each_request_names_answers_that_there_are():
    """A reader in another language knows what may come."""
    names = {kind.__name__ for kind in ANSWERS}
    for *_, answers in table("Requests"):
        assert set(answers.split(", ")) <= names, answers


def test_parts_of_messages_have_the_fields_of_the_page():
    """Each array in a message is one of these, or a list of them."""
    parts = parts_of([*REQUESTS, *ANSWERS, m.Notice])
    compare("Parts", [(name, fields_text(parts[name])) for name in sorted(parts)])


def test_a_datum_in_a_header_is_what_the_page_says():
    """Two data, the second one at the next multiple of 64; and one that names a file instead."""
    fields = re.findall(r"(\w+): (\w+)", re.search(r"`\[(encoding: .*?)\]`", TEXT)[1])
    slots = [m.WriteItem(("online", name, "cloud"), None) for name in "abc"]
    data = [
        Datum(b"\1\5", b"x" * 3, 3, 7),
        Datum(b"\1\6", b"y" * 2, 2, 8),
        Datum(b"\1\7", b"", 70_000, 9, "session-1"),
    ]
    writes = tuple(one._replace(datum=datum) for one, datum in zip(slots, data, strict=True))
    header, payload = encode_frame(m.Commit(("s", 0, 1), (1, 1), writes, 0))
    sent = [write[1] for write in msgpack.unpackb(header)[4]]

    assert [name for name, _ in fields] == ["encoding", "offset", "size", "stamp_ns", "file"]
    for one in sent:
        assert [kind for _, kind in fields] == [SCALARS[type(value)] for value in one]
    assert sent == [
        [b"\1\5", 0, 3, 7, ""],
        [b"\1\6", limits.ALIGNMENT, 2, 8, ""],
        [b"\1\7", 0, 70_000, 9, "session-1"],
    ]
    assert payload == b"xxx" + bytes(61) + b"yy"


def test_versions_are_those_of_the_page():
    """Frames, stream and data each have their own."""
    compare(
        "Versions",
        [
            ("message", limits.FRAME_VERSION),
            ("stream", stream.STREAM_VERSION),
            ("datum", limits.DATUM_VERSION),
        ],
        2,
    )


def test_text_names_the_version_that_a_datum_begins_with():
    """A reader in another language compares it with the first byte."""
    assert f"two msgpack objects: the version {limits.DATUM_VERSION} and the tree" in TEXT
    assert encode_datum(5, int).encoding[0] == limits.DATUM_VERSION


def test_examples_of_data_are_what_is_sent():
    """The int 5 and three float64."""
    five, floats = encode_datum(5, int), encode_datum(np.zeros(3), np.ndarray)
    unpacker = msgpack.Unpacker(ext_hook=msgpack.ExtType)
    unpacker.feed(floats.encoding)
    version, array = unpacker
    content = str(msgpack.unpackb(array.data)).replace("'", '"')

    assert bytes(five.body) == b""
    assert f"the int 5 is `{five.encoding.hex(' ')}` with an empty body" in TEXT
    assert (
        f"Three float64 are `{version:02x}` and ext {array.code} with `{content}`, "
        f"and {floats.size} bytes of body"
    ) in TEXT


def test_frames_of_a_stream_have_the_kinds_of_the_page():
    """And the prefix is as long as it says."""
    compare("Frames of a stream", [(int(kind), kind.name) for kind in stream.FrameKind], 2)
    prefix = stream.prefixed(b"", 0)
    assert f"{stream.PREFIX_BYTES} bytes" in TEXT
    assert f"`{prefix[:3].hex(' ')}`" in TEXT


def test_extensions_of_a_datum_are_those_of_the_page():
    """Each node that is no plain value."""
    names = ("ARRAY", "BYTES", "TEXT", "RECORD", "CODEC", "TUPLE", "TREE")
    numbers = sorted((getattr(tree_writer, name), name.lower()) for name in names)
    compare("The tree", numbers, 2)


def test_accesses_of_an_item_are_those_of_the_page():
    """The numbers travel."""
    compare("Accesses", [(access.value, access.name) for access in Access], 2)


def test_limits_are_those_of_the_page():
    """Each is a name of `enact_dist.wire.limits`, its figure, and what it bounds."""
    names = [row[0] for row in table("Limits")]
    compare("Limits", [(name, f"{getattr(limits, name):,}") for name in names], 2)
    defined = {name for name in vars(limits)["__annotations__"] if name.endswith("_MAX")}
    assert defined - set(names) == set(), "limits that the page does not have"


def test_kept_grants_have_the_figures_of_the_page():
    """File, cells and answers, by which another language keeps grants."""
    assert f"the file `{page_name('SESSION')}` in the shard's folder, {PAGE_BYTES} bytes" in TEXT
    assert f"{tenure.KEPT_OF_SESSION_MAX} cells, unsigned integers of 8 bytes" in TEXT
    assert (m.NOT_KEPT, m.PROVE, m.PLACES, m.FAR) == (0, 1, 2, 255)
    assert f"{m.FAR} (it stays, see" in TEXT
    assert f"is {m.NOT_KEPT} (the grant is over), {m.PROVE} (it is over, and the client" in TEXT
    assert f"or {m.PLACES} + *n*: the grant stays, and cell *n*" in TEXT


def test_codes_of_refusals_are_those_of_the_page_and_have_one_home():
    """A code that is written out where a request is refused could be misspelt there."""
    codes = {value for name, value in vars(refused).items() if name.isupper()}
    assert {code for code, _, _ in table("Refusals")} == codes
    for file in sorted(PAGE.parents[1].rglob("*.py")):
        calls = re.findall(r"\bRefused\(\s*([^,)]*)", file.read_text("utf-8"))
        assert [code for code in calls if '"' in code] == [], file


def test_refusals_raise_what_the_page_says():
    """Codes that the client library acts on by itself have no error."""
    for code, name, _ in table("Refusals"):
        found = error_of(m.Refused(code, ""))
        assert name in {"-", type(found).__name__}, code
        assert name == "-" or issubclass(getattr(errors, name), errors.EnactError)


def test_frames_on_the_page_are_what_is_sent():
    """Each hexadecimal header there is read, and written again the same."""
    headers = re.findall(r"^(\w+) +((?:[0-9a-f]{2} ?)+)$", TEXT, re.MULTILINE)
    assert len(headers) >= 3
    for name, digits in headers:
        message = decode_frame(bytes.fromhex(digits))
        assert type(message).__name__ == name
        assert encode_frame(message)[0] == bytes.fromhex(digits)
