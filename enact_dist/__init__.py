"""Distributed world contexts for robots."""
