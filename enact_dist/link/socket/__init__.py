"""Transport over Unix sockets: the carrier of a client and the service of a shard."""
