"""Configuration of a cell: the tables of `cell.toml`, read, checked and shown."""
