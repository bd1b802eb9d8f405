"""The simulated arm as data: kinematics and limits of an LBR iiwa 14 R820, shape of our own.

Lengths, ranges, speeds and payload are those of the data sheet.  It names no accelerations; those
here let the quickest point of the stretched arm brake with more than 6 m/s².  The shape is five
capsules that hold the links and a tool of 0.2 m; nothing of it comes from meshes of others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.workcell.vocabulary import ArmModel

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.workcell.vocabulary import Joints

BASE_HEIGHT_M: Final = 0.75
"""The arm stands on a pedestal in the origin of the cell."""

TOOL_M: Final = 0.20
"""From the flange to the tip of the tool."""

HOME_RAD: Final = (0.0, 0.6, 0.0, -1.3, 0.0, 0.9, 0.0)
"""Where the arm stands at the start: bent, above the table."""

AHEAD_S: Final = 0.15
"""No arm is shown further ahead of its newest sample than this."""

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
        payload_kg=14.0,
    )


ARM: Final = _arm()
"""The arm of the simulated cell."""


def shown_at(joints: Joints, stamp_ns: int) -> npt.NDArray[np.float64]:
    """Return where a simulated camera shows the arm, (7,) rad.

    Between samples it is interpolated.  The tick of an image is often newer than the newest sample;
    then the arm moves on with the acceleration of its last samples, until it is at rest.
    """
    stamps = joints.stamp_ns
    if stamp_ns <= stamps[-1] or len(stamps) < 2:
        at = (stamps - stamps[-1]) / 1e9
        now = (stamp_ns - stamps[-1]) / 1e9
        return np.array([np.interp(now, at, joint) for joint in joints.q.T])
    ahead_s = min((stamp_ns - int(stamps[-1])) / 1e9, AHEAD_S)
    back = -min(4, len(stamps))
    speed = joints.dq[-1]
    gained = (speed - joints.dq[back]) / max((stamps[-1] - stamps[back]) / 1e9, 1e-3)
    braking = speed * gained < 0.0
    rest_s = np.where(braking, -speed / np.where(braking, gained, 1.0), np.inf)
    moving_s = np.minimum(ahead_s, rest_s)
    return np.asarray(joints.q[-1] + speed * moving_s + 0.5 * gained * moving_s**2)
