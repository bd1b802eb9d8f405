"""What the sensors of the tray and the belt see."""
