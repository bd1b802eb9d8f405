"""Zenoh's names of places, as ``tcp/host:7447?option#setting``."""

from __future__ import annotations


def split_endpoint(endpoint: str) -> tuple[str, str, str]:
    """Return protocol, host and port of an endpoint; host and port are empty where it lacks them.

    Options and settings are left out; an IPv6 address keeps its brackets.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    return protocol, host, port
