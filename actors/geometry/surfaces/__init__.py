"""Surfaces from depth images: points, fusion, rendering, distances."""
