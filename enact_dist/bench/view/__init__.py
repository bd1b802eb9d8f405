"""Bench `view`: `case` measures, `worker` is a process of the scene or before its page."""
