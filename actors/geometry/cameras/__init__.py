"""Cameras: the board that calibrates them, their models, and points in their images."""
