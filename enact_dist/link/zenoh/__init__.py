"""Transport over Zenoh: the carrier of a client and the service of a shard."""
