"""`MODULE:CLASS` and options, as a command line or `cell.toml` writes them, made into an actor.

An option is a keyword parameter of the class's `__init__`, or an attribute that the class annotates
and gives a value; its annotation says how the text is read.  Everything wrong is a `ConfigError`
that names the parameter, the text and what was wanted.
"""

from __future__ import annotations

import importlib
import inspect
import math
import types
import typing
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.actor.actor import Actor, check_period, check_update
from enact_dist.actor.report import ARGS_MAX
from enact_dist.actor.running.doing import own_lines, place_of, raised
from enact_dist.config.table import path_of, suggestion
from enact_dist.errors import ConfigError, EnactError, MisuseError
from enact_dist.terms import Entity

if TYPE_CHECKING:
    from collections.abc import Mapping

    from enact_dist.config.types import ActorConfig

Option = int | float | bool | str | Path | None
"""An option as an actor's `__init__` gets it."""

_TRUTH: Final = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
_WANTED: Final[Mapping[object, str]] = {
    int: "a whole number",
    float: "a finite number",
    bool: "true or false",
    str: "a text",
    Path: "a path",
}


_SHOWN: Final = (int, float, str, Path, type(None))
_NONE: Final = object()


class BrokenModuleError(ConfigError):
    """A module raised at its import; its `__cause__` says what, its notes the user's own lines."""


def load_class(target: str) -> type[Actor]:
    """Return the actor class that `target` names.

    Args:
        target: ``MODULE:CLASS``, for example ``actors.palletizing.deviation:DeviationDetection``.

    Raises:
        ConfigError: Not of that form, no such module or class, or the class is no `Actor` that
            defines `update`.
        MisuseError: The class declares something that cannot work.
    """
    module_name, colon, class_name = target.partition(":")
    if not colon or not module_name or not class_name.isidentifier():
        raise ConfigError(
            f"{target!r} names no actor; write MODULE:CLASS, for example"
            " actors.palletizing.deviation:DeviationDetection"
        )
    try:
        module = importlib.import_module(module_name)
    except EnactError:
        raise  # what it declares is wrong: the error names the class and the attribute
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise ConfigError(
                f"{module_name} of actor {target!r} cannot be imported: it needs the module"
                f" {error.name}, which is not installed; the actors of this repository need"
                " pip install -e '.[actors]' in the clone of enact-dist"
            ) from error
        raise ConfigError(
            f"no module {error.name} for actor {target!r}; run from the folder that holds it, or"
            " install its package"
        ) from error
    except (Exception, SystemExit) as error:
        raise _broken(target, module_name, error) from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type) or not issubclass(found, Actor):
        actors = [
            name
            for name, value in vars(module).items()
            if isinstance(value, type) and issubclass(value, Actor) and value is not Actor
        ]
        kind = "no actor class" if found is None else f"{found!r}, which is no subclass of Actor"
        raise ConfigError(
            f"{module_name} has {kind} under the name {class_name!r}; its actors:"
            f" {', '.join(actors) or 'none'}{suggestion(class_name, actors)}"
        )
    try:
        check_update(found)
    except MisuseError as error:
        raise ConfigError(str(error)) from None
    return found


def _broken(target: str, module_name: str, error: BaseException) -> BrokenModuleError:
    """Return the error for a module that raises at its import, with the user's own lines of it."""
    text = f"{type(error).__name__}: {error}"
    if isinstance(error, SystemExit):
        text = f"it called sys.exit({error.code!r}) at {place_of(error)}"
    broken = BrokenModuleError(f"{module_name} of actor {target!r} cannot be imported: {text}")
    for line in own_lines(error):
        broken.add_note(line)
    return broken


def load_actor(target: str, options: Mapping[str, object] | None = None) -> Actor:
    """Make the actor that `target` names, its options read by the annotations of `__init__`.

    ::

        load_actor("actors.palletizing.deviation:DeviationDetection", {"tolerance_m": "0.003"})

    Args:
        target: ``MODULE:CLASS``.
        options: Parameter name → value; text is converted, numbers and truth values are checked.

    Raises:
        ConfigError: See `load_class`; an unknown, missing or unreadable option.
        MisuseError: The class declares something that cannot work.
    """
    return make_actor(load_class(target), options or {})


def configured_actor(config: ActorConfig) -> Actor:
    """Make an actor as `cell.toml` configures it, its period and its entity included.

    Raises:
        ConfigError: See `load_actor`; a period for an actor that data trigger.
        MisuseError: The class declares something that cannot work.
    """
    actor = load_actor(config.class_path, config.options)
    if config.every_s is not None:
        check_every_s(type(actor), config.every_s)
        actor.every_s = config.every_s
    if config.entity:
        actor.only_entity = Entity(config.entity)
    return actor


def check_every_s(actor_class: type[Actor], every_s: float) -> None:
    """Raise `ConfigError` unless an actor of this class can be given this period."""
    name = actor_class.__name__
    if actor_class.declaration.triggers:
        raise ConfigError(
            f"every_s = {every_s!r} for actor {name}, which is triggered by data; leave it out"
        )
    try:
        check_period(name, every_s)
    except MisuseError as error:
        raise ConfigError(str(error)) from None


def make_actor(actor_class: type[Actor], options: Mapping[str, object]) -> Actor:
    """Make an actor of a class from options.

    Raises:
        ConfigError: An unknown, missing or unreadable option, or `__init__` refused a value.
        MisuseError: `__init__` raised something else; the message says where.
    """
    arguments = read_options(actor_class, options)
    changeable = attributes_of(actor_class)
    at_start, name = inspect.signature(actor_class).parameters, actor_class.__name__
    try:
        chosen = actor_class.of_options(arguments)
        actor = chosen(**{key: arguments[key] for key in arguments if key in at_start})
        for key in arguments.keys() & changeable.keys() - at_start.keys():
            setattr(actor, key, arguments[key])
    except ValueError as error:
        raise ConfigError(f"actor {name} refuses its options {dict(options)}: {error}") from error
    except SystemExit as error:
        raise ConfigError(
            f"{name}.__init__ called sys.exit({error.code!r}) at {place_of(error)}; it must return,"
            " or raise an exception"
        ) from error
    except EnactError:
        raise
    except Exception as error:
        raise MisuseError(f"{name}.__init__ failed: {raised(error)}") from error
    return actor


def attributes_of(actor_class: type[Actor]) -> dict[str, object]:
    """Return the parameters of a class that are attributes: name to annotation.

    They stand in the class, or in one between it and `Actor`, with an annotation and a value::

        class Camera(Actor):
            gain: float = 0.5
    """
    found: dict[str, object] = {}
    for one in reversed(actor_class.__mro__):
        if not issubclass(one, Actor) or one is Actor:
            continue
        for name, annotation in inspect.get_annotations(one).items():
            readable = not name.startswith("_") and not hasattr(Actor, name)
            if readable and hasattr(one, name):
                hint = _hint(one, annotation)
                if _is_option(hint):
                    found[name] = hint
    return found


def _hint(owner: type, annotation: object) -> object:
    """Return the type of an annotation, or itself if only a type checker knows its names."""
    holder = type(owner.__name__, (), {"__annotations__": {"it": annotation}})
    holder.__module__ = owner.__module__
    try:
        return typing.get_type_hints(holder, localns=dict(vars(owner)))["it"]
    except Exception:  # noqa: BLE001 (it may be any expression)
        return annotation


def shown_values(actor: Actor) -> tuple[str, ...]:
    """Return the values of an actor's parameters, as far as they are attributes: ``name=value``.

    A model or another object that a program has handed in is left out.
    """
    names = dict.fromkeys((*attributes_of(type(actor)), *inspect.signature(type(actor)).parameters))
    values = {name: vars(actor).get(name, getattr(type(actor), name, _NONE)) for name in names}
    shown = (f"{key}={one}"[:80] for key, one in values.items() if isinstance(one, _SHOWN))
    return tuple(shown)[:ARGS_MAX]


def _is_option(annotation: object) -> bool:
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(annotation) if kind is not type(None)]
        return len(kinds) == 1 and kinds[0] in _WANTED
    return annotation in _WANTED


def read_options(actor_class: type[Actor], options: Mapping[str, object]) -> dict[str, Option]:
    """Read options by the annotations of an actor class's `__init__`, and of its attributes.

    Raises:
        ConfigError: An unknown, missing or unreadable option.
    """
    parameters = {
        name: parameter
        for name, parameter in inspect.signature(actor_class).parameters.items()
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    }
    name = actor_class.__name__
    attributes = attributes_of(actor_class)
    known = dict.fromkeys((*parameters, *attributes))
    for option in options:
        if option not in known:
            raise ConfigError(
                f"actor {name} has no option {option!r}; it has"
                f" {', '.join(known) or 'none'}{suggestion(option, known)}"
            )
    missing = [
        option
        for option, parameter in parameters.items()
        if parameter.default is parameter.empty and option not in options
    ]
    if missing:
        raise ConfigError(f"actor {name} needs the option {', '.join(missing)}")
    hints = attributes | typing.get_type_hints(actor_class.__init__)
    return {
        option: read_option(f"option {option} of actor {name}", value, hints.get(option, str))
        for option, value in options.items()
    }


def read_option(where: str, value: object, annotation: object) -> Option:
    """Return `value` as the type that `annotation` asks for.

    Args:
        where: What is read, for messages.
        value: Text, or a number or truth value that is already of its type.
        annotation: `int`, `float`, `bool`, `str`, `Path`, or one of these ``| None``; the text
            ``none`` then gives None.

    Raises:
        ConfigError: The value is not of that type, or no option can be.
    """
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(annotation) if kind is not type(None)]
        if len(kinds) == 1:
            return None if value == "none" else read_option(where, value, kinds[0])
    if annotation not in _WANTED:
        raise ConfigError(
            f"{where} is annotated {annotation!r}; options are int, float, bool, str or Path,"
            " each also | None"
        )
    read = _read(value, annotation)
    if read is None:
        raise ConfigError(f"{where} is {value!r}; it must be {_WANTED[annotation]}")
    return read


def _read(value: object, kind: object) -> Option:
    if kind is bool:
        return value if isinstance(value, bool) else _TRUTH.get(str(value).lower())
    if isinstance(value, bool):
        return None
    if kind is str or kind is Path:
        if not isinstance(value, str):
            return None
        return value if kind is str else path_of(value)
    if not isinstance(value, (int, float, str)):
        return None
    try:
        if kind is int:
            return _whole(value)
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _whole(value: float | str) -> int | None:
    """Return a whole number, all its digits; 1e3 of a TOML file is one, too."""
    if isinstance(value, str):
        return int(value, 0)
    return int(value) if value == int(value) else None
