"""What Foxglove and Rerun show of a datum: images, clouds, meshes, poses, solids, or JSON."""
