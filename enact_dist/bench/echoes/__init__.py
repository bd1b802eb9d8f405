"""Bare echoes over Zenoh and a Unix socket, as floors: nothing of this project is in them."""
