"""Palletizing from recordings of a real camera."""
