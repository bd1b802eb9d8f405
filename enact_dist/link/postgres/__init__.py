"""The store of a shard in PostgreSQL: rows, bodies, fence, lease, takeover."""
