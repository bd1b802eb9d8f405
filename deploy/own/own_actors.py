"""Actors of a project of its own; put yours here, or beside this file."""

from enact_dist import Actor, Aspect, Entity, Lock, World, Write

COUNT = Aspect("count", int)


class Counter(Actor):
    """Counts once a second, so that a new installation shows that it works."""

    count = Write(World("online"), Entity("counter"), COUNT)
    every_s = 1.0

    def update(self, lock: Lock) -> None:
        """Write the next number."""
        lock[self.count] = lock.get(self.count, 0) + 1
