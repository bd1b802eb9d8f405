"""Applications of enact_dist, one folder each; what they share stands beside them.

`geometry` holds the mathematics, `comparators` what its data types are compared by.
"""
