"""Where the images of a camera come from."""
