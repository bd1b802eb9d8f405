"""Calibrated pictures in folders: a cell without live cameras."""
