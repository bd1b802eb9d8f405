"""Every decision of enact_dist, as pure functions of messages, time and ids.

The three laws
  1. Everything that decides lives here: who gets a lock, what a commit may write, what a client
     may believe.
  2. Nothing here waits, sleeps, reads a clock, draws a random number or logs; time and ids come in
     as arguments.
  3. State changes only inside `Shard.handle`, `Client` and `MultiLock`; each has
     `assert_invariants`, called after every step of a simulation.

Reading order: `datum` (addresses, identities), `messages` (the protocol), `lock_table` (who waits),
`sessions` (who is alive), `tenures` (the life of a lock), `commits` (the fence), `shard` (all of it
behind one method), then the client's half: `beliefs`, `client`,
`multilock`, `cuts`, `finishing`; for commits over shards `prepares` and `decisions`; and for
contexts in time `history` (what was), `causes` (why it is so) and `worlds` (forks and drops).
"""
