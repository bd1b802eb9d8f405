"""Pure functions on arrays for the actors: no entity, no aspect, no lock, no clock.

===============  ==================================================================================
shapes           what the arrays mean: cloud, surface, depth image, camera
poses            rigid transforms, 4x4, named `to_from_of`
cameras          the board that calibrates cameras, lenses and poses, points -> pixels
hull             silhouettes -> voxels that no camera says to be free -> what is unexplained
surfaces         depth images -> points -> complete surfaces, and back by rendering; distances
recognition      known objects in a cloud: what is new, where it lies, what is missing or deformed
arms             kinematics, paths without collision, how fast an arm may be along them
scans            scans of real sensors, as files
pictures         pictures of clouds and surfaces, without a graphics card
capsules         arms and people as capsules: distances, outlines in images
people           voxels -> persons: where they are, walk, and stretch their limbs
separation       distance to a person <-> speed of a robot (ISO/TS 15066)
===============  ==================================================================================

Rules a change must keep: metres, right-handed, z up (cameras: z forward, x right, y down);
`tray_from_product` carries points of the product frame into the tray frame; nothing here imports
enact_dist, and Open3D loads on the first call that needs it.
"""
