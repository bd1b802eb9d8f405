"""Arms: their kinematics, paths of their joints, and what they touch."""
