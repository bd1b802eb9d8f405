"""A cell of one shard as processes, for the pages of `enact view`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "e2e"))
