"""Every decision of enact_dist, as pure functions of messages, time and ids.

The three laws
  1. Everything that decides lives here: who gets a lock, what a commit may write, what a client
     may believe.
  2. Nothing here waits, sleeps, reads a clock, draws a random number or logs; time and ids come in
     as arguments.
  3. State changes only inside `Shard.handle`, `Client` and `MultiLock`; each has
     `assert_invariants`, called after every step of a simulation.

Reading order
  * `protocol/datum` (addresses, identities) and `protocol/messages` (the protocol);
  * the shard's half: `state/lock_table` (who waits), `state/sessions` (who is alive),
    `state/grants` (the life of a lock), `state/commits` (the fence) and `shard/shard` (all of it
    behind one method);
  * the client's half: `client/lease_clock` (what may be believed), `client/client`, `client/lock`,
    `client/cut` (views of one moment) and `client/finishing`;
  * for commits over shards: `shard/on_prepare` and `state/decisions`;
  * for contexts in time: `state/history` (what was) and `shard/on_world` (forks and drops).
"""
