"""A client: locks over several shards, leases as the client believes them, commits."""
