"""Action: attaches the net to the system when the robot is idle (ENACT 4.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from actors.palletizing.vocabulary import CANDIDATE, EXECUTION, NET, ROBOT, SYSTEM, Attached
from enact_dist import Actor, View, World, Write

if TYPE_CHECKING:
    from enact_dist import Lock


class Action(Actor):
    """Attach each candidate once, as soon as the robot has ended the net before."""

    online = World("online")
    candidate = View(online, SYSTEM, CANDIDATE)
    execution = View(online, ROBOT, EXECUTION)
    net = Write(online, SYSTEM, NET)
    triggers = (candidate, execution)

    def update(self, lock: Lock) -> None:
        """Attach the candidate, if it is new and the robot is idle."""
        found, current = lock.get(self.candidate), lock.get(self.net)
        if found is None or found.net is None:
            return
        number = 1
        if current is not None:
            if (current.request, current.stage) == (found.request, found.stage):
                return
            doing = lock.get(self.execution)
            if doing is None or doing.net_version != current.number or not doing.result:
                return
            number = current.number + 1
        lock[self.net] = Attached(
            number, found.request, found.stage, found.net, found.frames, found.turned
        )
