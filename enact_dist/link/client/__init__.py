"""The client of a cell: connections to its shards, calls, catalogue, payloads."""
