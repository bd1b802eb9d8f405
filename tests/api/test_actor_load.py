"""MODULE:CLASS and options made into actors; every mistake has its own words."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import pytest

from enact_dist.actor.actor import Actor
from enact_dist.actor.running.load import attributes_of, load_actor, make_actor, shown_values
from enact_dist.errors import ConfigError, EnactError, MisuseError
from enact_dist.terms import Aspect, Entity, World, Write

if TYPE_CHECKING:
    from library_of_types import Picture


class Camera(Actor):
    """An actor with one option of each kind."""

    image = Write(World("online"), Entity("camera"), Aspect("image", int))
    every_s = 0.1

    def __init__(
        self,
        folder: Path,
        count: int = 3,
        *,
        gain: float = 1.0,
        raw: bool = False,
        label: str = "front",
        seed: int | None = None,
    ) -> None:
        if gain < 0:
            raise ValueError(f"gain is {gain}; it must be >= 0")
        self.options = (folder, count, gain, raw, label, seed)

    def update(self, lock):
        pass


class Curve(Actor):
    """An actor with an option that no text can give."""

    image = Write(World("online"), Entity("camera"), Aspect("image", int))

    def __init__(self, points: list[float]) -> None:
        self.points = points

    def update(self, lock):
        pass


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this module be found under the name `sample_actors`."""
    monkeypatch.setitem(sys.modules, "sample_actors", sys.modules[__name__])


def test_load_converts_each_option_by_its_annotation_when_given_as_text():
    """int, float, bool, str, Path and `| None` are read from text."""
    given = {"folder": "a/b", "count": "7", "gain": "0.5", "raw": "yes", "label": "3", "seed": "9"}

    actor = load_actor("sample_actors:Camera", given)

    assert isinstance(actor, Camera)
    assert actor.options == (Path("a/b"), 7, 0.5, True, "3", 9)


def test_load_takes_typed_values_and_defaults_when_given_from_toml():
    """Numbers and truth values of a TOML file are taken as they are."""
    actor = make_actor(Camera, {"folder": "a", "gain": 2, "raw": True, "seed": "none"})

    assert isinstance(actor, Camera)
    assert actor.options == (Path("a"), 3, 2.0, True, "front", None)


@pytest.mark.parametrize(
    ("target", "options", "message"),
    [
        ("sample_actors.Camera", {}, "write MODULE:CLASS"),
        ("no_such_place.thing:Camera", {}, "no module no_such_place"),
        ("sample_actors:Camra", {}, "no actor class.*did you mean 'Camera'"),
        ("sample_actors:Path", {}, "no subclass of Actor"),
        ("sample_actors:Camera", {}, "needs the option folder"),
        ("sample_actors:Camera", {"foldr": "x"}, "no option 'foldr'.*did you mean 'folder'"),
        ("sample_actors:Camera", {"folder": "x", "count": "3.5"}, "count.*'3.5'.*whole number"),
        ("sample_actors:Camera", {"folder": "x", "count": True}, "count.*True.*whole number"),
        ("sample_actors:Camera", {"folder": "x", "gain": "nan"}, "gain.*'nan'.*finite number"),
        ("sample_actors:Camera", {"folder": "x", "raw": "maybe"}, "raw.*'maybe'.*true or false"),
        ("sample_actors:Camera", {"folder": 3}, "folder.*3.*a path"),
        ("sample_actors:Camera", {"folder": "x", "gain": "-1"}, "gain is -1.0"),
        ("sample_actors:Curve", {"points": "1,2"}, r"annotated list\[float\]"),
    ],
)
def test_load_names_what_is_wrong_when_an_actor_cannot_be_made(
    target: str, options: dict[str, str], message: str
):
    """Each mistake is a `ConfigError` with the value and the remedy."""
    with pytest.raises(ConfigError, match=message):
        load_actor(target, options)


def test_whole_number_of_a_toml_file_keeps_all_its_digits():
    """A serial number of 16 digits lies beyond what a float holds exactly."""
    serial = 2**53 + 1

    actor = make_actor(Camera, {"folder": "a", "count": serial, "seed": 1e3})

    assert isinstance(actor, Camera)
    assert (actor.options[1], actor.options[5]) == (serial, 1000)
    for wrong in (2.5, float("inf"), float("nan")):
        with pytest.raises(ConfigError, match=r"count.*must be a whole number"):
            make_actor(Camera, {"folder": "a", "count": wrong})


@pytest.mark.parametrize(
    ("raises", "kind", "message"),
    [
        (SystemExit(3), ConfigError, r"Failing.__init__ called sys.exit\(3\) at .*load.py:\d+"),
        (ConnectionError("no camera"), MisuseError, r"ConnectionError at .*load.py:\d+: no camera"),
        (TypeError("not so"), MisuseError, "Failing.__init__ failed: TypeError at .*: not so"),
    ],
)
def test_init_that_fails_is_told_with_its_place(
    raises: BaseException, kind: type[EnactError], message: str
):
    """It is the user's code, so the error says where; only wrong options are never tried again."""

    class Failing(Camera):
        def __init__(self) -> None:
            raise raises

    with pytest.raises(kind, match=message):
        make_actor(Failing, {})


def test_load_names_the_missing_library_when_a_module_needs_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A module that is there but imports what is not installed says so."""
    (tmp_path / "needs_much.py").write_text("import a_library_that_is_not_installed\n")
    monkeypatch.syspath_prepend(tmp_path)

    with pytest.raises(ConfigError, match="needs the module a_library_that_is_not_installed"):
        load_actor("needs_much:Camera")


class Typed(Actor):
    """An actor with annotations that only a type checker can read."""

    image = Write(World("online"), Entity("camera"), Aspect("image", int))
    last: Picture | None = None
    _buffer: Picture | None = None
    made: ClassVar[int] = 0
    gain: float = 0.5
    label: str | None = None

    def update(self, lock):
        pass


def test_annotations_of_names_that_only_a_type_checker_imports_hinder_nothing():
    """Such an attribute is no parameter; the others are read, changed and shown as ever."""
    actor = make_actor(Typed, {"gain": "0.7"})

    assert list(attributes_of(Typed)) == ["gain", "label"]
    assert shown_values(actor) == ("gain=0.7", "label=None")
    with pytest.raises(ConfigError, match=r"has no option 'last'; it has gain, label"):
        make_actor(Typed, {"last": "x"})


def test_report_shows_values_and_leaves_objects_out():
    """It is made each second, in a thread of its own: no code of the user's objects runs in it."""

    class Model:
        def __str__(self):
            raise RuntimeError("its text takes a second, and a lock")

    class Detector(Camera):
        def __init__(self, model=None, limit=0.5):
            self.model, self.limit = model, limit

    assert shown_values(Detector(Model())) == ("limit=0.5",)
