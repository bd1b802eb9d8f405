"""That tests run over the carrier which `carriers.py` says, in every process that they start."""

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import carriers
import ports
import pytest

from enact_dist import connect

ASKING = """
import sys
from enact_dist import connect
with connect(sys.argv[1]) as cell:
    print(cell.shards()[0].carrier)
"""


def node(*marks, path="api/test_lock.py", names=("cell",), number=0):
    """Return what `ways` looks at in a test."""
    found = {mark.name: mark for mark in marks}
    return SimpleNamespace(
        get_closest_marker=found.get,
        path=Path(carriers.__file__).parent / path,
        fixturenames=names,
        nodeid=f"tests/{path}::test_{number}",
    )


def over(*ways):
    return pytest.mark.carrier(*ways).mark


@pytest.fixture
def chosen(monkeypatch):
    """Say what `ENACT_TEST_CARRIER` is to be."""
    return lambda said: monkeypatch.setenv(carriers.VARIABLE, said)


@pytest.mark.carrier("socket", "zenoh")
def test_every_process_of_a_test_takes_the_carrier_of_the_test(carrier, tmp_path):
    """Its own connections, those of programs that it starts and those of `enact`."""
    port = ports.free_port()
    file = tmp_path / "cell.toml"
    file.write_text(f'name = "way"\n[shards.s0]\nlisten = "tcp/127.0.0.1:{port}"\n')
    enact = [sys.executable, "-m", "enact_dist.cli.main", "shard"]
    with subprocess.Popen([*enact, "run", "s0", "--cell", file], stdout=subprocess.PIPE) as shard:
        try:
            assert shard.stdout.readline().startswith(b"ready")
            for target in (str(file), f"tcp/127.0.0.1:{port}"):
                with connect(target) as cell:
                    assert cell.shards()[0].carrier.split()[0] == carrier
                asked = [sys.executable, "-c", ASKING, target]
                assert subprocess.check_output(asked, text=True).split()[0] == carrier
            listed = subprocess.check_output([*enact, "ls", "--json", "--cell", file])
            assert json.loads(listed)[0]["carrier"].split()[0] == carrier
        finally:
            shard.terminate()


def test_seed_draws_about_half_each_and_the_same_again(chosen):
    """Two runs with one seed run the same tests over the same carriers."""
    for seed in range(20):
        chosen(str(seed))
        first = [carriers.ways(node(number=number)) for number in range(400)]
        assert first == [carriers.ways(node(number=number)) for number in range(400)]
        shares = Counter(first)
        assert set(shares) == {("socket",), ("zenoh",)}
        assert min(shares.values()) > 120


def test_one_carrier_may_be_asked_for_in_place_of_a_seed(chosen):
    """What a mark leaves to the run follows, and what runs over both; one that it names does not."""
    for said in carriers.BOTH:
        ways = (said,)
        chosen(said)
        assert carriers.ways(node()) == ways
        assert carriers.ways(node(over("local", "drawn"))) == ("local", *ways)
        assert carriers.ways(node(over("auto"))) == ("auto",)
        assert carriers.ways(node(over("socket", "zenoh"))) == ways
        assert carriers.ways(node(over("zenoh"))) == ("zenoh",)
    chosen("4711")
    assert carriers.ways(node(over("socket", "zenoh"))) == carriers.BOTH
    chosen("sokcet")
    with pytest.raises(ValueError, match="sokcet"):
        carriers.ways(node())


def test_tests_that_measure_times_or_reach_no_shard_take_the_usual_way():
    """Their limits were measured so; a test without a cell has none in its own process."""
    assert carriers.ways(node(pytest.mark.timing.mark)) == ("auto",)
    assert carriers.ways(node(path="core/test_cuts.py")) == ("auto",)
    assert carriers.ways(node(over("local", "zenoh"), names=("carrier",))) == ("zenoh",)


@pytest.mark.parametrize("folder", sorted(carriers.FOLDERS))
def test_folders_whose_tests_are_drawn_exist(folder):
    """A folder that was renamed would lose its second carrier unnoticed."""
    assert list((Path(carriers.__file__).parent / folder).glob("**/test_*.py"))
