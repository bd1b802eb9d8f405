"""Operate a cell: supervise its processes, and diagnose what is wrong with them."""
