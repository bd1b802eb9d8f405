"""The doctor: each check, good and bad, with its remedy."""

import socket
from dataclasses import replace

import pytest

from enact_dist import doctor
from enact_dist.cell_info import ShardInfo
from enact_dist.doctor import Level


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


def test_data_folder_that_does_not_exist_yet_is_judged_by_its_parent(tmp_path):
    """A shard makes its own folder; what counts is whether it can."""
    found = doctor.data_folder("left", tmp_path / "data" / "left")

    assert found.level is Level.OK
    assert "GB free" in found.text


def test_data_folder_behind_a_file_fails(tmp_path):
    """Where a file stands in the way, the remedy makes the folder."""
    (tmp_path / "data").write_text("", encoding="utf-8")

    found = doctor.data_folder("left", tmp_path / "data" / "left")

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
    """A refused connection, an unknown host and a stranger are three different remedies."""
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        port = stranger.getsockname()[1]
        assert doctor.knock(f"tcp/127.0.0.1:{port}")[0].startswith("something listens")
    assert doctor.knock(f"tcp/127.0.0.1:{port}")[0] == f"nothing listens at port {port}"
    assert (
        doctor.knock("tcp/no-such-host.invalid:7447")[0]
        == "nobody knows the host no-such-host.invalid"
    )


def test_doctor_reports_each_shard_of_a_running_cell(enact, cell_file):
    """All is well: status 0, and a line for each shard and its clock."""
    result = enact("doctor", "--cell", cell_file, "--json")

    levels = {finding["subject"]: finding["level"] for finding in result.json}
    assert result.status == 0
    assert {"python", "zenoh", "cell.toml", "disk of left", "shard right", "clock of right"} <= set(
        levels
    )
    assert levels["shard left"] in {"ok", "warn"}


@pytest.mark.carrier("auto")
def test_way_to_a_shard_is_found_out_before_it_is_told(enact, cell_file, monkeypatch):
    """Both shards offer a socket; a cell that is joined has met one of them only."""
    monkeypatch.setattr("enact_dist.link.socket_line.CONNECT_S", 30.0)
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
