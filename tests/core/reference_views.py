"""One shard from its definition: what readers are shown, and when."""

from __future__ import annotations

from reference_shard import EACH, MS, ReferenceSessions

from enact_dist.patterns import pattern_matches

VIEW_WAIT_NS = 400 * MS
NEVER_NS = 1 << 62


def covers(item, slot) -> bool:
    """Say whether an item names a slot."""
    if (item.context, item.aspect) != (slot.context, slot.aspect):
        return False
    if item.access in EACH:
        return pattern_matches(item.entity, slot.entity)
    return item.entity == slot.entity


class ReferenceViews(ReferenceSessions):
    """Views, which wait for what is undecided, and fetches."""

    views: dict[int, tuple]

    def on_takeview(self, m, handle):
        person = self.known(m.lock.session, m.epoch)
        if person is None:
            self.answer(handle, "epoch", self.epoch)
            return
        self.renew(person, m.count)
        if m.at_ns and self.undecided_ns(m.items) <= m.at_ns:
            self.views[handle] = (m, self.now_ns + VIEW_WAIT_NS)
        else:
            self.view(m, handle)

    def view(self, m, handle):
        """Show the present; the past is judged by the machine, which knows the stamps."""
        shown = None if m.at_ns else frozenset(self.shown(m.items))
        self.answer(handle, "viewed", m.lock, shown)

    def undecided_ns(self, items):
        """Return the least stamp that an undecided commit on these items may get."""
        stamps = [
            life.stamp_ns
            for life in self.lives.values()
            if life.bound and any(covers(item, slot) for item in items for slot, _ in life.writes)
        ]
        return min(stamps, default=NEVER_NS)

    def answer_views(self):
        """A view waits for the undecided before it, but not for ever; its session may end."""
        for handle, (m, end_ns) in list(self.views.items()):
            enough = end_ns <= self.now_ns or self.draining
            if enough or self.undecided_ns(m.items) > m.at_ns:
                del self.views[handle]
                if self.known(m.lock.session) is None:
                    self.answer(handle, "epoch", self.epoch)
                else:
                    self.view(m, handle)

    def on_fetch(self, m, handle):
        version, text = self.slots.get(m.slot, (0, None))
        if self.known(m.lock.session, m.epoch) is None:
            self.answer(handle, "epoch", self.epoch)
        elif text is not None and version == m.version:
            self.answer(handle, "slice", m.slot, version, text)
        else:
            self.answer(handle, "gone", m.slot, m.version)
