"""The simulated cell: arm, people, room and cameras.  No actor that decides uses it.

What it is for: `enact demo workcell` and the tests run the whole cell with a truth to compare
with.  A cell with real cameras and a real arm needs nothing of this package.
"""
