"""What must hold: rules checked at every step of a shard or client, and at the end of a run."""
