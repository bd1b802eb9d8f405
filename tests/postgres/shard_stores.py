"""Shards of one cell in a database, opened as a daemon opens them."""

import itertools
import os
import threading
from contextlib import ExitStack
from dataclasses import replace

from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.core.protocol.records import Persist, SlotRecord
from enact_dist.link.postgres.address import StoreAddress
from enact_dist.link.postgres.opening import open_database
from enact_dist.link.postgres.standby import wait_free
from enact_dist.terms import Durability

CELL = "tested"
_numbers = itertools.count()


def address_of(url, shard="", *, lease_s=2.0):
    """Return the place of a shard, of a new one unless it is named."""
    return StoreAddress(url, CELL, shard or f"n{os.getpid()}-{next(_numbers)}", lease_s)


def take(address, *, unix_s=1, patient=False, rows=None):
    """Wait until a shard is free, and take it over; return the store, its content and medium.

    `rows` were read ahead.
    """
    free = wait_free(address, stopped=threading.Event(), patient=patient, note=lambda _: None)
    free = replace(free, rows=rows or free.rows)
    store, recovered = open_database(free, unix_s=unix_s)
    return store, recovered, store.holding


class Stores(ExitStack):
    """Stores that end with the test."""

    def open(self, address, *, unix_s=1, patient=False):
        """Return a store, what it holds, and what holds it."""
        opened = take(address, unix_s=unix_s, patient=patient)
        self.callback(opened[0].close)
        return opened


def state(version, entity="a", *, body=b"", durability=Durability.DURABLE):
    """Return what stores one version of a slot."""
    datum = Datum(b"e", body or version.to_bytes(8, "little"), len(body) or 8)
    record = SlotRecord(Slot("online", entity, "pose"), version, version, datum, "")
    return Persist(1, (record,), durability)


def versions(recovered):
    """Return the version of each entity."""
    return {record.slot.entity: record.version for record in recovered.slots}
