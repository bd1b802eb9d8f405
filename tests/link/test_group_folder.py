"""A folder that users of one group share: they reach the socket, and no file."""

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
from test_ownership import KNOWS_ALL_BUT_THE_SECRET
from test_payload_handler import FILE, SIZE, adopted, stage

from enact_dist import Aspect, Durability, Entity, Lock, View, Write, connect
from enact_dist.config.read import load_config
from enact_dist.errors import LinkError
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.link.memory.payload_handler import PayloadHandler
from enact_dist.link.memory.shared_folder import SharedFolder, open_shared

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


ATTACKS = """
import os, sys
folder, file = sys.argv[1:3]
aims = (f"{folder}/files/{file}", f"{folder}/{file}", f"{folder}/uses-{file}")
ways = {
    "list": lambda p: os.listdir(os.path.dirname(p)),
    "read": lambda p: os.open(p, os.O_RDONLY),
    "write": lambda p: os.open(p, os.O_RDWR),
    "truncate": lambda p: os.truncate(p, 0),
    "chmod": lambda p: os.chmod(p, 0o666),
    "rename": lambda p: os.rename(p, p + "x"),
    "unlink": lambda p: os.unlink(p),
    "symlink": lambda p: os.symlink("/etc/passwd", p + "y"),
    "link": lambda p: os.link(p, os.path.dirname(folder) + "/mine"),
}
for name, way in ways.items():
    for path in aims:
        try:
            way(path)
            print(name, path)
        except (PermissionError, FileNotFoundError):
            pass
try:
    os.rename(folder, folder + "x")
    print("rename of the folder")
except PermissionError:
    pass
"""
CLIENT = """
import sys
import numpy as np
from enact_dist import Aspect, Durability, Entity, Lock, View, Write, connect
cell = connect(sys.argv[1], actor="other")
cloud = Aspect("cloud", np.ndarray, Durability.VOLATILE)
if sys.argv[2] == "write":
    with Lock(request := Write(cell.world("online"), Entity("other"), cloud)) as lock:
        lock[request] = np.arange(300_000)
else:
    request = View(world := cell.world("online"), Entity("arm"), cloud)
    print(int(world.view(request)[request].sum()))
print(cell._client.carrier.transport_of("s0"))
"""
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root may run processes of other users")


BECOMES = """
import importlib, os, pkgutil, sys
import numpy, zenoh, enact_dist.link, enact_dist.access, enact_dist.config, enact_dist.world
for part in (enact_dist.link, enact_dist.access, enact_dist.config, enact_dist.world):
    for found in pkgutil.walk_packages(part.__path__, part.__name__ + "."):
        importlib.import_module(found.name)  # the other user may not read them
os.setgroups([])
os.setgid(int(sys.argv[-1]))
os.setuid(int(sys.argv[-2]))
"""


def run_as(user, group, text, *words):
    """Return what a program of another user prints."""
    line = [sys.executable, "-c", BECOMES + text, *map(str, (*words, user, group))]
    done = subprocess.run(line, capture_output=True, text=True, timeout=60, check=False)
    assert not done.returncode, done.stderr
    return done.stdout.split("\n")[:-1]


def test_only_the_owner_enters_the_folder_of_files(folder):
    """The group reaches the nonce and the socket; payloads and pages are 0600 in 0700."""
    handler = PayloadHandler(folder, 10 * SIZE)
    stage(handler)
    draft = mode_of(folder.path / "files" / FILE)
    datum = adopted(handler)

    assert (draft, mode_of(folder.path / "files" / FILE)) == (0o600, 0o400)
    assert (mode_of(folder.path), mode_of(folder.path / "files") & 0o777) == (0o2710, 0o700)
    assert mode_of(folder.path / "nonce") == 0o440
    assert datum.size == SIZE
    opened = open_shared(folder.name, folder.nonce)
    assert opened.files not in (-1, opened.descriptor)
    opened.close()
    del datum
    assert not list((folder.path / "files").iterdir())


def test_root_of_a_group_gets_the_sticky_bit(folder, shared_root):
    """Otherwise one user of the group could put his own folder in place of a shard's."""
    assert mode_of(shared_root) & stat.S_ISVTX

    shared_root.chmod(0o2770)

    with pytest.raises(LinkError, match="sticky"):
        open_shared(folder.name, folder.nonce)


@as_root
def test_user_of_the_group_neither_reads_nor_changes_a_payload(folder, shared_root):
    """Whatever names he knows: list, read, write, truncate, chmod, rename, links."""
    os.chown(shared_root, 0, STRANGER)
    shared_root.chmod(0o3770)
    os.chown(folder.path, 0, STRANGER)
    handler = PayloadHandler(folder, 10 * SIZE)
    stage(handler)

    before = run_as(STRANGER - 1, STRANGER, ATTACKS, folder.path, FILE)
    datum = adopted(handler)
    after = run_as(STRANGER - 1, STRANGER, ATTACKS, folder.path, FILE)

    assert (before, after) == ([], [])
    assert bytes(datum.body) == bytes(SIZE)


@pytest.mark.carrier("socket", "zenoh")
def test_large_data_of_the_shards_user_go_through_a_folder_of_a_group_without_a_copy(
    folder, daemon, endpoint
):
    """What others may not enter, the shard's own user maps by name all the same."""
    shard = daemon(endpoint)
    with connect(endpoint) as writer, connect(endpoint) as reader:
        cloud = Aspect("cloud", np.ndarray, Durability.VOLATILE)
        with Lock(request := Write(writer.world("online"), Entity("arm"), cloud)) as lock:
            lock[request] = np.arange(SIZE)
        request = View(online := reader.world("online"), Entity("arm"), cloud)
        assert online.view(request)[request].sum() == sum(range(SIZE))
        assert "payload_fallbacks" not in writer.statistics()
        assert "maps_failed" not in reader.statistics()

    assert shard.host.payloads.figures()["payloads_adopted"] == 1
    assert mode_of(shard._shared.path) == 0o2710


OTHER_USER = """
import importlib, os, pkgutil, sys
import numpy as np
import enact_dist.config, enact_dist.core, enact_dist.link, enact_dist.wire
from enact_dist import Aspect, Durability, Entity, Lock, View, Write, connect
from enact_dist.errors import PermissionDeniedError

for package in (enact_dist.config, enact_dist.core, enact_dist.link, enact_dist.wire):
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
        print(error.right, cell.statistics().get("maps_failed", 0))
    folder = os.path.join(os.environ["ENACT_SHARED_FOLDER"], sys.argv[2], "files")
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
                for more, write in enumerate(writes):  # of two lengths: no file is made ahead
                    lock[write] = np.full(100_000 + more, 1)
            assert "payload_fallbacks" not in ada.statistics()
            payloads = [one.name for one in (shard._shared.path / "files").glob("*-*")]
            files = [one for one in payloads if not one.startswith("uses-")]
            words = [sys.executable, "-c", OTHER_USER, endpoint, shard._shared.name, *files]
            told = subprocess.run(words, capture_output=True, text=True, check=False)
            assert told.returncode == 0, told.stderr
            assert told.stdout.split() == ["read", "0", *["PermissionError"] * 2 * len(files)]
            assert len(files) == 2
            view = View(online := ada.world("online"), Entity("open/arm"), cloud)
            assert online.view(view)[view].sum() == 300_000
        assert {mode_of(shard._shared.path / "files" / one) for one in files} == {0o400}
    finally:
        shard.stop(drain_s=0.0)
        shutil.rmtree(root)


@pytest.fixture
def group_root(shared_root):
    """The root of shared folders, which the group of two further users may enter."""
    os.chown(shared_root, 0, STRANGER)
    shared_root.chmod(0o3770)
    for above in shared_root.parents:
        if above.stat().st_uid == 0 and not above.stat().st_mode & 0o001:
            pytest.skip(f"other users may not enter {above}")
    return shared_root


@as_root
@pytest.mark.carrier("socket")
@pytest.mark.usefixtures("folder", "group_root")
def test_user_of_the_group_neither_ends_nor_bars_a_session(daemon, endpoint):
    """It may connect, and knows the id and the name of each session: from listings."""
    shard = daemon(endpoint)
    with connect(endpoint, actor="victim") as cell:
        count = Write(cell.world("online"), Entity("cup"), Aspect("count", int))
        with Lock(count) as lock:
            session = cell.actors()[0].session
            words = (shard._shared.path / "socket", session, shard.host.owner_of(session))
            told = run_as(STRANGER - 1, STRANGER, KNOWS_ALL_BUT_THE_SECRET, *words)
            lock[count] = 1
        assert cell._client.carrier.transport_of("s0") == "socket"
    said = f"of user {STRANGER - 1} does not know the secret of session {session[:8]}"
    assert [said in line for line in told] == [True, True]
    assert shard.host.figures().get("sessions_died", 0) == 0


@as_root
@pytest.mark.carrier("socket")
@pytest.mark.usefixtures("folder", "group_root")
def test_large_data_of_other_users_travel_over_the_socket(daemon, endpoint):
    """They get copies, and no file: a reader and a writer of two further users."""
    shard = daemon(endpoint)
    cloud = Aspect("cloud", np.ndarray, Durability.VOLATILE)
    with connect(endpoint) as cell:
        with Lock(request := Write(cell.world("online"), Entity("arm"), cloud)) as lock:
            lock[request] = np.arange(SIZE)
        told = run_as(STRANGER - 1, STRANGER, CLIENT, endpoint, "read")
        wrote = run_as(STRANGER - 2, STRANGER, CLIENT, endpoint, "write")
        request = View(online := cell.world("online"), Entity("other"), cloud)
        assert online.view(request)[request].sum() == sum(range(300_000))

    assert told == [str(sum(range(SIZE))), "socket"]
    assert wrote == ["socket"]
    assert shard.host.payloads.figures()["payloads_adopted"] == 2
