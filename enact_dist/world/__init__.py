"""Handles: the cell, its world contexts now and in the past, and what they list."""
