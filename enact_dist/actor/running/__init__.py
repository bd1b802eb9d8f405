"""Run an actor: its loop, its triggers, its end, and the process around it."""
