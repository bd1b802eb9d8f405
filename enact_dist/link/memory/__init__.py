"""Payloads in shared memory: maps, their names, and who may release them."""
