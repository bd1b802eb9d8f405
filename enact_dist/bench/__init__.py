"""`enact bench`: what locks, commits and data cost here, beside the raw floor of the same run.

Only `cli/bench.py` imports this, and only when the verb runs.
"""
