"""Messages and data as bytes, pure: nothing here waits, reads a clock or opens a socket.

The format, whole, so that another language can read it (array, map, int, str, bin, nil and ext are
msgpack's):

**Frame**: one message.  A header and, where the message holds data, a payload (in Zenoh: the
attachment and the payload of a query, reply or put).  The header is one msgpack array::

    [version = 7, code, field, field, …]

The code says which message it is; the fields are those of the class in `core.protocol.messages`, in
order. A NamedTuple is the array of its fields, a tuple an array, None is nil.  A datum is the array
``[encoding: bin, offset: int, size: int, stamp_ns: int, file: str]``; its body is the `size` bytes
at `offset` of the payload.  Bodies follow one another in the order of the header, each at the next
multiple of 64, zeros between, nothing after the last; an empty body has offset 0.  Where `file` is
not empty, it names a payload of the shard, no byte of the body stands in the frame, and the offset
is 0.  A reader refuses another version, an unknown code, one field too many, an integer over
2^63 - 1.

========  ========================================================================================
requests  Hello 1, Register 2, Acquire 3, TakeView 4, Fetch 5, KeepAlive 6, Commit 7, Outcome 8,
          Validate 9, Release 10, Goodbye 11, AwaitStamp 12, Survey 13, ListLocks 14,
          ListSessions 15, Break 16, Prepare 17, Finish 18, Resolve 19, ForceAbort 20,
          ListAudit 21, Stage 22, ListHistory 23, Explain 24, FindEffects 25, Fork 26,
          DropWorld 27, KeepVersions 28, Ping 29, ListPlaces 30
answers   Welcome 33, Registered 34, Granted 35, Waiting 36, Stale 37, Viewed 38, Slice 39, Gone 40,
          Alive 41, Committed 42, Fenced 43, OutcomeIs 44, Valid 45, Released 46, Reached 47,
          Surveyed 48, Locks 49, Sessions 50, Broken 51, EpochChanged 52, WrongShard 53,
          Refused 54, Changed 55, Prepared 56, Finished 57, Resolved 58, Audited 59, Staged 60,
          Versions 61, Forgotten 62, Forked 63, Dropped 64, Kept 65, Pong 66, Places 67
notices   Notice 97
========  ========================================================================================

**Datum**: `encoding` is two msgpack objects, the version 1 and a tree; `body` is raw bytes that the
tree refers to by offset and length.  Plain values stand in the tree as themselves (int, float64,
bool, str, bin, array for a list, map with keys all str or all int); the rest are extensions, whose
content is again msgpack:

====  ===========================================  ================================================
ext   content                                      means
====  ===========================================  ================================================
1     ``[dtype, shape, order, offset, length]``    array in the body; order ``"C"`` or ``"F"``
2     ``[offset, length]``                         bytes in the body (more than 256)
3     ``[offset, length]``                         UTF-8 text in the body (more than 256 bytes)
4     ``[name, [field names], [nodes]]``           dataclass; nil is allowed for a field; readers
                                                   of an older type leave fields out, those of a
                                                   newer type fill in defaults
5     ``[codec name, node]``                       what a registered codec made of a value
6     ``[node, node, …]``                          tuple
7     ``[offset, length]``                         the tree itself, in the body (more than 4 KiB)
====  ===========================================  ================================================

`dtype` is numpy's text, sign of the byte order first (``<f8``, ``>i4``, ``|u1``, ``<M8[ns]``,
``<U5``), or a map for structures (`arrays`).  Everything in the body starts at a multiple of 64;
`length` is in bytes and equals the dtype's size times the extents of the shape.  Extension 7 stands
only as the whole tree; parts of the body do not overlap.  Example: the int 5 is ``01 05`` with an
empty body; three float64 are ``01`` and ext 1 ``["<f8", [3], "C", 0, 24]`` with 24 bytes of body.

Rules to keep: no pickle, ever; everything that arrives is bounded (`limits`) and checked before it
is built; what this version does not know is refused; a change of the format raises its version.

===============  =================================================================================
module           what it decides
===============  =================================================================================
`frames`         message ↔ header and payload (`parts`: field by field; `bodies`: layout)
`payload`        value ↔ datum (`tree_writer`, `tree_reader`: the tree; `arrays`: numpy)
`shapes`         what a Python type means as a datum; `fingerprint` is its text, by which
                 `core.protocol.datum_types` decides which types go together
`codecs`         types that are no plain data
`keys`           names of shards, sessions and requests on Zenoh
`limits`         the longest of everything
===============  =================================================================================
"""
