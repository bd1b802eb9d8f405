"""Draw actors: who uses which aspects, as a graph and as a picture."""
