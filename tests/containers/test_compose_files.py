"""Every compose file can be read, alone and with the others, as the page of deploy/ calls them."""

import json

import pytest

pytestmark = pytest.mark.containers

ONE = ("--file", "deploy/compose.yaml")
SECURE = (*ONE, "--file", "deploy/compose.secure.yaml")
SURVIVE = (*ONE, "--file", "deploy/compose.survive.yaml")
TWO = ("--env-file", "deploy/multihost.env", *ONE, "--file", "deploy/compose.multihost.yaml")


@pytest.mark.parametrize(
    ("options", "services"),
    [
        (ONE, 12),
        ((*ONE, "--profile", "tools"), 14),
        (SECURE, 13),
        (SURVIVE, 19),
        ((*ONE, "--profile", "workcell"), 32),
        ((*ONE, "--profile", "packing"), 31),
        ((*TWO, "--profile", "shards"), 5),
        ((*TWO, "--profile", "perception"), 7),
    ],
)
def test_a_compose_file_is_valid(engine, options, services):
    """The engine's own check has nothing to say, and nobody was left out."""
    engine.compose(*options, "config", "--quiet")

    assert len(engine.compose(*options, "config", "--services").stdout.split()) == services


def test_the_address_of_the_shards_has_to_be_named(engine):
    """Without it nothing starts somewhere else in silence."""
    options = ("--file", "deploy/compose.yaml", "--file", "deploy/compose.multihost.yaml")

    done = engine.compose(*options, "config", "--quiet", check=False)

    assert done.returncode
    assert "SHARD_ADDRESS" in done.stderr


def test_a_cell_file_that_is_missing_is_told_by_its_name(engine):
    """The engine refuses the mount; else it makes a folder, and every container reads that."""
    told = engine.compose(*ONE, "--profile", "tools", "config", "--format", "json").stdout

    for name, service in json.loads(told)["services"].items():
        mounts = {mount["target"]: mount for mount in service["volumes"]}
        mount = mounts.get("/etc/enact/cell.toml", {})
        assert name == "folder" or not mount.get("bind", {}).get("create_host_path", False)


def test_with_keys_each_container_mounts_one_key(engine):
    """Its own, read-only; only what makes keys mounts the authority, and none shares memory."""
    options = (*SECURE, "--profile", "tools", "config", "--format", "json")
    services = json.loads(engine.compose(*options).stdout)["services"]
    made = {mount["source"]: mount["target"] for mount in services.pop("keys")["volumes"]}

    for name in ("folder", "workcell-enact"):
        del services[name]
    for name, service in services.items():
        mounts = {mount["source"]: mount for mount in service["volumes"]}
        (key,) = (mount for mount in mounts.values() if mount["target"] == "/keys")
        owner = made[key["source"]].removeprefix("/hosts/")
        assert owner == {"enact": "ada"}.get(name, name.replace("shard-", "shard.")), name
        assert key["read_only"], name
        assert mounts["cell"]["read_only"], name
        assert not mounts.keys() & {"office", "shared"}, name
        assert service["depends_on"]["keys"]["condition"] == "service_completed_successfully"


def test_with_two_hosts_only_shards_reach_the_database(engine):
    """And the operator's commands; two daemons of a shard share no memory."""
    options = (*SURVIVE, "--profile", "tools", "config", "--format", "json")
    services = json.loads(engine.compose(*options).stdout)["services"]

    shards = {name for name in services if name.startswith("shard-")}
    inside = {
        name for name, service in services.items() if "database" in (service.get("networks") or {})
    }
    knowing = {
        name
        for name, service in services.items()
        if "store" in {mount["source"] for mount in service["volumes"]}
    }
    assert inside == shards | {"enact", "db-a", "db-b", "etcd", "database"}
    assert knowing == shards | {"enact", "passwords"}
    for name in shards:
        service = services[name]
        mounted = {mount["source"] for mount in service["volumes"]}
        assert service["hostname"] == name
        assert service["command"][:2] == ["shard", "run"]
        assert f"shard-{service['command'][2]}" == name.removesuffix("-b")
        assert mounted == {"cell", "store", "shared-b" if name.endswith("-b") else "shared"}
