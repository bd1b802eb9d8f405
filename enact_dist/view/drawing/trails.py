"""Where poses were during the last moments, as lines."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

import numpy as np

from enact_dist.view.drawing.nodes import AxesNode, LineNode

if TYPE_CHECKING:
    from collections.abc import Mapping

    from enact_dist.view.drawing.nodes import Node

PLACES_MAX: Final = 200
"""Places of one trail."""
TRAIL_COLOUR: Final = (120, 60, 160)


class Trails:
    """The last places of every pose; a step back in time begins them anew."""

    def __init__(self) -> None:
        self._places: dict[str, deque[tuple[float, float, float]]] = {}
        self._nodes: dict[str, tuple[Node, LineNode | None]] = {}
        self._at_ns = 0

    def follow(self, nodes: Mapping[str, Node], at_ns: int) -> dict[str, LineNode]:
        """Take the nodes of a moment and return the trails up to it.

        Args:
            nodes: The scene, by name.
            at_ns: The moment.
        """
        if at_ns < self._at_ns:
            self._places.clear()
            self._nodes.clear()
        self._at_ns = at_ns
        poses = {name: node for name, node in nodes.items() if isinstance(node, AxesNode)}
        for gone in self._nodes.keys() - poses.keys():
            del self._nodes[gone], self._places[gone]
        for name, node in poses.items():
            if name not in self._nodes or self._nodes[name][0] is not node:
                self._nodes[name] = (node, self._longer(name, node))
        return {f"trail {name}": trail for name, (_, trail) in self._nodes.items() if trail}

    def _longer(self, name: str, node: AxesNode) -> LineNode | None:
        places = self._places.setdefault(name, deque(maxlen=PLACES_MAX))
        x, y, z = map(float, node.matrix[:3, 3])
        if not places or places[-1] != (x, y, z):
            places.append((x, y, z))
        if len(places) < 2:
            return None
        return LineNode(node.frame, np.array(places, np.float32), TRAIL_COLOUR)
