"""The folder of a store: its lock, marks, payload files, and a log cut by a power failure."""
