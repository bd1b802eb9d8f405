"""deploy/survive: files for the manager of a database, and the units of shards in pairs."""

import os
import re
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest
from ports import free_port

from enact_dist.cli.main import build_parser

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "deploy" / "survive"
UNIT = ROOT / "deploy" / "systemd" / "enact-shard@.service"
DROP_IN = FOLDER / "enact-shard@.service.d" / "standby.conf"
TWO_NODES = FOLDER / "two_nodes"
DATA_HOSTS = {"cell-a", "cell-b"}
HOSTS = DATA_HOSTS | {"cell-c"}


def settings_of(name):
    """Return the lines `key=value` of a file."""
    text = (FOLDER / name).read_text("utf-8")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    pairs = [re.fullmatch(r"([\w.]+) ?= ?(\S+)", line) for line in lines]
    assert None not in pairs
    return {found[1]: found[2] for found in pairs}


def patroni_of(host):
    """Return the file of Patroni as its first lines install it on a host."""
    yaml = pytest.importorskip("yaml", reason="kubernetes-validate brings PyYAML")
    return yaml.safe_load((FOLDER / "patroni.yml").read_text("utf-8").replace("HOST", host))


@pytest.mark.parametrize("host", sorted(DATA_HOSTS))
def test_patroni_confirms_a_commit_on_both_hosts_and_takes_its_times(host):
    """Its own rules for times, which it would else change by itself."""
    found = patroni_of(host)
    dcs = found["bootstrap"]["dcs"]

    assert dcs["synchronous_mode"] is True
    assert dcs["ttl"] >= 20
    assert dcs["loop_wait"] + 2 * dcs["retry_timeout"] <= dcs["ttl"]
    assert dcs["primary_start_timeout"] == 0
    assert dcs["postgresql"]["parameters"]["synchronous_commit"] == "on"
    assert found["name"] == host
    assert found["postgresql"]["connect_address"] == f"{host}:5432"
    users = {one["username"] for one in found["postgresql"]["authentication"].values()}
    assert len(users) == 3
    assert any("replication replicator" in line for line in found["postgresql"]["pg_hba"])
    assert "trust" not in str(found)


def test_etcd_and_patroni_name_the_same_three_hosts():
    """With two, none could be lost."""
    etcd = settings_of("etcd.env")
    cluster = dict(one.split("=") for one in etcd["ETCD_INITIAL_CLUSTER"].split(","))
    clients = etcd["ETCD_ADVERTISE_CLIENT_URLS"].removeprefix("http://HOST")

    assert cluster == {host: f"http://{host}:2380" for host in HOSTS}
    assert set(patroni_of("cell-a")["etcd3"]["hosts"]) == {host + clients for host in HOSTS}
    assert etcd["ETCD_INITIAL_ADVERTISE_PEER_URLS"] == "http://HOST:2380"


def test_the_monitor_finds_a_lost_host_before_clients_give_up():
    """In less than the ten seconds after which a client asks for the outcome of its commit."""
    times = {
        name.removeprefix("pgautofailover."): int(text)
        for name, text in settings_of("auto_failover.conf").items()
    }
    tries = 1 + times["health_check_max_retries"]
    found_ms = (
        times["health_check_period"]
        + tries * times["health_check_timeout"]
        + times["health_check_max_retries"] * times["health_check_retry_delay"]
    )
    assert found_ms <= times["node_considered_unhealthy_timeout"]
    assert times["node_considered_unhealthy_timeout"] + times["primary_demote_timeout"] < 10_000


def test_the_drop_in_starts_a_standby_and_keeps_the_options_of_the_unit():
    """The unit's command, and the option that lets two daemons run."""
    cleared, started = re.findall(r"^ExecStart=(.*)$", DROP_IN.read_text("utf-8"), re.MULTILINE)
    (before,) = re.findall(r"^ExecStart=(.*)$", UNIT.read_text("utf-8"), re.MULTILINE)
    _, *words = shlex.split(started.replace("%i", "left"))

    assert cleared == ""
    assert sorted(started.split()) == sorted([*before.split(), "--standby"])
    assert build_parser().parse_args(words).standby is True


@pytest.mark.parametrize("wrong", ["", "EnvironmentFile"])
def test_systemd_reads_the_drop_in_and_the_unit_of_patroni(wrong, tmp_path):
    """It complains about a misspelt key only."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze: command not found (Debian package systemd)")
    folder = tmp_path / f"{UNIT.name}.d"
    folder.mkdir()
    for source, copy in (
        (UNIT, tmp_path / UNIT.name),
        (DROP_IN, folder / DROP_IN.name),
        (FOLDER / "patroni.service", tmp_path / "patroni.service"),
    ):
        text = re.sub(r"/opt/\w+/bin/\w+", "/bin/true", source.read_text("utf-8"))
        copy.write_text(text.replace(wrong, "Misspelt") if wrong else text)
    done = subprocess.run(
        [
            "systemd-analyze",
            "verify",
            *(str(tmp_path / name) for name in ("enact-shard@left.service", "patroni.service")),
        ],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert ("Misspelt" in done.stderr) == bool(wrong)
    if not wrong:
        assert (done.returncode, done.stderr) == (0, "")


@pytest.fixture
def two_nodes():
    """Call the script, on ports and in a folder of the test; end both nodes at the end."""
    if not list(Path("/usr/lib/postgresql").glob("*/bin/initdb")):
        pytest.skip("initdb: not found (Debian package postgresql-15)")
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)  # root runs PostgreSQL as another user
    surroundings = {**os.environ, "PORT1": str(free_port()), "PORT2": str(free_port())}

    def call(verb):
        done = subprocess.run(
            [TWO_NODES, verb, "nodes"],
            cwd=folder,
            env=surroundings,
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )
        return done.returncode, done.stdout, done.stderr

    yield call
    call("stop")
    shutil.rmtree(folder)


@pytest.mark.slow
def test_two_nodes_copy_and_change_places(two_nodes):
    """The second one has what the first one had, and takes writes alone once it is promoted."""
    assert two_nodes("wave")[0] == 2
    code, address, trouble = two_nodes("start")
    assert (code, trouble) == (0, "")
    assert re.fullmatch(r"postgresql://enact@127\.0\.0\.1:\d+,127\.0\.0\.1:\d+/cell\n", address)
    assert two_nodes("status")[1] == "n1: takes writes; n2 streaming sync\nn2: copies\n"

    assert two_nodes("kill")[0] == 0
    assert two_nodes("status")[1] == "n1: down\nn2: copies\n"
    assert two_nodes("promote")[1] == "n2: takes writes, alone\n"
    assert two_nodes("promote")[0] == 1
    assert two_nodes("status")[1] == "n1: down\nn2: takes writes\n"
    url = f"{address.strip()}?target_session_attrs=read-write"
    done = subprocess.run(
        ["psql", url, "-c", "CREATE TABLE there ()"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "CREATE TABLE\n"), done.stderr

    assert two_nodes("stop")[0] == 0
    assert two_nodes("status")[1] == "n1: down\nn2: down\n"
