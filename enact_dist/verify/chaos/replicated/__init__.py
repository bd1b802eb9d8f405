"""A cell under test whose shards store in a database, each with a daemon that stands by.

`cell` runs two daemons per shard and starts again what ends; `daemon` is such a process, which
leaves in `answers` when it answered; `nodes` makes two servers of PostgreSQL on hosts of their own;
`faults` harms daemons and networks, `database_faults` the servers.
"""
