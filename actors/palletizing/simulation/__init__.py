"""A SIMULATOR of the palletizing cell: it stands in for sensors and hardware, never for actors.

===================  ===============================================================================
products             true shapes of the food packages
packages             a seeded sequence of packages on the tray, with their true deviations
noise                what a structured-light sensor makes of the true depth
sensors              ray-cast depth sensors, above the tray and in the robot's hand
physics              the cell with physics (MuJoCo): arm, gripper, belt, tray, packages
physical_packages    what is random about its packages, and how they are dented
cell.scene           the cell as MuJoCo reads it, and where things stand
cell.arm             the controller of its arm and gripper: limits, wrist sensor
cell.contacts        what touches what: who is pressed, what is grasped, lost, missed
cell.truth           what is true of it
cell.thread          it in real time, in a thread
cell.server          it as a process of its own; `remote_cell` uses it, by `cell.messages`
physical_sensors     ray-cast depth sensors of it, above tray and belt
cell.picture         pictures of it, drawn by MuJoCo
===================  ===============================================================================

Rule a change must keep: nothing outside this folder but the demo's score reads the truth.  What it
leaves out: reflections of the metal tray, motion blur, lens distortion, moisture, labels.
"""
