"""What the doctor and the health check find about the keys of a cell."""

import json
import shutil

import pytest

pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")

import key_cells

from enact_dist.cli.main import main
from enact_dist.operate.doctor_cell import Level
from enact_dist.operate.doctor_keys import keys
from enact_dist.operate.keys import Authority, make_authority

pytestmark = pytest.mark.carrier("zenoh")


@pytest.fixture
def cell(tmp_path):
    return key_cells.KeyCell(tmp_path)


def found(cell):
    """Return what is wrong, by its subject; and check that each has a remedy."""
    findings = [one for one in keys(cell.config) if one.level is not Level.OK]
    assert all(one.remedy for one in findings)
    return {one.subject: (one.level.value, one.text) for one in findings}


def test_doctor_finds_nothing_wrong_with_good_keys(cell, capsys):
    """One line for the files, one for the own key, one for each endpoint."""
    with cell.running():
        assert found(cell) == {}
        texts = {one.subject: one.text for one in keys(cell.config)}
        assert set(texts) == {"key files", "keys", "key at left"}
        assert texts["key files"].startswith(f"3 of 3 in {cell.keys} are valid, the first")
        assert "uses the key of ada" in texts["keys"]
        assert f"{cell.shards['left']} shows shard.left, valid until" in texts["key at left"]
        main(["doctor", "--cell", str(cell.file)])
        out = capsys.readouterr().out
        assert "ok    key at left" in out
        assert "ok    shard left" in out


def test_doctor_warns_before_certificates_end(cell):
    """30 days, of the files here and of what a shard shows."""
    cell.make("shard.left", seconds=20 * 86_400 + 60)
    cell.make("ben", seconds=29 * 86_400 + 60)
    with cell.running():
        wrong = found(cell)
    assert {subject: level for subject, (level, _) in wrong.items()} == {
        "key of shard.left": "warn",
        "key of ben": "warn",
        "key at left": "warn",
    }
    assert "it ends in 20 days, on " in wrong["key at left"][1]


def test_doctor_names_files_that_cannot_be_used(cell, tmp_path):
    """Ended, too early, of another authority, open to others, for other hosts."""
    cell.make("ben", seconds=100, starts_s=-1000)
    level, text = found(cell)["key of ben"]
    assert level == "FAIL"
    assert "it ended on " in text
    assert "this host's clock says" in text
    cell.make("ben", seconds=9000, starts_s=1000)
    assert "correct the clock of this host" in found(cell)["key of ben"][1]
    make_authority("stranger", tmp_path / "stranger")
    cell.make("ben", authority=Authority.load(tmp_path / "stranger"))
    assert "unable to get local issuer certificate" in found(cell)["key of ben"][1]
    cell.make("ben")
    cell.files("ben").private_key.chmod(0o640)
    assert "chmod 600" in found(cell)["key of ben"][1]
    cell.make("ben")
    cell.make("shard.left", hosts=["10.9.9.9"])
    assert "it is not for 127.0.0.1" in found(cell)["key of shard.left"][1]


def test_doctor_finds_the_key_of_the_authority_beside_others(cell):
    """It makes keys for any name, so it must lie on one host alone."""
    shutil.copy(cell.folder / "authority" / "ca.key", cell.keys / "ca.key")
    level, text = found(cell)["authority"]
    assert level == "FAIL"
    assert "can make a key for any name" in text


def test_refused_certificates_are_named_by_doctor_and_check(cell, capsys):
    """With the reason, where a shard counts as unreachable."""
    cell.make("shard.left", hosts=["10.9.9.9"])
    with cell.running():
        assert "ip address mismatch" in found(cell)["key at left"][1]
        assert main(["doctor", "--cell", str(cell.file), "--timeout", "1"]) == 1
        out = capsys.readouterr().out
        assert "FAIL  key at left" in out
        assert "no connection comes about" in out
        words = ["shard", "check", "--cell", str(cell.file), "--timeout", "0.5"]
        assert main(words) == 3
        assert "unreachable, no answer at" in (out := capsys.readouterr().out)
        assert "ip address mismatch" in out
        main([*words, "--json"])
        (health,) = json.loads(capsys.readouterr().out)
        assert "ip address mismatch" in health["problem"]


def test_missing_keys_are_named_by_the_doctor(cell):
    """Before anything is asked over the network."""
    shutil.rmtree(cell.keys)
    level, text = found(cell)["keys"]
    assert level == "FAIL"
    assert "no certificate for 'enact'" in text


def test_cell_without_keys_has_no_findings(cell):
    """It reports nothing about keys."""
    cell.file.write_text('name = "open"\n[shards.left]\nlisten = "tcp/127.0.0.1:7447"\n')
    assert list(keys(cell.config)) == []
