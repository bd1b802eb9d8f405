"""A cell with keys and rights, of programs that may do a part of all.

`reader` may read a part and observe, `taker` may only read, all, and `blind` may do nothing.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "link"))

from key_cells import KeyCell

RIGHTS = """
[rights]
default = "none"
programs = ["reader", "taker", "blind"]
observe = ["reader"]
[[rights.allow]]
who = "reader"
read = "online:open/**"
[[rights.allow]]
who = "taker"
read = "online:**"
"""


def guarded_cell(folder, *, carrier="zenoh"):
    """Return such a cell; its shard `left` does not run yet."""
    return KeyCell(folder, carrier=carrier, more=RIGHTS)
