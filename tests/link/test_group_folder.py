"""A folder that users of one group share: who may write a payload, and who may not find it."""

import os
import shutil
import stat
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ports import free_endpoint
from test_payload_desk import FILE, SIZE, adopted, names, stage

from enact_dist import Aspect, Durability, Entity, Lock, View, Write, connect
from enact_dist.config.read import load_config
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.link.memory.payload_desk import PayloadDesk
from enact_dist.link.memory.shared_folder import SharedFolder

STRANGER = 65534


@pytest.fixture
def folder(shared_root, monkeypatch):
    """A shard's folder in a root that a group may write to."""
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(shared_root))
    shared_root.chmod(0o2770)
    made = SharedFolder("cell", "s0")
    yield made
    made.close()


def mode_of(path):
    return stat.S_IMODE(path.stat().st_mode)


def found(act):
    try:
        return type(act()).__name__
    except OSError as error:
        return type(error).__name__


def tried(folder, *files):
    """Return what another user of the group gets of a folder and of files by their names."""
    if os.geteuid() == 0:
        os.seteuid(STRANGER)
    try:
        told = [found(lambda: list(folder.path.iterdir()))]
        for file in files:
            for access in (os.O_RDWR, os.O_RDONLY):
                told.append(found(lambda: os.close(os.open(folder.path / file, access))))  # noqa: B023
    finally:
        if os.geteuid() == STRANGER:
            os.seteuid(0)
    return told


def test_draft_has_a_name_that_its_client_alone_is_told(folder):
    """Who maps it before the commit could change what all read after it."""
    desk = PayloadDesk(folder, 10 * SIZE)
    told, other = stage(desk), stage(desk, "d4-1")

    assert len({told.draft, other.draft, FILE}) == 3
    assert names(folder) == sorted((told.draft, other.draft))
    assert mode_of(folder.path / told.draft) == 0o660
    assert mode_of(folder.path) == 0o2710
    (folder.path / told.draft).write_bytes(b"x" * SIZE)

    datum = adopted(desk)

    assert (datum.file, bytes(datum.body)) == (FILE, b"x" * SIZE)
    assert names(folder) == sorted((FILE, other.draft))
    assert mode_of(folder.path / FILE) == 0o440
    stage(desk, "d4-1", total=0)
    del datum
    assert names(folder) == []


def test_another_user_of_the_group_finds_no_draft_and_writes_no_payload(folder):
    """He may know sessions and their numbers: these stand in listings."""
    desk = PayloadDesk(folder, 10 * SIZE)
    told = stage(desk)
    (folder.path / told.draft).write_bytes(b"x" * SIZE)
    before = tried(folder, FILE)
    datum = adopted(desk)
    after = tried(folder, FILE, told.draft)

    if os.geteuid() == 0:  # else the other user is this one
        assert before == ["PermissionError", "FileNotFoundError", "FileNotFoundError"]
        assert after[:3] == ["PermissionError", "PermissionError", "NoneType"]
    assert before[-2:] == ["FileNotFoundError", "FileNotFoundError"]
    assert after[-2:] == ["FileNotFoundError", "FileNotFoundError"]
    assert datum.size == SIZE


@pytest.mark.carrier("socket", "zenoh")
def test_large_data_go_through_a_folder_of_a_group_without_a_copy(folder, daemon, endpoint):
    """What may not be listed is written and mapped by its name all the same."""
    shard = daemon(endpoint)
    with connect(endpoint) as writer, connect(endpoint) as reader:
        cloud = Aspect("cloud", np.ndarray, Durability.VOLATILE)
        with Lock(request := Write(writer.world("online"), Entity("arm"), cloud)) as lock:
            lock[request] = np.arange(SIZE)
        request = View(online := reader.world("online"), Entity("arm"), cloud)
        assert online.view(request)[request].sum() == sum(range(SIZE))
        assert "payload_fallbacks" not in writer.statistics()
        assert "maps_failed" not in reader.statistics()

    assert shard.host._payloads.figures()["payloads_adopted"] == 1
    assert mode_of(shard._shared.path) == 0o2710


OTHER_USER = """
import importlib, os, pkgutil, sys
import numpy as np
import enact_dist.core, enact_dist.link, enact_dist.wire
from enact_dist import Aspect, Durability, Entity, Lock, View, Write, connect
from enact_dist.errors import PermissionDeniedError

for package in (enact_dist.core, enact_dist.link, enact_dist.wire):
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        importlib.import_module(found.name)
os.setgroups([4242]), os.setgid(4243), os.setuid(4243)
cloud = Aspect("cloud", np.ndarray, Durability.VOLATILE)
with connect(sys.argv[1], actor="writer") as cell:
    world = cell.world("online")
    for value in (2, 3):
        with Lock(write := Write(world, Entity("open/arm"), cloud)) as lock:
            assert lock[write][0] == value - 1
            lock[write] = np.full(100_000, value)
    view = View(world, Entity("secret/arm"), cloud)
    try:
        world.view(view)
    except PermissionDeniedError as error:
        print(error.right, cell.statistics()["maps_failed"])
    folder = os.path.join(os.environ["ENACT_SHARED_FOLDER"], sys.argv[2])
    for file in sys.argv[3:]:
        for access in (os.O_RDWR, os.O_RDONLY):
            try:
                os.open(os.path.join(folder, file), access)
            except OSError as error:
                print(type(error).__name__)
"""


@pytest.mark.carrier("auto")
def test_users_of_a_cell_with_rights_get_copies(tmp_path, monkeypatch):
    """Files have no rights per datum: who knows the name of one could read what he may not."""
    if os.geteuid() != 0:
        pytest.skip("becomes another user")
    root = Path(tempfile.mkdtemp(prefix="enact-test-"))
    os.chown(root, -1, 4242)
    root.chmod(0o2770)
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(root))
    file, endpoint = tmp_path / "cell.toml", free_endpoint()
    file.write_text(
        f'name = "guarded"\nworlds = ["online"]\ncarrier = "socket"\n'
        f'[shards.s]\nlisten = "{endpoint}"\n[security]\noperators = ["ada"]\n'
        '[rights]\nuids = { 4243 = "writer" }\n'
        '[[rights.allow]]\nwho = "writer"\nread = "online:open/**"\nwrite = "online:open/**"\n'
    )
    config = load_config(file, environment={})
    settings = DaemonSettings(config.name, config.shard_settings("s"), (endpoint,))
    shard = start_shard(replace(settings, carrier="socket"))
    try:
        with connect(file, actor="ada") as ada:
            cloud = Aspect("cloud", np.ndarray, Durability.VOLATILE)
            writes = [
                Write(ada.world("online"), Entity(name), cloud)
                for name in ("open/arm", "secret/arm")
            ]
            with Lock(*writes) as lock:
                for write in writes:
                    lock[write] = np.full(100_000, 1)
            assert "payload_fallbacks" not in ada.statistics()
            payloads = [one.name for one in shard._shared.path.glob("*-*")]
            files = [one for one in payloads if not one.startswith("uses-")]
            words = [sys.executable, "-c", OTHER_USER, endpoint, shard._shared.name, *files]
            told = subprocess.run(words, capture_output=True, text=True, check=False)
            assert told.returncode == 0, told.stderr
            assert told.stdout.split() == ["read", "1", *["PermissionError"] * 2 * len(files)]
            assert len(files) == 2
            view = View(online := ada.world("online"), Entity("open/arm"), cloud)
            assert online.view(view)[view].sum() == 300_000
        assert {mode_of(shard._shared.path / one) for one in files} == {0o400}
    finally:
        shard.stop(drain_s=0.0)
        shutil.rmtree(root)
