"""`enact actor check --learn`: the rules that give what a running cell refuses."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from enact_dist.cli.target import open_cell
from enact_dist.cli.verbs import DONE, UNREACHABLE, Output
from enact_dist.config.rights import DATA_LISTS, NAMED_LISTS
from enact_dist.core.rights.rules import UNPROVEN, WRITING, data_path, fork_path
from enact_dist.errors import ConfigError, LinkError
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterable, Iterator

    from enact_dist.config.types import CellConfig
    from enact_dist.world.cell import Cell
    from enact_dist.world.listings import RefusalInfo

LOOK_EACH_S: Final = 1.0
_KEYS: Final = (*DATA_LISTS, "fork", *NAMED_LISTS)
_PATHS: Final[dict[str, Callable[[str], str]]] = {**dict.fromkeys(DATA_LISTS, data_path),
                                                  "fork": fork_path}  # fmt: skip
_FLAGS: Final = ("break", "resolve")


@dataclass(frozen=True, slots=True)
class LearnedRefusal:
    """A right that some identity lacked, over all shards.

    Attributes:
        identity: Whose rights the requests used.
    """

    identity: str
    right: str
    what: str
    count: int
    last_s: float


def learn(config: CellConfig, options: argparse.Namespace) -> Output:
    """Collect what the shards of a running cell refuse; print rules that would allow it.

    Raises:
        ConfigError: The cell has no `[rights]`, or lists what cannot be learned from a cell.
        PermissionDeniedError: The command lacks the right `observe`.
    """
    if config.rights is None:
        raise ConfigError(f"{config.path} has no [rights], so its shards refuse nothing")
    learner = Learner(shard.name for shard in config.shards)
    with open_cell(options) as cell:
        try:
            _collect(cell, learner, options.learn)
        except KeyboardInterrupt:
            print("enact: interrupted; this was learned so far", file=sys.stderr)
    known = config.rights.names(config.actor_names, config.security.operators)
    text = "\n".join(rule_lines(learner.learned(), known))
    facts = {"refusals": learner.learned(), "rules": text}
    status = UNREACHABLE if learner.unreachable else DONE
    return Output(facts, text or "nothing was refused", status=status)


def _collect(cell: Cell, learner: Learner, for_s: float) -> None:
    """Ask all shards until the time is over; without any, for all that they remember."""
    end_s = time.monotonic() + for_s
    learner.look(cell, counts=not for_s)
    if for_s:
        print(f"enact: learning for {shown_s(for_s)}; Ctrl-C ends it earlier", file=sys.stderr)
    while (left_s := end_s - time.monotonic()) > 0.0:
        time.sleep(min(LOOK_EACH_S, left_s))
        for one in learner.look(cell):
            print(f"enact: {one.identity} may not {one.right} {one.what}", file=sys.stderr)


class Learner:
    """What shards have refused since the first look.

    Attributes:
        unreachable: The shards that did not answer at the last look.
    """

    def __init__(self, shards: Iterable[str]) -> None:
        self._shards = tuple(shards)
        self.unreachable: set[str] = set()
        self._seen: dict[tuple[str, str, str, str], RefusalInfo] = {}
        self._learned: dict[tuple[str, str, str], LearnedRefusal] = {}

    def learned(self) -> list[LearnedRefusal]:
        """Return everything so far, sorted by identity, right and data."""
        return [self._learned[key] for key in sorted(self._learned)]

    def look(self, cell: Cell, *, counts: bool = True) -> list[LearnedRefusal]:
        """Ask each shard; return what is refused for the first time; nothing unless `counts`."""
        found = []
        for shard in self._shards:
            try:
                infos = cell.refusals((shard,))
            except LinkError as error:
                if shard not in self.unreachable:
                    print(f"enact: {error}", file=sys.stderr)
                self.unreachable.add(shard)
                continue
            self.unreachable.discard(shard)
            found += [one for info in infos if (one := self._take(info, counts=counts))]
        return found

    def _take(self, info: RefusalInfo, *, counts: bool) -> LearnedRefusal | None:
        """Count a refusal; return it if it is the first of its kind."""
        seen = self._seen.get((info.shard, info.identity, info.right, info.what))
        self._seen[info.shard, info.identity, info.right, info.what] = info
        more = info.count
        if seen is not None and seen.first_s == info.first_s:  # else the shard began anew
            more -= seen.count
        if not counts or not more:
            return None
        key = (info.identity, info.right, info.what)
        before = self._learned.get(key)
        if before is None:
            self._learned[key] = LearnedRefusal(*key, more, info.last_s)
            return self._learned[key]
        last_s = max(before.last_s, info.last_s)
        self._learned[key] = replace(before, count=before.count + more, last_s=last_s)
        return None


# ---------------------------------------------------------------- rules


def rule_lines(learned: Iterable[LearnedRefusal], known: Iterable[str]) -> Iterator[str]:
    """Yield the lines of `cell.toml` that give what was refused; comments where no rule can.

    `learned` is sorted by identity; rules may mention the `known` names.
    """
    by_identity: dict[str, list[LearnedRefusal]] = {}
    for one in learned:
        by_identity.setdefault(one.identity, []).append(one)
    for identity, refused in by_identity.items():
        if identity == UNPROVEN:
            yield "# no rule helps clients whose names are not proven (docs/security.md)"
            continue
        if not identity.startswith("@") and identity not in {*known}:
            yield f"# and add {json.dumps(identity)} to `programs` of [rights]"
        gives, comments = _gives(refused)
        yield from comments
        if gives:
            yield f"[[rights.allow]]  # refused {sum(one.count for one in refused)} times"
            yield f"who = {json.dumps(identity)}"
            yield from gives
            yield ""


def _gives(refused: Iterable[LearnedRefusal]) -> tuple[list[str], list[str]]:
    """Return the lines of one rule, and comments on what a rule cannot name."""
    lists: dict[str, list[str]] = {}
    comments = []
    for one in refused:
        if one.right in _FLAGS:
            lists[one.right] = []
        elif _can_stand(one.right, one.what):
            lists.setdefault(one.right, []).append(one.what)
        elif one.right == "observe":
            comments.append(f"# add {json.dumps(one.identity)} to `observe` of [rights]")
        else:
            comments.append(
                f"# {one.identity} may not {one.right} {one.what}: name the data that it needs"
            )
    lines = []
    for key in (*_KEYS, *_FLAGS):
        texts = lists.get(key)
        if texts is not None and key in WRITING:
            texts = [text for text in texts if text not in lists.get("write", ())]
        if texts or (key in _FLAGS and texts is not None):
            lines.append(f"{key} = {json.dumps(texts) if texts else 'true'}")
    return lines, comments


def _can_stand(right: str, what: str) -> bool:
    """Whether a rule can give a right on this."""
    if right not in _KEYS:
        return False
    try:
        _PATHS.get(right, str)(what)
    except ValueError:
        return False
    return True
