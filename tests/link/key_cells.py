"""Cells with keys, made by the product's own functions, and shards of theirs in this process."""

import datetime as dt
from contextlib import contextmanager
from pathlib import Path

from ports import free_port

from enact_dist.config.read import load_config
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.link.zenoh.tls import KeyFiles, shard_keys
from enact_dist.operate.keys import Authority, KeyOwner, make_authority, owners_of, put_keys


def endpoint(host="127.0.0.1"):
    """Return a TLS endpoint at which nothing listens yet."""
    return f"tls/{host}:{free_port()}"


class KeyCell:
    """A cell.toml with keys beside it, one folder for all names.

    Args:
        folder: Of the test.
        shards: Endpoints by the names of shards; one shard `left` unless given.
        ttl_s: Of sessions.
        more: Further tables of the file.
    """

    def __init__(self, folder, shards=None, *, ttl_s=2.0, carrier="zenoh", more=""):
        self.folder = Path(folder)
        self.shards = shards or {"left": endpoint()}
        self.keys = self.folder / "keys"
        self.file = self.folder / "cell.toml"
        tables = "".join(f'[shards.{n}]\nlisten = "{e}"\n' for n, e in self.shards.items())
        self.file.write_text(
            f'name = "locked"\nworlds = ["online"]\nsession_ttl_s = {ttl_s}\ncarrier = "{carrier}"\n'
            f'[security]\nkeys = "keys"\noperators = ["ada", "ben"]\n{tables}{more}'
        )
        make_authority("locked", self.folder / "authority")
        self.authority = Authority.load(self.folder / "authority")
        for owner in owners_of(self.config):
            self.make(owner.name)

    @property
    def config(self):
        """The cell as its file says."""
        return load_config(self.file, environment={})

    def make(self, name, *, folder=None, authority=None, hosts=None, seconds=None, starts_s=0.0):
        """Make a key for a name: as it should be, unless something else is asked for."""
        known = {owner.name: owner for owner in owners_of(self.config)}
        owner = known.get(name, KeyOwner(name))
        if hosts is not None:
            owner = KeyOwner(name, tuple(hosts))
        starts = dt.datetime.now(dt.UTC) + dt.timedelta(seconds=starts_s)
        days = None if seconds is None else seconds / 86_400
        authority = authority or self.authority
        made = authority.issue(owner, days=days, starts=starts)
        known = (folder or self.keys) / "ca.pem"
        before = known.read_bytes() if known.exists() else b""
        files = put_keys(authority, owner, folder or self.keys, *made)
        known.write_bytes(before or known.read_bytes())
        return files

    def files(self, name):
        """Return the files of a name."""
        return KeyFiles(self.keys, name)

    def settings(self, shard="left", **options):
        """Return what a daemon of this cell gets."""
        config = self.config
        said = {
            "cell": config.name,
            "shard": config.shard_settings(shard),
            "listen": config.shard(shard).listen,
            "link_lease_s": config.ttl_s / 2,
            "carrier": config.carrier,
            "keys": shard_keys(config.security, shard),
            "names": config.key_holders,
            "again": lambda: self.settings(shard, **options),
        }
        return DaemonSettings(**{**said, **options})

    @contextmanager
    def running(self, shard="left", **options):
        """Run a shard in this process."""
        running = start_shard(self.settings(shard, **options))
        try:
            yield running
        finally:
            running.stop(drain_s=0.0)
