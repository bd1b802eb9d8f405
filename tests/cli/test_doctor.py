"""The doctor: each check, good and bad, with its remedy."""

import os
import socket
import time
from dataclasses import replace

import pytest

from enact_dist.config.read import load_config
from enact_dist.core.protocol.messages import AspectEntry, Welcome
from enact_dist.core.state.clock import unkept_epoch
from enact_dist.operate import doctor
from enact_dist.operate.doctor_cell import Level, data_folder, differences
from enact_dist.world.listings import ShardInfo


def test_python_older_than_3_11_fails():
    """An old Python is named with what to install."""
    assert doctor.python_version((3, 11, 2)).level is Level.OK
    old = doctor.python_version((3, 10, 9))
    assert (old.level, old.text) == (Level.FAIL, "3.10.9 is older than 3.11")


def test_missing_library_is_named_with_its_debian_package():
    """Only what cannot be loaded is missing, and its package is known."""
    wanted = {"libc.so.6": "libc6", "libnowhere.so.9": "libnowhere9"}

    assert doctor.missing_libraries(wanted) == {"libnowhere.so.9": "libnowhere9"}


def test_library_table_names_the_packages_of_open3d():
    """The table that the remedy is made from."""
    assert doctor.LIBRARIES["libusb-1.0.so.0"] == "libusb-1.0-0"
    assert doctor.LIBRARIES["libGL.so.1"] == "libgl1"


def test_shared_memory_that_is_missing_is_a_warning(tmp_path):
    """Without the folder everything still works, slower."""
    found = doctor.shared_memory(tmp_path / "shm")

    assert found.level is Level.WARN
    assert "mount a tmpfs" in found.remedy


def test_doctor_looks_at_the_shared_folder_that_the_environment_names(enact, tmp_path, monkeypatch):
    """Not at the default that nobody uses; where it will be made, if it is not there yet."""
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path / "not" / "yet"))
    assert f"ok    shared memory: {tmp_path}: " in enact("doctor").out

    (tmp_path / "file").write_text("", encoding="utf-8")
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path / "file"))
    assert f"warn  shared memory: {tmp_path}/file is no folder" in enact("doctor").out

    monkeypatch.setattr(os, "access", lambda *_: False)
    found = doctor.shared_memory(tmp_path, named=True)
    assert "another in ENACT_SHARED_FOLDER" in found.remedy


def test_data_folder_that_does_not_exist_yet_is_judged_by_its_parent(tmp_path):
    """A shard makes its own folder; what counts is whether it can."""
    found = data_folder("left", tmp_path / "data" / "left")

    assert found.level is Level.OK
    assert "GB free" in found.text


def test_data_folder_behind_a_file_fails(tmp_path):
    """Where a file stands in the way, the remedy makes the folder."""
    (tmp_path / "data").write_text("", encoding="utf-8")

    found = data_folder("left", tmp_path / "data" / "left")

    assert found.level is Level.FAIL
    assert str(tmp_path / "data" / "left") in found.remedy


@pytest.mark.parametrize(
    ("ahead_s", "level", "text"),
    [
        (0.0003, Level.OK, "0.3 ms ahead of this host"),
        (-0.3, Level.WARN, "300.0 ms behind this host"),
        (1.5, Level.FAIL, "1500.0 ms ahead of this host; commits would be refused"),
    ],
)
def test_clock_skew_is_judged_by_what_a_shard_refuses(ahead_s, level, text):
    """More than a second is refused by the shards; a tenth of that is worth a warning."""
    found = doctor.clock_skew("clock", ahead_s)

    assert (found.level, found.text) == (level, text)


def test_disk_that_stood_still_is_a_warning():
    """The shard counts it; one that never did says nothing of its disk."""
    shard = ShardInfo("s0", "tcp/host:1", reachable=True, counters={"disk_stalls": 3})

    found = [one for one in doctor._shard(shard) if one.subject == "disk of s0"]
    quiet = [one.subject for one in doctor._shard(replace(shard, counters={}))]

    assert [one.level for one in found] == [Level.WARN]
    assert "3 times" in found[0].text
    assert "disk of s0" not in quiet


def test_knock_tells_why_nobody_answers():
    """A refused connection, an unknown host and a stranger are three different remedies.

    A shard that is stopped takes connections, too: it was told as another program.
    """
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        port = stranger.getsockname()[1]
        why, remedy = doctor.knock(f"tcp/127.0.0.1:{port}")
        assert why.endswith("another program, or a shard that is stopped or hangs")
        assert remedy.endswith("restart a shard that hangs")
    assert doctor.knock(f"tcp/127.0.0.1:{port}")[0] == f"nothing listens at port {port}"
    assert (
        doctor.knock("tcp/no-such-host.invalid:7447")[0]
        == "the host name no-such-host.invalid is unknown"
    )


def test_each_endpoint_of_a_silent_shard_is_knocked_at():
    """Two hosts may serve it: each has a reason of its own, and no remedy is told twice."""
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        port = stranger.getsockname()[1]
        places = f"tcp/127.0.0.1:{port}", "tcp/127.0.0.1:9", "tcp/127.0.0.1:7"
        silent = ShardInfo("s0", ", ".join(places), reachable=False)
        (found,) = doctor._shard(silent)

    assert (found.level, found.subject) == (Level.FAIL, "shard s0")
    assert f"at {places[0]}, something listens: another program" in found.text
    assert f"at {places[1]}, nothing listens at port 9" in found.text
    assert f"at {places[2]}, nothing listens at port 7" in found.text
    assert found.remedy.count("start the shard") == 1
    assert f"see what runs at port {port}" in found.remedy


def test_doctor_reports_each_shard_of_a_running_cell(enact, cell_file):
    """All is well: status 0, and a line for each shard and its clock."""
    result = enact("doctor", "--cell", cell_file, "--json")

    levels = {finding["subject"]: finding["level"] for finding in result.json}
    assert result.status == 0
    assert {"python", "zenoh", "cell.toml", "disk of left", "shard right", "clock of right"} <= set(
        levels
    )
    assert levels["shard left"] in {"ok", "warn"}


def test_disk_of_a_shard_that_runs_elsewhere_is_none_of_this_machine(
    enact, cell_file, tmp_path, monkeypatch
):
    """A container of tools has no folder of the shards, and is not told to make one."""
    (tmp_path / "file").write_text("", encoding="utf-8")
    monkeypatch.setenv("ENACT_DATA_FOLDER", str(tmp_path / "file"))

    result = enact("doctor", "--cell", cell_file, "--json")

    ((level, text),) = told(result.json, "disk of left")
    assert (result.status, level) == (0, "ok")
    assert text == (
        f"{tmp_path}/file/left is on another machine or another user's, where the shard runs"
    )


def told(findings, subject):
    return [(found["level"], found["text"]) for found in findings if found["subject"] == subject]


def test_cell_that_runs_by_its_file_differs_in_nothing(enact, cell_file):
    """What the shards say of themselves is what the file says."""
    findings = enact("doctor", "--cell", cell_file, "--json").json

    assert told(findings, "placement") == told(findings, "cell.toml and cell") == []
    assert not [found for found in findings if found["text"].startswith("the running shard")]


@pytest.mark.parametrize(
    ("old", "new", "subject", "text"),
    [
        (
            "[shards.left]",
            '[[pins]]\nentities = "tray/**"\nshard = "right"\n[shards.left]',
            "cell.toml and cell",
            "the file has tray/** pinned to right; the running cell has no pins",
        ),
        (
            "[shards.left]",
            '[shards.middle]\nlisten = "tcp/127.0.0.1:9"\n[shards.left]',
            "cell.toml and cell",
            "the file has shards left, middle, right; the running cell has left, right",
        ),
        (
            'data_folder = "data"',
            "",
            "disk of left",
            (
                "the running shard keeps its data in a folder, this file names none: started with it,"
                " the shard would begin empty"
            ),
        ),
        (
            '"training"]',
            '"training", "planning"]',
            "cell.toml and right",
            "the shard has no world context planning of this file",
        ),
    ],
    ids=["pins", "shards", "folder", "worlds"],
)
def test_file_that_the_cell_does_not_run_by_is_told(
    enact, cell_file, tmp_path, old, new, subject, text
):
    """What differs, and what to do; nothing that is not so of the shards that run."""
    file = tmp_path / "other.toml"
    assert old in cell_file.read_text(encoding="utf-8")
    file.write_text(cell_file.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")

    result = enact("doctor", "--cell", file, "--json")

    assert (result.status, told(result.json, subject)) == (0, [("warn", text)])
    assert not [found for found in result.json if "everything is lost" in found["text"]]
    assert all(found["remedy"] for found in result.json if found["subject"] == subject)


def welcome(name, config, aspects=()):
    return Welcome(name, 1, True, 1, 1, 0, config.placement_map(), ("online",), aspects)


def test_shards_that_were_started_with_different_files_fail(tmp_path):
    """Told without a file, too: each refuses what the other sends."""
    texts = ["", '[[pins]]\nentities = "tray/**"\nshard = "a"\n']
    welcomes = {}
    for name, text in zip("ab", texts, strict=True):
        file = tmp_path / f"{name}.toml"
        shards = "".join(f'[shards.{one}]\nlisten = "tcp/127.0.0.1:{ord(one)}"\n' for one in "ab")
        file.write_text(f'name = "c"\n{text}{shards}', encoding="utf-8")
        welcomes[name] = welcome(name, load_config(file))

    (found,) = differences(None, [], welcomes)

    assert found.level is Level.FAIL
    assert found.text == (
        "a and b were started with different shards or pins: a has shards a, b and no pins;"
        " b has shards a, b and tray/** pinned to a"
    )
    assert found.remedy == "start all shards with the same cell.toml"


def test_shard_without_the_folder_of_its_file_and_another_durability_are_told(tmp_path):
    """What is lost when it stops, and what an aspect's commits survive."""
    file = tmp_path / "cell.toml"
    file.write_text(
        'name = "c"\nworlds = ["online"]\ndata_folder = "data"\n[shards.a]\n'
        'listen = "tcp/127.0.0.1:9"\n[aspects.pose]\ndurability = "os"\n',
        encoding="utf-8",
    )
    config = load_config(file)
    shard = ShardInfo("a", "tcp/h:1", reachable=True, epoch=unkept_epoch(time.time_ns()))
    durable = AspectEntry("pose", "int", "durable")

    folder, aspect = differences(config, [shard], {"a": welcome("a", config, (durable,))})

    assert folder.text.startswith(
        f"the running shard has no folder, though this file names {tmp_path}"
    )
    assert aspect.text == "aspect pose is durable there and os in this file"


@pytest.mark.carrier("auto")
def test_way_to_a_shard_is_found_out_before_it_is_told(enact, cell_file, monkeypatch):
    """Both shards offer a socket; a cell that is joined has met one of them only."""
    monkeypatch.setattr("enact_dist.link.socket.line.CONNECT_S", 30.0)
    findings = enact("doctor", "--cell", cell_file, "--json").json
    shards = enact("shard", "ls", "--cell", cell_file, "--json").json

    told = [
        found["text"] for found in findings if found["subject"] in {"shard left", "shard right"}
    ]
    assert len(told) == 2
    assert all(text.partition(" over ")[2].startswith("socket") for text in told)
    assert [shard["carrier"] for shard in shards] == ["socket", "socket"]


def test_doctor_fails_where_a_shard_is_down(enact, write_cell):
    """A cell that does not run: status 1, each shard with its endpoint and what to start."""
    file = write_cell()

    result = enact("doctor", "--cell", file, "--timeout", "0.5")

    assert result.status == 1
    assert "FAIL  shard left: tcp/127.0.0.1:" in result.out
    assert "start the shard: enact up" in result.out


def test_doctor_checks_the_machine_without_a_cell(enact):
    """Where there is no cell.toml the machine is checked and the cell is a warning."""
    result = enact("doctor")

    assert result.status == 0
    assert "warn  cell: not checked: no cell.toml here" in result.out


@pytest.mark.parametrize(
    ("counters", "level", "said"),
    [
        ({}, None, ""),
        ({"payload_bytes_max": 100}, None, ""),
        ({"payload_bytes_max": 0}, Level.WARN, "none: its large data travel, on its own host"),
        ({"payload_bytes": 80, "payload_files": 2}, Level.OK, "2 files, 80 of 100 bytes"),
        ({"payload_bytes": 80, "payloads_refused": 3}, Level.WARN, "3 writes were refused"),
        ({"payload_fallbacks": 4}, Level.WARN, "4 large data did not fit"),
    ],
)
def test_shared_memory_of_a_shard_that_is_short_is_a_warning(counters, level, said):
    """What was refused at the cap, or did not fit into the folder, is told with what to do."""
    most = {"payload_bytes_max": 100} if counters else {}
    shard = ShardInfo("s0", "tcp/h:1", reachable=True, counters={**most, **counters})

    found = list(doctor.shared_data(shard))

    assert [finding.level for finding in found] == ([level] if level else [])
    assert all(said in finding.text for finding in found)
