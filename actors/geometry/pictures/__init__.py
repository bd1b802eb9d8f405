"""Pictures of clouds and surfaces, without a graphics card."""
