"""A deterministic simulation of the real core: one seed is one run, faults and all.

The real `Shard`, `Client` and `MultiLock`, and the real wire format, run under simulated clocks,
network, disks and processes.  Nothing here decides what the core decides; `judges` look
at what goes in and comes out.

Reading order: `faults` (what may go wrong), `hosts` (`world`: time and processes; `network`,
`disk`, `shard_host`, `client_host`), `work` (what the clients do), `judges` (`history`; `model`:
checked at every step; `graph`: checked at the end), `scenario` (a whole run from a seed).
"""
