"""The `enact` command: one file per noun, `main` dispatches.

A verb is a function of its parsed arguments that returns the exit status: 0 done, 1 refused or
failed, 2 wrong usage or configuration, 3 unreachable.  Imports of anything slow (zenoh, numpy,
rich) stand inside the verbs.
"""
