"""Pure functions on arrays for the actors: no entity, no aspect, no lock, no clock.

======================  ==========================================================
shapes                  what the arrays mean: cloud, surface, depth image, camera
poses                   rigid transforms, 4x4, named `to_from_of`
projection              points -> pixels of a calibrated camera, with its distortion
charuco                 a board: what it looks like, where a picture shows its corners
camera_calibration      pictures of a board -> lenses and poses of cameras
bundle_adjustment       … all of them at once, by least squares
silhouettes             what differs in an image from the empty cell, without its shadows
voxels                  a grid of voxels, numbered block by block
visibility              which camera can say what about which voxel
visual_hull             what no silhouette says to be free
refinement              what of it is neither robot nor static nor impossible
pockets                 where people can be that no camera sees
capsules                arms and people as capsules: distances, outlines in images
depth                   depth image <-> points, filters, the sensor's spread
rendering               surface -> depth image as a camera would see it
reconstruction          one view's cloud -> triangles and planar patches
fusion                  all views of a product -> one complete surface
outlines                a surface's outline, and what a camera sees of it beside others
registration            where a known surface lies in a cloud of the tray
segmentation            what is new on the tray, piece by piece
deviation               render and compare: missing, extra, moved, deformed
surface_distance        how far two surfaces or clouds are apart
joint_paths             waypoints -> rounded path; how fast an arm may be along it
arm_clearance           which states of an arm touch what is occupied, in batches
joint_planning          collision-free paths by RRT-Connect and shortcuts
people                  voxels -> persons: where they are, walk, and stretch their limbs
separation              distance to a person <-> speed of a robot (ISO/TS 15066)
======================  ==========================================================

Rules a change must keep: metres, right-handed, z up (cameras: z forward, x right, y down);
`tray_from_product` carries points of the product frame into the tray frame; nothing here imports
enact_dist, and Open3D loads on the first call that needs it.
"""
