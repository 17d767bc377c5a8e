"""What the classes of the configuration file are made of: keys, and the types and texts of their values.

A type refuses by ValueError; the text that says what is allowed stands with the key.
"""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

MORNINGSTAR_ROOT = (1, 3, 6, 1, 4, 1, 33333)
DOCUMENTATION_ROOT = (1, 3, 6, 1, 4, 1, 32473)


@dataclass(frozen=True, slots=True)
class Key:
    """What a reader is told about a key: what is allowed, and what the key does."""

    allowed: str
    does: str
    secret: bool = False  # its value never appears in a problem text


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


def _listen(text: str) -> str:
    return str(parse_listen(text))


def _network(text: str) -> str:
    return str(ipaddress.ip_network(text))


def _range(text: str) -> str:
    parse_range(text)
    return text


Name = Annotated[str, Field(pattern=r"^[^\s\x00-\x1f\x7f]([^\x00-\x1f\x7f]{0,62}[^\s\x00-\x1f\x7f])?$")]
Text = Annotated[str, Field(pattern=r"^[ -~]{0,255}$")]
Listen = Annotated[str, AfterValidator(_listen)]
Network = Annotated[str, AfterValidator(_network)]
Seconds = Annotated[float, Field(allow_inf_nan=False)]
Hours = Annotated[float, Field(allow_inf_nan=False)]
Rate = Annotated[float, Field(allow_inf_nan=False)]
Listens = Annotated[tuple[Listen, ...], Field(strict=False)]
AbsolutePath = Annotated[str, Field(pattern=r"^(/[^\x00-\x1f]*)?$")]
Networks = Annotated[tuple[Network, ...], Field(strict=False)]
Ranges = Annotated[tuple[Annotated[str, AfterValidator(_range)], ...], Field(strict=False)]

A_NAME = "1 to 64 printable characters, no blank at either end"
A_TEXT = "up to 255 printable ASCII characters"
LISTENS = 'a list of "IPv4:port" or "[IPv6]:port" such as "127.0.0.1:1502"; [] turns the face off'
NETWORKS = 'a list of addresses or networks such as "127.0.0.0/8", "10.1.2.3" or "::1/128"'
A_FILE = 'the absolute path of a file, or "" for none'
RANGES = 'a list of PDU addresses or ranges of them such as "0xE000-0xE005" or "0x0001"'
LOOPBACK = ("127.0.0.0/8", "::1/128")


class Table(BaseModel):
    """A table of the file: unknown keys are refused, nothing is converted, nothing can be changed."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)
