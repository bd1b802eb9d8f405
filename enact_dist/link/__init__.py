"""Threads, sockets, files and clocks: everything that touches the world outside."""
