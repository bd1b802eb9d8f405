"""`enact cell keys`: an authority, a key for each name, and what is due."""

import datetime as dt
import json
import sys

import pytest

pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")

from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID as Use

from enact_dist.cli.main import main
from enact_dist.link.zenoh.tls import KeyFiles, own_certificate
from enact_dist.operate.keys import Authority, KeyOwner, put_keys

CELL = """name = "sorting"
worlds = ["online"]
[security]
keys = "keys"
operators = ["ada"]
[shards.left]
listen = ["tls/0.0.0.0:7447", "tls/[::1]:7447"]
advertise = "tls/vision-pc:7447"
[shards.right]
listen = "tls/10.0.0.7:7448"
[actors.camera]
class = "nowhere:Camera"
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a cell.toml, in which the command runs."""
    (tmp_path / "cell.toml").write_text(CELL)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def enact(capsys):
    """Run a command line; return status, output and errors."""

    def run(*words):
        status = main(["cell", "keys", *words])
        out, err = capsys.readouterr()
        return status, out, err

    return run


def made(folder, name):
    return x509.load_pem_x509_certificate((folder / "keys" / f"{name}.crt").read_bytes())


def uses(certificate):
    return set(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)


def days(certificate):
    return (certificate.not_valid_after_utc - dt.datetime.now(dt.UTC)).total_seconds() / 86_400


def test_make_gives_each_name_a_key_with_its_use(folder, enact):
    """Shards serve at their hosts and call; others call only."""
    assert enact("init")[0] == 0
    status, out, _ = enact("make")
    assert status == 0
    assert "never" not in out
    assert {file.name for file in (folder / "keys").iterdir()} == {
        "ca.pem",
        *(
            f"{n}.{e}"
            for n in ("shard.left", "shard.right", "camera", "ada")
            for e in ("crt", "key")
        ),
    }

    left, camera = made(folder, "shard.left"), made(folder, "camera")
    hosts = left.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert {str(one.value) for one in hosts} == {"127.0.0.1", "::1", "vision-pc"}
    assert uses(left) == {Use.SERVER_AUTH, Use.CLIENT_AUTH}
    assert uses(camera) == {Use.CLIENT_AUTH}
    assert left.subject.rfc4514_string() == "CN=shard.left"
    assert 729 < days(left) < 731
    assert 364 < days(camera) < 366
    for name in ("shard.left", "shard.right", "camera", "ada"):
        assert own_certificate(KeyFiles(folder / "keys", name)).name == name


def test_authority_makes_no_further_one_and_lasts_ten_years(folder, enact):
    """Its private key lies apart, and the command says never to copy it."""
    status, out, _ = enact("init")
    assert status == 0
    assert "never copy" in out
    authority = x509.load_pem_x509_certificate((folder / "authority" / "ca.pem").read_bytes())
    constraints = authority.extensions.get_extension_for_class(x509.BasicConstraints).value
    assert (constraints.ca, constraints.path_length) == (True, 0)
    assert 3649 < days(authority) < 3651
    assert not (folder / "keys").exists()

    before = (folder / "authority" / "ca.key").read_bytes()
    status, _, err = enact("init")
    assert status == 1
    assert "has an authority already" in err
    assert (folder / "authority" / "ca.key").read_bytes() == before
    status, _, err = enact("init", "--authority", "keys")
    assert status == 2
    assert "copied to hosts" in err


def test_no_file_is_open_to_others(folder, enact):
    """Whatever the umask says."""
    enact("init")
    enact("make")
    for place in ("keys", "authority"):
        assert (folder / place).stat().st_mode & 0o777 == 0o700
        assert {file.stat().st_mode & 0o777 for file in (folder / place).iterdir()} == {0o600}


def test_make_leaves_keys_that_are_there(folder, enact):
    """Only what is missing is made; named ones alone, too."""
    enact("init", "--authority", "safe")
    assert enact("make", "ada", "--authority", "safe")[0] == 0
    before = (folder / "keys" / "ada.crt").read_bytes()
    status, out, _ = enact("make", "--authority", "safe", "--json")
    assert status == 0
    assert [one["name"] for one in json.loads(out)] == ["shard.left", "shard.right", "camera"]
    assert (folder / "keys" / "ada.crt").read_bytes() == before
    assert "each of these names has a key" in enact("make")[1]


def test_renew_replaces_what_is_due(folder, enact):
    """What ends soon, has ended, or does not fit the endpoints; a named one in any case."""
    enact("init")
    enact("make")
    authority = Authority.load(folder / "authority")
    for owner, lasts in ((KeyOwner("ada"), 20.0), (KeyOwner("shard.right", ("10.0.0.8",)), None)):
        put_keys(authority, owner, folder / "keys", *authority.issue(owner, days=lasts))
    status, out, _ = enact("ls")
    assert status == 1
    assert "ends in 20 days: renew it" in out
    assert "it is not for 10.0.0.7: renew it" in out
    before = {name: (folder / "keys" / f"{name}.key").read_bytes() for name in ("ada", "camera")}

    assert [one["name"] for one in json.loads(enact("renew", "--json")[1])] == [
        "shard.right",
        "ada",
    ]
    assert enact("ls")[0] == 0
    assert (folder / "keys" / "ada.key").read_bytes() != before["ada"]
    assert (folder / "keys" / "camera.key").read_bytes() == before["camera"]
    assert "no key is due" in enact("renew")[1]
    enact("renew", "camera")
    assert (folder / "keys" / "camera.key").read_bytes() != before["camera"]


def test_ls_names_what_is_missing_and_what_is_too_much(folder, enact):
    """So that a name that has left the cell loses its key."""
    enact("init")
    assert enact("ls")[1].count("make it") == 4
    enact("make")
    authority = Authority.load(folder / "authority")
    put_keys(authority, KeyOwner("eve"), folder / "keys", *authority.issue(KeyOwner("eve")))
    (folder / "keys" / "camera.key").chmod(0o644)
    found = {one["name"]: one for one in json.loads(enact("ls", "--json")[1])}
    assert found["eve"]["problem"] == "cell.toml has no such name: delete it"
    assert "chmod 600" in found["camera"]["problem"]
    assert found["ada"]["problem"] == ""
    assert found["ada"]["ends_s"] > found["ada"]["starts_s"]


def test_new_authority_is_accepted_beside_the_old_one(folder, enact):
    """Until all keys are made anew."""
    enact("init")
    enact("make")
    (folder / "authority").rename(folder / "before")
    enact("init")
    enact("renew", "ada")
    both = x509.load_pem_x509_certificates((folder / "keys" / "ca.pem").read_bytes())
    assert len(both) == 2
    for name in ("ada", "camera"):
        assert own_certificate(KeyFiles(folder / "keys", name)).name == name


@pytest.mark.parametrize(
    ("words", "change", "said"),
    [
        (["make"], {}, "make it once, on this host: enact cell keys init"),
        (["make", "shard.lef"], {}, "did you mean 'shard.left'?"),
        (
            ["init"],
            {'[security]\nkeys = "keys"': "[security]", "tls/": "tcp/"},
            "names no key folder",
        ),
        (["make"], {'"ada"': '"shard.eve"'}, "'shard.eve' cannot have a key"),
        (["make"], {'"ada"': '"ca"'}, "'ca' cannot have a key"),
    ],
)
def test_what_cannot_be_made_is_refused(folder, enact, words, change, said):
    """With the name or the file, and what to do."""
    text = CELL
    for old, new in change.items():
        text = text.replace(old, new)
    (folder / "cell.toml").write_text(text)
    status, out, err = enact(*words)
    assert (status, out) == (2, "")
    assert said in err


def test_missing_library_is_named_with_its_extra(folder, enact, monkeypatch):
    """Only the host that makes keys needs it."""
    monkeypatch.setitem(sys.modules, "cryptography", None)
    monkeypatch.setattr("enact_dist.extras.find_spec", lambda _: None)
    status, _, err = enact("init")
    assert status == 2
    assert "pip install -e '.[keys]'" in err
