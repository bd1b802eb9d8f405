"""Handling of packages: what a request asks, as nets of primitives on grounded places."""
