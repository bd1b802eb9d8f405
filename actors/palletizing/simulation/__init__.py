"""A SIMULATOR of the palletizing cell: it stands in for sensors and packages, never for actors.

=============  =====================================================================
products       true shapes of the food packages
packages       a seeded sequence of packages on the tray, with their true deviations
noise          what a structured-light sensor makes of the true depth
sensors        ray-cast depth sensors, above the tray and in the robot's hand
=============  =====================================================================

Rule a change must keep: nothing outside this folder but the demo's score reads the truth.  What it
leaves out: reflections of the metal tray, motion blur, lens distortion, moisture, labels.
"""
