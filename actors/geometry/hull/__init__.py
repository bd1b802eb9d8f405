"""The visual hull of a workspace: silhouettes, voxels, and what is known of them."""
