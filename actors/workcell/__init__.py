"""Human-robot workcell (ENACT 4.1, Figures 3, 4): eight cameras, hull, speed, path at 10 Hz."""
