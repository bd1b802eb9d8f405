"""What an actor class may declare, and what is refused when the class is made."""

from __future__ import annotations

import pytest

from enact_dist.access.together import Together
from enact_dist.actor.actor import Actor, Declaration
from enact_dist.errors import MisuseError
from enact_dist.terms import (
    Aspect,
    Context,
    Entities,
    Entity,
    Read,
    ReadEach,
    View,
    World,
    Write,
    WriteEach,
)

training, online = World("training"), World("online")
PRODUCTS, SYSTEM = Entities("product/*"), Entity("system")
SURFACE, FLAGS, COUNT = Aspect("surface", str), Aspect("flags", dict), Aspect("count", int)


CLOUD = View(online, SYSTEM, SURFACE)
FLAG = Write(online, SYSTEM, FLAGS)
PAIR = Together([CLOUD, View(online, Entity("other"), SURFACE)], by="stamp")


def runs_later(_self, _lock):
    """Yield, so that a call of it does nothing yet."""
    yield


async def runs_never(_self, _lock=None):
    """Be a coroutine, of which a call runs nothing."""


def declared(**attributes: object) -> Declaration:
    """Make an actor class named `Sample` with these attributes and an update."""
    attributes.setdefault("update", lambda _self, _lock: None)
    return type("Sample", (Actor,), attributes).declaration


def test_declaration_holds_requests_roles_and_triggers_when_the_class_is_made():
    """The class attributes that are lock requests are the declared lock, in their order."""
    reference, observed = View(training, PRODUCTS, SURFACE), View(online, PRODUCTS, SURFACE)
    flags = Write(online, SYSTEM, FLAGS)

    found = declared(reference=reference, observed=observed, flags=flags, triggers=[observed])

    assert dict(found.requests) == {"reference": reference, "observed": observed, "flags": flags}
    assert found.triggers == (observed,)
    assert found.roles == ("training", "online")
    assert found.per_entity


def test_declaration_depends_on_no_entity_when_only_sets_and_single_entities_are_named():
    """One run sees everything that an Each-request reads."""
    views = ReadEach(training, Entities("view/*"), SURFACE)

    found = declared(views=views, product=Write(training, SYSTEM, SURFACE), triggers=(views,))

    assert not found.per_entity


def test_declaration_is_inherited_and_overridden_by_attribute_name():
    """A subclass has its base's requests; an attribute of the same name replaces one."""

    class Base(Actor):
        cloud = View(online, SYSTEM, SURFACE)
        count = Write(online, SYSTEM, COUNT)

    class Derived(Base):
        cloud = View(training, SYSTEM, SURFACE)

        def update(self, lock):
            pass

    assert set(Derived.declaration.requests) == {"cloud", "count"}
    assert Derived.declaration.requests["cloud"].world.name == "training"


def test_declaration_covers_an_entity_only_when_every_pattern_without_each_matches():
    """An entity that one request cannot stand for triggers nothing."""
    seen = View(online, Entities("**"), SURFACE)

    found = declared(seen=seen, mark=Write(online, PRODUCTS, FLAGS), triggers=[seen])

    assert found.covers(Entity("product/1"))
    assert not found.covers(Entity("tray/1"))


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        pytest.param(
            {"cloud": View(Context("online"), SYSTEM, SURFACE)},
            r"Sample\.cloud names Context\('online'\).*roles such as World\(\"online\"\)",
            id="context instead of role",
        ),
        pytest.param(
            {"cloud": View(online, SYSTEM, SURFACE), "triggers": [View(online, SYSTEM, FLAGS)]},
            r"Sample\.triggers\[0\].*no request of this class; it declares cloud",
            id="undeclared trigger",
        ),
        pytest.param(
            {"flags": Write(online, SYSTEM, FLAGS), "triggers": [Write(online, SYSTEM, FLAGS)]},
            r"Sample\.triggers\[0\].*only a Read, View, ReadEach or ViewEach can trigger",
            id="writing trigger",
        ),
        pytest.param(
            {"cloud": View(online, SYSTEM, SURFACE), "triggers": "cloud"},
            r"Sample\.triggers is 'cloud'",
            id="text for triggers",
        ),
        pytest.param(
            {"cloud": CLOUD, "triggers": CLOUD},
            r"Sample\.triggers is View\(.*write triggers = \[cloud\], a list even of one",
            id="one request for triggers",
        ),
        pytest.param(
            {"triggers": CLOUD},
            r"write triggers = \[NAME\], .* of requests that are attributes of the class",
            id="undeclared request for triggers",
        ),
        pytest.param(
            {"both": PAIR, "triggers": PAIR},
            r"Sample\.triggers is Together\(.*write triggers = \[both\]",
            id="one set for triggers",
        ),
        pytest.param(
            {"flags": FLAG, "shared": FLAG},
            r"Sample\.shared is Write\(.*write shared = \[flags\]",
            id="one request for shared",
        ),
        pytest.param(
            {
                "cloud": View(online, SYSTEM, SURFACE),
                "triggers": [View(online, SYSTEM, SURFACE)],
                "every_s": 0.1,
            },
            "both triggers and every_s",
            id="data and time",
        ),
        pytest.param(
            {"flags": Write(online, SYSTEM, FLAGS), "every_s": 0.0},
            r"Sample\.every_s is 0\.0",
            id="no period",
        ),
        pytest.param(
            {"flags": Write(online, SYSTEM, FLAGS), "every_s": "1"},
            r"Sample\.every_s is '1'",
            id="text for a period",
        ),
        pytest.param(
            {"read": Read(online, SYSTEM, FLAGS), "write": Write(online, SYSTEM, FLAGS)},
            "one datum with different accesses",
            id="two accesses",
        ),
        pytest.param(
            {
                "seen": View(online, PRODUCTS, SURFACE),
                "make": WriteEach(online, Entities("**"), SURFACE),
                "triggers": [View(online, PRODUCTS, SURFACE)],
            },
            r"Sample\.make writes what Sample\.seen triggers on",
            id="own trigger",
        ),
        pytest.param(
            {
                "seen": View(online, PRODUCTS, SURFACE),
                "mark": Write(online, Entities("tray/*"), FLAGS),
                "triggers": [View(online, PRODUCTS, SURFACE)],
            },
            r"Sample\.mark.*no entity that triggers through Sample\.seen.*WriteEach",
            id="patterns apart",
        ),
        pytest.param({}, "declares no lock request", id="no request"),
        pytest.param(
            {"cloud": View(online, SYSTEM, SURFACE), "shared": [View(online, SYSTEM, SURFACE)]},
            r"Sample\.shared\[0\].*only a Write or WriteEach",
            id="shared read",
        ),
        pytest.param(
            {"flags": FLAG, "every_s": 1.0, "update": runs_never},
            r"Sample\.update is an `async def`.*write asyncio\.run",
            id="async update",
        ),
        pytest.param(
            {"flags": FLAG, "every_s": 1.0, "update": runs_later},
            r"Sample\.update is a generator, for it has a `yield`: a call of it runs nothing",
            id="generator",
        ),
        pytest.param(
            {"flags": FLAG, "every_s": 1.0, "start": runs_never},
            r"Sample\.start is an `async def`.*`def start\(self\)`",
            id="async start",
        ),
        pytest.param(
            {"flags": FLAG, "every_s": 1.0, "update": lambda _self: None},
            r"Sample\.update cannot be called \(too many positional arguments\)"
            r"; write `def update\(self, lock\)`",
            id="update without lock",
        ),
        pytest.param(
            {"flags": FLAG, "every_s": 1.0, "stop": lambda _self, _reason: None},
            r"Sample\.stop cannot be called \(missing a required argument: '_reason'\)",
            id="stop with an argument",
        ),
    ],
)
def test_declaration_is_refused_when_it_cannot_work(attributes: dict[str, object], message: str):
    """Each impossible declaration is a `MisuseError` that names class and attribute."""
    with pytest.raises(MisuseError, match=message):
        declared(**attributes)
