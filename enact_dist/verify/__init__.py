"""Proof by trial: the real core under simulated faults, real daemons under real ones, one judge.

`enact verify` runs it.  Nothing in the product imports this package.
"""
