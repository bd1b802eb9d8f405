"""Motions of the simulated arm for exact cases; no executor, no perception."""

import numpy as np

from actors.geometry.arms.kinematics import jacobians, tool_poses
from actors.geometry.poses import on_tray
from actors.palletizing.simulation.cell.scene import ARM, HOME_RAD, TABLE_M
from actors.palletizing.simulation.physical_packages import PhysicalPackage
from actors.palletizing.simulation.physics import PhysicalCell


def carton(number=0, *, product="milk_carton", mass_kg=0.5, friction=0.4, **more):
    """Return a package of which nothing is random."""
    plain = {"yield_share": 1.0, "contact_s": 0.008, "centre_offset_m": (0.0, 0.0, 0.0)}
    plain |= {"pick_offset_m": (0.0, 0.0), "belt_y_m": 0.0, "belt_yaw_rad": 0.0}
    return PhysicalPackage(number, product, mass_kg, friction, **(plain | more))


def above(x_m, y_m, z_m, *, yaw_rad=np.pi):
    """Return base_from_tool with the hand down, a height above the table, far from limits.

    The fingers move along y.
    """
    pose = on_tray(x_m, y_m, yaw_rad) @ np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = TABLE_M + z_m
    return pose


def on_belt(x_m=0.40, y_m=0.62, yaw_rad=0.0):
    pose = on_tray(x_m, y_m, yaw_rad)
    pose[2, 3] = TABLE_M
    return pose


def joints_for(pose, start_rad=HOME_RAD):
    """Return the joints that bring the tool to a pose, by damped least squares."""
    q = np.array(start_rad)
    for _ in range(200):
        tool = tool_poses(ARM, q)[0]
        turn = 0.5 * sum(np.cross(tool[:3, i], pose[:3, i]) for i in range(3))
        error = np.concatenate([pose[:3, 3] - tool[:3, 3], turn])
        if np.abs(error).max() < 1e-6:
            return q
        jacobian = jacobians(ARM, q)[0]
        q = q + jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-6 * np.eye(6), error)
    raise AssertionError(f"no joints reach {pose}")


class Hand:
    """Moves the arm of a stepped cell from pose to pose."""

    def __init__(self, packages, *, seed=1):
        self.cell = PhysicalCell(packages, seed=seed)
        self.arm = self.cell.arm
        self.q = np.array(HOME_RAD)
        self.arm.start()

    def to(self, pose, seconds):
        """Move smoothly; the path is straight in joints."""
        start, goal = self.q, joints_for(pose, self.q)
        cycles = round(seconds / self.arm.cycle_s)
        for cycle in range(1, cycles + 1):
            s = cycle / cycles
            self.send(start + (goal - start) * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5))

    def send(self, q):
        """Command one cycle."""
        self.q = q
        self.arm.command(q)
        self.cell.step()

    def swing(self, rad_s2, seconds):
        """Turn the first joint there and back with a constant acceleration, stopping twice."""
        quarter = round(seconds / 4.0 / self.arm.cycle_s)
        speed, q = 0.0, self.q
        for sign in [1.0] * quarter + [-1.0] * 2 * quarter + [1.0] * quarter:
            speed += sign * rad_s2 * self.arm.cycle_s
            q = q - np.eye(7)[0] * speed * self.arm.cycle_s
            self.send(q)

    def grasp(self, x_m, y_m, force_n, *, z_m=0.035):
        """Take what stands at a place and lift it by 150 mm."""
        self.to(above(x_m, y_m, z_m + 0.15), 1.2)
        self.to(above(x_m, y_m, z_m), 0.8)
        self.arm.grip_force(force_n)
        self.cell.step(130)
        self.to(above(x_m, y_m, z_m + 0.15), 0.8)

    def tool_from(self, number):
        """Return tool_from_product of a package, (4, 4)."""
        return np.linalg.inv(self.arm.measured().tcp) @ self.cell.pose(number)

    def package(self, number):
        """Return the truth about a package."""
        return self.cell.truth().packages[number]
