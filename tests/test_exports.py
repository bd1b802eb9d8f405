"""The public surface is short, sorted, and exactly what the package promises."""

import subprocess
import sys

import pytest

import enact_dist
from enact_dist import errors

NAMES_MAX = 25


def test_public_names_are_sorted_and_few():
    """`__all__` is sorted (constants, classes, functions), each name exists, and there are at most 25."""
    assert enact_dist.__all__ == sorted(
        enact_dist.__all__, key=lambda n: (not n.isupper(), not n[0].isupper(), n)
    )
    assert len(enact_dist.__all__) <= NAMES_MAX
    for name in enact_dist.__all__:
        assert hasattr(enact_dist, name)


def test_public_names_are_defined_once():
    """Each public class and function lives in this package."""
    for name in enact_dist.__all__:
        home = getattr(getattr(enact_dist, name), "__module__", "enact_dist")
        assert home.startswith("enact_dist"), name


def test_every_error_stands_in_the_drawn_tree():
    """The tree at the top of errors.py names every class, and each has one sentence."""
    classes = {
        name: value
        for name, value in vars(errors).items()
        if isinstance(value, type) and issubclass(value, Exception)
    }
    for name, value in classes.items():
        assert name in errors.__doc__, name
        assert value.__doc__, name
        assert issubclass(value, errors.EnactError)


def test_daemon_starts_without_the_clients_half():
    """A restarted shard serves the sooner: no locks, no actors, no demo are loaded for it."""
    code = (
        "import sys, enact_dist.cli.main, enact_dist.link.daemon.daemon, enact_dist.link.store.store\n"
        "print(*{'enact_dist.access.lock', 'enact_dist.actor.actor', 'enact_dist.world.cell'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert not done.stdout.strip()


def test_unknown_name_is_an_attribute_error():
    """What the package does not have it does not make up."""
    with pytest.raises(AttributeError, match="no attribute 'Semaphore'"):
        _ = enact_dist.Semaphore
