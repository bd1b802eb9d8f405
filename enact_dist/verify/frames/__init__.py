"""Hostile frames: whatever the wire can carry, a shard answers it, and every answer can be sent."""
