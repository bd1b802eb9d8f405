"""`enact shard`: list, run, back up and rebalance shards."""
