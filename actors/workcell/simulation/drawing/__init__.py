"""Images of the simulated room: what a camera would see of it."""
