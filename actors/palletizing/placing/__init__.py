"""Places on the pallet: rows, room for the fingers, and grasps."""
