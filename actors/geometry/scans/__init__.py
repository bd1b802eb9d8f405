"""Scans of real sensors, as files."""
