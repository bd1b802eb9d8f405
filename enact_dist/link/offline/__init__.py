"""Work on the folders of shards that do not run: back up, restore, rebalance, purge."""
