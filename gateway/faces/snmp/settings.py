"""Settings of the SNMP face; `service/config.py` makes them from the TOML."""

from __future__ import annotations

from dataclasses import dataclass, field
from ipaddress import IPv4Network, IPv6Network

Network = IPv4Network | IPv6Network
Oid = tuple[int, ...]

DOCUMENTATION_ENTERPRISE = 32473
"""RFC 5612: for examples only; an operator has a number of their own."""

DEFAULT_ROOT: Oid = (1, 3, 6, 1, 4, 1, DOCUMENTATION_ENTERPRISE, 1)


def parse_oid(text: str) -> Oid:
    """The OID written in `text` (dotted numbers, a leading dot allowed); ValueError when it is none."""
    try:
        oid = tuple(int(part) for part in text.removeprefix(".").split("."))
    except ValueError:
        raise ValueError(f"{text!r} is no OID: allowed are numbers with dots between them") from None
    if len(oid) < 2 or not all(0 <= arc < 2**32 for arc in oid):
        raise ValueError(f"{text!r} is no OID: it needs two numbers or more, each below 4294967296")
    return oid


@dataclass(frozen=True, slots=True)
class Community:
    """A community that may read, and from where. There is no other right that one could have."""

    name: str = field(repr=False)  # a credential: never shown
    sources: tuple[Network, ...]


@dataclass(frozen=True, slots=True)
class SnmpSettings:
    """Where the agent listens, who may read, and what the MIB hangs under."""

    listen: tuple[tuple[str, int], ...] = (("127.0.0.1", 1161),)
    communities: tuple[Community, ...] = ()  # none by default: nobody can read
    enterprise_root: Oid = DEFAULT_ROOT
    contact: str = ""  # sysContact
    location: str = ""  # sysLocation
