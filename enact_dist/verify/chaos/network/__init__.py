"""The hosts of a cell under test and the network between them, on one machine."""
