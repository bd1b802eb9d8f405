"""The simulated arm as data: kinematics and limits of an LBR iiwa 14 R820, shape of our own.

Lengths, ranges and speeds are those of the data sheet.  It names no accelerations; those here let
the quickest point of the stretched arm brake with more than 6 m/s².  The shape is five capsules
that hold the links and a tool of 0.2 m; nothing of it comes from meshes of others.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from actors.workcell.vocabulary import ArmModel

BASE_HEIGHT_M: Final = 0.75
"""The arm stands on a pedestal in the origin of the cell."""

TOOL_M: Final = 0.20
"""From the flange to the tip of the tool."""

HOME_RAD: Final = (0.0, 0.6, 0.0, -1.3, 0.0, 0.9, 0.0)
"""Where the arm stands at the start: bent, above the table."""

_D_M: Final = (0.36, 0.0, 0.42, 0.0, 0.40, 0.0, 0.126)
_ALPHA_DEG: Final = (-90.0, 90.0, 90.0, -90.0, -90.0, 90.0, 0.0)


def _arm() -> ArmModel:
    base = np.eye(4)
    base[2, 3] = BASE_HEIGHT_M
    return ArmModel(
        dh=np.stack([_D_M, np.zeros(7), np.deg2rad(_ALPHA_DEG), np.zeros(7)], axis=1),
        base=base,
        capsules=np.array(
            [
                [0, 0.0, 1, 0.0, 0.10],
                [1, 0.0, 3, 0.0, 0.09],
                [3, 0.0, 5, 0.0, 0.085],
                [5, 0.0, 7, 0.0, 0.075],
                [7, 0.0, 7, TOOL_M, 0.05],
            ]
        ),
        q_max=np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0]),
        dq_max=np.deg2rad([85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0]),
        ddq_max=np.array([8.0, 8.0, 10.0, 10.0, 15.0, 15.0, 20.0]),
    )


ARM: Final = _arm()
"""The arm of the simulated cell."""
