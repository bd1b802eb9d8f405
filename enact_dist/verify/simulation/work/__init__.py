"""What the simulated clients do."""
