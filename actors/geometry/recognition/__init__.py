"""Known objects in measurements: where they are, and how they deviate."""
