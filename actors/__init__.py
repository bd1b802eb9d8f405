"""Applications of enact_dist, one folder each; `geometry` holds the mathematics they share."""
