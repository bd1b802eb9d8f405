"""Small wrong edits of a shard's history, each of which the history machine must notice.

As in `machine_mutants`, a mutant replaces one decision through `patch(owner, name, value)`.
"""

from __future__ import annotations

from bisect import bisect_left
from operator import attrgetter

from enact_dist.core.state.history import History
from enact_dist.core.state.retention import SlotHistory
from enact_dist.core.state.slots import SlotMap

LATE_NS = 2_000_000_000


def commit_is_not_yet_shown_at_its_own_stamp(patch):
    """`<` for `<=` where a state is looked up by its stamp."""

    def at(self, at_ns):
        index = bisect_left(self.states, at_ns, key=attrgetter("stamp_ns"))
        return self.states[index - 1] if index else self.kept_at(at_ns)

    patch(SlotHistory, "at", at)


def nothing_is_ever_forgotten(patch):
    """What is known no more shows as what came after it."""
    patch(SlotMap, "known_since_ns", lambda _self, _slot, _newest: 0)


def label_goes_and_its_versions_stay(patch):
    """Letting go of a label leaves what it kept."""
    patch(History, "let_go", lambda self, label: self.labels.pop(label, None))


def versions_grow_too_old(patch):
    """An age ends two seconds late."""
    grow_old = History.grow_old
    patch(History, "grow_old", lambda self, now_ns: grow_old(self, now_ns - LATE_NS))


def versions_of_a_dropped_context_come_again(patch):
    """A context that is made again counts from 1."""
    patch(SlotMap, "next_version", lambda self, slot: self[slot].version + 1)


def restart_loses_the_oldest_version(patch):
    """One row of each history is not taken over."""
    recover = History.recover

    def without_first(self, slot, newest, states, labels):
        recover(self, slot, newest, list(states)[1:], labels)

    patch(History, "recover", without_first)


def kept_version_is_not_stored_when_it_is_replaced(patch):
    """The store keeps what is within retention, and not what a label keeps."""
    patch(
        History,
        "will_hold",
        lambda self, slot, old: old.version > 0 and self.policy(slot.aspect).limits.versions > 1,
    )


def fork_of_the_past_is_one_of_the_present(patch):
    """A fork has the newest data of its source, whatever moment was named."""
    patch(SlotMap, "as_of", lambda self, slot, _at_ns: self[slot])


ALL = (
    commit_is_not_yet_shown_at_its_own_stamp,
    nothing_is_ever_forgotten,
    label_goes_and_its_versions_stay,
    versions_grow_too_old,
    versions_of_a_dropped_context_come_again,
    restart_loses_the_oldest_version,
    kept_version_is_not_stored_when_it_is_replaced,
    fork_of_the_past_is_one_of_the_present,
)
