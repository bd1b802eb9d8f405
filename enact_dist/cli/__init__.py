"""The `enact` command: one table of verbs per noun, and the functions that carry them out.

`main` reads the command line, `verbs` has the engine, `arguments` what verbs take.  Exit status: 0
done, 1 refused or failed, 2 wrong usage or configuration, 3 unreachable, 4 different.  Imports of
anything slow (zenoh, numpy, rich) stand inside the functions.
"""
