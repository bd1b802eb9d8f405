"""What a browser shows and does: the only part that knows viser."""
