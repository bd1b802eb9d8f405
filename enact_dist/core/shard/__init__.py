"""A shard: requests in, answers and records out, with time as an argument."""
