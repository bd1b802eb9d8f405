"""The daemon of a shard: its loop, health, metrics, and the service manager."""
