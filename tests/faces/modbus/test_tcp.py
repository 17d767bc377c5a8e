"""Addresses that may connect, and what the kernel is told about a connection."""

from __future__ import annotations

from ipaddress import ip_network

import pytest

from gateway.faces.modbus.settings import LOOPBACK
from gateway.faces.modbus.tcp import allowed, client_name


@pytest.mark.parametrize(
    ("peer", "inside"),
    [
        ("127.0.0.1", True),
        ("127.255.0.9", True),
        ("::1", True),
        ("::ffff:127.0.0.1", True),
        ("::ffff:192.0.2.1", False),
        ("192.0.2.1", False),
        ("fe80::1%eth0", False),
        ("", False),
        ("localhost", False),
    ],
)
def test_loopback_by_default(peer: str, inside: bool) -> None:
    assert allowed(peer, LOOPBACK) is inside


@pytest.mark.parametrize(
    ("peername", "name"),
    [
        (("192.0.2.1", 40000), "192.0.2.1"),
        (("::1", 40000, 0, 0), "::1"),
        (("::ffff:192.0.2.1", 40000, 0, 0), "192.0.2.1"),
        (("fe80::1%eth0", 40000, 0, 2), "fe80::1%eth0"),
        (None, ""),
    ],
)
def test_a_client_has_one_name(peername: tuple[str, int] | None, name: str) -> None:
    assert client_name(peername) == name


def test_an_address_with_a_scope() -> None:
    assert allowed("fe80::1%eth0", (ip_network("fe80::/10"),))


def test_nobody_is_allowed_by_nothing() -> None:
    assert not allowed("127.0.0.1", ())
