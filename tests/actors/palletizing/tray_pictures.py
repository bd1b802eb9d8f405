"""Pictures of packages on the tray as the overhead sensor takes them."""

import numpy as np

from actors.geometry.poses import moved
from actors.geometry.shapes import VGA, Acquisition, DepthFrame
from actors.palletizing.sight.sensor import steady
from actors.palletizing.simulation.noise import sensed
from actors.palletizing.simulation.products import product_mesh
from actors.palletizing.simulation.sensors import looking_down, tray_meshes, true_depth


def looked_at(*packages, things=(), seed=1):
    """An image of packages, (product, tray_from_product) each, and meshes; eight images fused."""
    seen_by = Acquisition(VGA, looking_down(np.array([0.0, 0.0, 0.95])))
    meshes = [
        (moved(product_mesh(product)[0], pose), product_mesh(product)[1])
        for product, pose in packages
    ]
    depth_m = true_depth([*tray_meshes(), *meshes, *things], seen_by)
    random = np.random.default_rng(seed)
    return steady(lambda: DepthFrame(sensed(depth_m, random), seen_by))
