"""Who serves a shard in a database: its lease, its fence, and when a standby takes it."""
