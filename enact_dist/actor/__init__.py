"""Actors: a class with typed aspects, from its check to its running process."""
