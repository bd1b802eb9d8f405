"""Real daemons and real clients under real faults, judged by the same checker as the simulator.

`runner` starts a cell whose hosts are network namespaces (`network`), lets client processes
(`client`, `workload`) lock, read and write at random, and does to them what `faults` draws.  Each
client keeps a `journal`; `evidence` turns the journals into a history for `verify.checker`;
`figures` tells what happened; `command` is `enact verify --chaos`.  `replicated` has cells whose
shards store in a database, each with a standby daemon.
"""
