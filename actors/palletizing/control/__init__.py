"""Control of the arm, the gripper and the belt: nets executed in a fast loop."""
