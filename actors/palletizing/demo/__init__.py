"""The demos of palletizing: cells as processes, watched from outside, and their reports."""
