"""The store of a shard in SQLite: batches, rows, and recovery after a fault."""
