"""Lets the tests of scripts in this folder import them."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
