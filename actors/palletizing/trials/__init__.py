"""Trials in simulated time, and how well the cell did in them."""
