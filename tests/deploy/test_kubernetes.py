"""The manifests: schemas of three releases of Kubernetes, and that their parts fit each other.

No cluster runs here: what a schema cannot say, such as a name that nothing has, is compared.
"""

import copy
import re
from pathlib import Path

import pytest

from enact_dist.cli.main import build_parser
from enact_dist.config.read import load_config

yaml = pytest.importorskip("yaml", reason="kubernetes-validate brings PyYAML")
kubernetes_validate = pytest.importorskip("kubernetes_validate")

FOLDER = Path(__file__).parents[2] / "deploy" / "kubernetes"
FILES = sorted(FOLDER.glob("*.yaml"))
RELEASES = ("1.29", "1.33", "1.37")
TEXTS = {file.name: file.read_text("utf-8") for file in FILES}
OBJECTS = [one for text in TEXTS.values() for one in yaml.safe_load_all(text)]
SHARDS = [one for one in OBJECTS if one["kind"] == "StatefulSet"]


def of_kind(kind):
    return [one for one in OBJECTS if one["kind"] == kind]


def name_of(one):
    return f"{one['kind']}/{one['metadata']['name']}"


def pod_of(shard):
    return shard["spec"]["template"]["spec"]


def container_of(shard):
    (found,) = pod_of(shard)["containers"]
    return found


def command_of(shard):
    """Return what the container runs, as the command line reads it."""
    return build_parser().parse_args(container_of(shard)["args"])


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """Return the cell that the ConfigMap holds, as a shard reads it."""
    (found,) = of_kind("ConfigMap")
    file = tmp_path_factory.mktemp("cell") / "cell.toml"
    file.write_text(found["data"]["cell.toml"], "utf-8")
    return load_config(file, environment={"ENACT_STORE": "postgresql://app@db-rw:5432/app"})


@pytest.mark.parametrize("release", RELEASES)
@pytest.mark.parametrize("one", OBJECTS, ids=name_of)
def test_an_object_has_the_schema_of_kubernetes(one, release):
    """Strictly: no key that the schema does not have."""
    assert kubernetes_validate.validate(one, release, strict=True) == release


@pytest.mark.parametrize(
    ("path", "wrong"),
    [
        (("spec",), {"podManagmentPolicy": "Parallel"}),
        (("spec",), {"replicas": "two"}),
        (("spec", "template", "spec"), {"toleration": []}),
        (("spec", "template", "spec", "containers", 0, "readinessProbe"), {"periodSecond": 2}),
    ],
)
def test_a_misspelt_key_and_a_wrong_type_are_refused(path, wrong):
    """The check above bites, at every depth."""
    broken = copy.deepcopy(SHARDS[0])
    place = broken
    for key in path:
        place = place[key]
    place.update(wrong)
    with pytest.raises(kubernetes_validate.ValidationError, match=next(iter(wrong))):
        kubernetes_validate.validate(broken, RELEASES[-1], strict=True)


def test_the_other_volume_of_the_comment_is_valid():
    """Large data in a folder of the host, in place of the pod's own."""
    text, count = re.subn(r"emptyDir: .*\n( *)# (?=hostPath)", "", TEXTS["shard-left.yaml"])
    shard = next(yaml.safe_load_all(text))
    (shared,) = [one for one in pod_of(shard)["volumes"] if one["name"] == "shared"]
    assert (count, set(shared)) == (1, {"name", "hostPath"})
    assert kubernetes_validate.validate(shard, RELEASES[-1], strict=True)


def test_files_of_shards_differ_in_the_name_alone(cell):
    """So a shard more is a copy of a file."""
    names = [shard.name for shard in cell.shards]
    assert sorted(TEXTS) == ["cell.yaml", *sorted(f"shard-{name}.yaml" for name in names)]
    for name in names:
        assert TEXTS[f"shard-{name}.yaml"].replace(name, "left") == TEXTS["shard-left.yaml"]


@pytest.mark.parametrize("shard", SHARDS, ids=name_of)
def test_pods_of_a_shard_are_where_the_cell_expects_them(shard, cell):
    """Two, each reached by its own name at the port that it opens."""
    name = command_of(shard).name
    there = cell.shard(name)
    (service,) = of_kind("Service")
    (port,) = service["spec"]["ports"]
    own = shard["metadata"]["name"]
    opened = {one["name"]: one["containerPort"] for one in container_of(shard)["ports"]}

    assert shard["spec"]["replicas"] == 2
    assert there.advertise == tuple(
        f"tcp/{own}-{number}.{service['metadata']['name']}:{port['port']}" for number in (0, 1)
    )
    assert there.listen == (f"tcp/0.0.0.0:{opened[port['targetPort']]}",)
    assert opened[port["targetPort"]] == port["port"]  # a headless service translates no port
    assert shard["spec"]["serviceName"] == service["metadata"]["name"]
    assert command_of(shard).metrics == f"0.0.0.0:{opened['metrics']}"


@pytest.mark.parametrize("shard", SHARDS, ids=name_of)
def test_selectors_find_the_pods_of_a_shard_and_no_other(shard):
    """Of the set, the service, the budget and the rule that keeps pods on two hosts."""
    labels = shard["spec"]["template"]["metadata"]["labels"]
    (service,) = of_kind("Service")
    (budget,) = [
        one
        for one in of_kind("PodDisruptionBudget")
        if one["metadata"]["name"] == shard["metadata"]["name"]
    ]
    (apart,) = pod_of(shard)["affinity"]["podAntiAffinity"][
        "requiredDuringSchedulingIgnoredDuringExecution"
    ]
    for selector in (shard["spec"]["selector"], budget["spec"]["selector"], apart["labelSelector"]):
        assert selector == {"matchLabels": labels}
    assert service["spec"]["selector"].items() <= labels.items()
    assert [
        other["metadata"]["name"]
        for other in SHARDS
        if other["spec"]["template"]["metadata"]["labels"] == labels
    ] == [shard["metadata"]["name"]]


@pytest.mark.parametrize("shard", SHARDS, ids=name_of)
def test_a_container_finds_what_it_mounts_and_asks_for(shard, cell):
    """Volumes, the file of the cell, the shared folder, and ports of its probes."""
    container, pod = container_of(shard), pod_of(shard)
    mounted = {one["name"]: one["mountPath"] for one in container["volumeMounts"]}
    volumes = {one["name"]: one for one in pod["volumes"]}
    environment = {one["name"]: one for one in container["env"]}
    (config,) = of_kind("ConfigMap")

    assert mounted.keys() == volumes.keys()
    assert volumes["cell"]["configMap"]["name"] == config["metadata"]["name"]
    assert [command_of(shard).cell] == [f"{mounted['cell']}/{key}" for key in config["data"]]
    assert environment["ENACT_SHARED_FOLDER"]["value"] == mounted["shared"]
    assert "valueFrom" in environment["ENACT_STORE"]  # no password in a manifest
    assert "@" not in config["data"]["cell.toml"]
    for probe, path in (("livenessProbe", "/alive"), ("readinessProbe", "/ready")):
        assert container[probe]["httpGet"] == {"path": path, "port": "metrics"}


@pytest.mark.parametrize("shard", SHARDS, ids=name_of)
def test_a_pod_has_few_rights_and_the_times_of_a_takeover(shard):
    """As the restricted profile of Kubernetes asks, and with time for the drain."""
    pod, container = pod_of(shard), container_of(shard)
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    assert "USER 10001:10001" in (FOLDER.parent / "Dockerfile").read_text("utf-8")
    assert pod["securityContext"]["runAsUser"] == 10001
    assert pod["terminationGracePeriodSeconds"] > command_of(shard).drain_s + 5.0
    assert {one["tolerationSeconds"] for one in pod["tolerations"]} == {10}
    assert shard["spec"]["podManagementPolicy"] == "Parallel"
    assert of_kind("Service")[0]["spec"]["publishNotReadyAddresses"] is True
