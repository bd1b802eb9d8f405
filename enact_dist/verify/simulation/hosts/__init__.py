"""What the simulated cell runs on: time, processes, network and disks around the real core."""
