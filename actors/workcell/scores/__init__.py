"""Runs in simulated time and recordings of runs, scored on their truth."""
