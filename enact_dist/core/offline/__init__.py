"""Work on the records of a shard that does not run: move, purge, recount."""
