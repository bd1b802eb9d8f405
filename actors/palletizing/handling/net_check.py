"""Checks the file of a net, or of a skeleton, and draws it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.palletizing.handling.grounding import Job, parameters
from actors.palletizing.handling.net_files import net_of_document, read_document
from actors.palletizing.handling.net_picture import svg_of_net
from actors.palletizing.handling.skeleton_files import bind
from actors.palletizing.placing.finger_room import Grasp, Gripper

if TYPE_CHECKING:
    from pathlib import Path

    from actors.palletizing.handling.nets import Net

_GRASP: Final = Grasp(np.array([0.0, 0.0, 0.04]), np.array([0.0, 1.0, 0.0]), 0.095, 45.0, 0.03, 0.5)
EXAMPLE: Final = Job(
    package="package/1",
    grasp=_GRASP,
    size_m=np.array([0.2, 0.095, 0.07]),
    place="place/1",
    push=np.array([0.0, -1.0, 0.0]),
    bin="bin",
)
"""With what a skeleton is bound to be checked: a milk carton."""


def net_of_file(file: Path) -> Net:
    """Return the net of a file; of a skeleton, bound to a milk carton.

    Raises:
        NetError: One line with the file and what is wrong in it.
        OSError: The file cannot be read.
    """
    document = read_document(file)
    if "parameters" in document:
        values = parameters(EXAMPLE, Gripper(), lambda _: np.eye(4))
        document = bind(document, values, str(file))
    return net_of_document(document, str(file))


def check_net(file: Path, out: Path) -> str:
    """Draw the net of a file; return what it is in one line.

    Args:
        file: Of the net or skeleton, TOML as in `net_files`.
        out: Folder of the picture; it is made.

    Raises:
        NetError: One line with the file and what is wrong in it.
        OSError: A file cannot be read or written.
    """
    net = net_of_file(file)
    out.mkdir(parents=True, exist_ok=True)
    picture = out / f"{file.stem}.svg"
    picture.write_text(svg_of_net(net), "utf-8")
    ends = ", ".join(
        f"{name} ({'success' if good else 'failure'})" for name, good in net.ends.items()
    )
    return (
        f"{file}: net {net.name} is sound: {len(net.primitives)} primitives, ends {ends};"
        f" picture {picture}"
    )
