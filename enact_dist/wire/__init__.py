"""Messages and data as bytes, pure: nothing here waits, reads a clock or opens a socket.

`enact_dist/docs/protocol.md` describes the format of every message and datum, so that another
language can read it; `tests/wire/test_protocol_page.py` compares it with the code.

Rules to keep: no pickle, ever; everything that arrives is bounded (`limits`) and checked before it
is built; what this version does not know is refused; a change of the format raises its version and
changes the page.

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
