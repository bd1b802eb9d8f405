"""What a page says in words: of a listed datum, of the chosen one, of the moment."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from enact_dist.view import markup
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import VersionEntry
    from enact_dist.recording.exact import Recorded
    from enact_dist.view.catalogue import ListedState
    from enact_dist.view.drawing.scene import ShownDatum
    from enact_dist.view.pages.contents import PageContents
    from enact_dist.view.pages.datum import Samples
    from enact_dist.view.pages.viewer import Viewer


def row_of(
    viewer: Viewer,
    samples: Samples,
    slot: Slot,
    shown: ShownDatum | None,
    below: str,
    past_ns: int,
) -> str:
    """Return a listed datum as HTML.

    Args:
        viewer: What is known of it.
        samples: Its numbers.
        slot: Its slot.
        shown: Its value, None if that has not come.
        below: The path that its name is shown without.
        past_ns: As of which moment; 0: the present.
    """
    catalogue, now_s = viewer.feed.catalogue, time.monotonic()
    recorded = shown.recorded if shown is not None else None
    state: ListedState | Recorded | None = recorded if past_ns else catalogue.state(slot)
    size, by = viewer.size(slot), _writer_of(viewer.entry(slot), recorded, past_ns)
    rate_hz = catalogue.rate_hz(slot, now_s)
    held = viewer.activity_now().held.get(str(slot), "")
    if past_ns:  # rates and holders of that moment are not known
        datum = recorded.datum if recorded is not None else None
        size, rate_hz, held = datum.size if datum is not None else None, None, ""
    name = markup.text(markup.slot_name(slot).removeprefix(below))
    value = markup.short_value(shown.value) if shown is not None else ""
    if recorded is not None and recorded.null_reason:
        value = f"null: {recorded.null_reason}"
    plot = markup.plot(samples.of(slot, past_ns))
    line = f"<b>{name}</b> {markup.text(value)} {plot}"
    facts = [viewer.type_of(slot.aspect)]
    if size is not None:
        facts.append(markup.size(size))
    facts.append(f"{rate_hz:.3g} Hz" if rate_hz is not None else "")
    if state is not None:
        facts += [f"v{state.version}", markup.age(past_ns or time.time_ns(), state.stamp_ns)]
    if by is not None:
        facts.append(f"by {by or '(unnamed)'}")
    facts += [f"lock: {held}"] if held else []
    under = markup.text(" · ".join(filter(None, facts)))
    return f'<div style="margin-bottom:3px">{line}<div style="color:#888">{under}</div></div>'


def _writer_of(entry: VersionEntry | None, recorded: Recorded | None, past_ns: int) -> str | None:
    """Return who wrote a version of the past, or else the newest one; None: unknown."""
    if past_ns:
        if recorded is None:
            return None
        if recorded.actor:
            return recorded.actor
        if entry is None or entry.state[1:3] != recorded.state:
            return None
    return entry.cause.actor if entry is not None and entry.cause is not None else None


def datum_of(
    contents: PageContents, samples: Samples, slot: Slot | None, shown: ShownDatum | None
) -> str:
    """Return the chosen datum in full as HTML, or why it is not there."""
    if slot is None:
        return markup.small("choose a datum in the tab world")
    head = f"<b>{markup.text(slot)}</b>"
    if shown is None:
        gone = slot in contents.forgotten
        why = "has left its retention at this moment" if gone else "is not there at this moment"
        return markup.small(f"{head} {why}")
    recorded = shown.recorded
    parts = [f"v{recorded.version}", markup.clock(recorded.stamp_ns)]
    if recorded.captured_ns:
        parts.append(f"captured {markup.clock(recorded.captured_ns)}")
    if recorded.actor:  # a recording knows who wrote it; of a cell, the tree says so
        parts.append(f"by {recorded.actor}, process {recorded.pid} on {recorded.host}")
    if recorded.null_reason:
        parts.append(f"null: {recorded.null_reason}")
    until_ns = 0 if contents.player.live else contents.player.at_ns
    plot = markup.big_plot(samples.of(slot, until_ns))
    facts = markup.text(" · ".join(parts))
    return markup.small(f"{head}<div>{facts}</div>{markup.whole_value(shown.value)}") + plot


def moment_of(contents: PageContents) -> str:
    """Return as HTML which moment a page shows, and what is missing of it."""
    player = contents.player
    at = markup.clock(contents.at_ns) if contents.at_ns else "no commit yet"
    if player.live:
        return f"<b>now</b>, {at}"
    line = player.timeline
    parts = [f"<b>{at}</b>, {shown_s((line.newest_ns - player.at_ns) / 1e9)} before the newest"]
    parts.append(f"history from {markup.clock(line.oldest_ns)}, {len(line.stamps_ns)} commits")
    if line.whole_ns > line.oldest_ns:
        parts.append(f"all data from {markup.clock(line.whole_ns)} on")
    if contents.forgotten:
        names = ", ".join(map(markup.slot_name, contents.forgotten[:4]))
        more = ", …" if contents.forgotten[4:] else ""
        parts.append(f"{len(contents.forgotten)} data have left their retention: {names}{more}")
    return "<br>".join(markup.text(part) if "<b>" not in part else part for part in parts)
