"""State of a shard: locks, slots, history, sessions and clocks, each with its own laws."""
