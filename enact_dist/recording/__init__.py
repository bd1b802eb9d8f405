"""Recordings: every version of chosen slots in a file that others can open, and back into a cell.

A recording is an MCAP file.  Each version is in it exactly, for `replay`, and once more as a
message that Foxglove shows and Rerun converts.

==============================  =======================  =========================================
topic                           encoding                 one message is
==============================  =======================  =========================================
``/enact/<world>/<aspect>``     msgpack                  one version, exact: see `exact`
``/enact/gaps``                 json                     versions that the recording does not have
``/<world>/<entity>/<aspect>``  protobuf or json         the same version to look at: see `drawing`
==============================  =======================  =========================================

The log time of a message is the stamp of the commit, its publish time the capture stamp (that of
the commit where the writer gave none), its sequence number the version.  What was there when the
recording began has the begin as its log time; its own stamp stands in the exact message.  The data
of one commit follow one another and lie in one chunk.

A metadata record ``enact`` opens the file (format, cell, what is recorded, begin), another one,
``enact.end``, closes it (how much, what is missing).  Chunks are bounded in size and time and each
is forced to the disk before the next one is begun, so a recording that was cut off is good up to
its last whole chunk.

==============  ==================================================================================
module          what it does
==============  ==================================================================================
`exact`         a version ↔ the bytes of its exact message
`drawing`       a datum as messages of Foxglove's schemas, or as JSON
`file`          the MCAP file, chunk by chunk; `disk` is the thread that writes it
`reading`       a file back, as far as it is whole
`recorder`      follows a cell and records it
`replaying`     commits a recording again
`exporting`     one world context as of one moment, into a file
`causes`        what versions were made of, and what was made of them
==============  ==================================================================================

`cell.toml` describes how to show the data of an aspect (`enact_dist.config.shows`).  The
packages that all this needs are those of the extra ``record``.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from enact_dist.config.shows import Shows
from enact_dist.extras import require

if TYPE_CHECKING:
    from enact_dist.recording.exporting import ExportSummary, export_world
    from enact_dist.recording.reading import Recording
    from enact_dist.recording.recorder import Recorder
    from enact_dist.recording.replaying import Replay, ReplaySummary
    from enact_dist.recording.summary import RecordingSummary

require("a recording", "record", "mcap", "foxglove_schemas_protobuf")

__all__ = [
    "ExportSummary",
    "Recorder",
    "Recording",
    "RecordingSummary",
    "Replay",
    "ReplaySummary",
    "Shows",
    "export_world",
]

_HOME_OF = {
    "ExportSummary": "exporting",
    "Recorder": "recorder",
    "Recording": "reading",
    "RecordingSummary": "summary",
    "Replay": "replaying",
    "ReplaySummary": "replaying",
    "export_world": "exporting",
}


def __getattr__(name: str) -> object:
    """Load one of the names above at its first use: to draw a datum needs none of them."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value
