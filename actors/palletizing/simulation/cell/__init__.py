"""The simulated cell: arm, contacts and scene, served to processes in real time."""
