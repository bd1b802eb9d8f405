"""The data of a moment as nodes of a scene, images, meshes and files; pure."""
