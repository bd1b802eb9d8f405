"""Two daemons per shard and a replicated database, simulated: nothing acknowledged may be lost."""
