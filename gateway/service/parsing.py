"""Texts of the configuration as what they stand for: addresses, ranges, OIDs. ValueError for what is none."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass

MORNINGSTAR_ROOT = (1, 3, 6, 1, 4, 1, 33333)
DOCUMENTATION_ROOT = (1, 3, 6, 1, 4, 1, 32473)

HTTP_LISTEN = "127.0.0.1:9850"
"""Where the HTTP face is unless the configuration says otherwise."""

_ANY = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104 - where it listens on all, it is asked on loopback


@dataclass(frozen=True, slots=True)
class Address:
    """An IP address and a port to listen on; port 0 takes any free one."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach it."""
        return ipaddress.ip_address(self.host).is_loopback

    @property
    def reached_at(self) -> str:
        """The host by which this machine reaches it."""
        return _ANY.get(self.host, self.host)


def parse_listen(text: str) -> Address:
    """The address of `127.0.0.1:1502` or `[::1]:1502`; ValueError for anything else, names included."""
    host, colon, port = text.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        ip: ipaddress.IPv4Address | ipaddress.IPv6Address = ipaddress.IPv6Address(host[1:-1])
    else:
        ip = ipaddress.IPv4Address(host)
    if not colon or not re.fullmatch(r"[0-9]{1,5}", port) or int(port) > 65535:
        raise ValueError("no port")
    return Address(str(ip), int(port))


def parse_range(text: str) -> tuple[int, int]:
    """First and last address of `0xE000-0xE005` or `0x0001`; ValueError for anything else."""
    found = re.fullmatch(r"0x([0-9A-Fa-f]{1,4})(?:-0x([0-9A-Fa-f]{1,4}))?", text)
    if found is None:
        raise ValueError("no range of addresses")
    first = int(found[1], 16)
    last = first if found[2] is None else int(found[2], 16)
    if last < first:
        raise ValueError("the last address is before the first")
    return first, last


def parse_oid(text: str) -> tuple[int, ...]:
    """The numbers of a dotted OID; ValueError otherwise."""
    if not re.fullmatch(r"[0-2](\.(0|[1-9][0-9]{0,9})){1,127}", text):
        raise ValueError("not an OID")
    oid = tuple(int(part) for part in text.split("."))
    if max(oid) > 0xFFFF_FFFF:
        raise ValueError("a number is above 4294967295")
    return oid


def parse_root(text: str) -> tuple[int, ...]:
    """The numbers of a dotted OID below 1.3.6.1.4.1; ValueError otherwise."""
    if not re.fullmatch(r"1\.3\.6\.1\.4\.1(\.(0|[1-9][0-9]{0,9})){1,20}", text):
        raise ValueError("not an OID below 1.3.6.1.4.1")
    root = tuple(int(part) for part in text.split("."))
    if max(root) > 0xFFFF_FFFF:
        raise ValueError("a number is above 4294967295")
    if root[:7] == MORNINGSTAR_ROOT:
        raise ValueError("33333 belongs to Morningstar")
    return root
