"""Settings of the SNMP face; `service/config.py` makes them from the TOML."""

from __future__ import annotations

from dataclasses import dataclass, field
from ipaddress import IPv4Network, IPv6Network
from pathlib import Path

from gateway.core.conditions import Severity
from gateway.faces.snmp.secret import Secret
from gateway.faces.snmp.usm import Credentials

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
class View:
    """What a credential may read: subtrees of the tree that is served, less others. An empty one shows nothing."""

    include: tuple[Oid, ...] = ()
    exclude: tuple[Oid, ...] = ()

    def shows(self, oid: Oid) -> bool:
        """Whether `oid` is in the view: the longest subtree that holds it decides (RFC 3415 §4); none means no."""
        included = max((len(base) for base in self.include if oid[: len(base)] == base), default=0)
        excluded = max((len(base) for base in self.exclude if oid[: len(base)] == base), default=0)
        return included > excluded


EVERYTHING = View(((1, 3, 6, 1, 2, 1), (1, 3, 6, 1, 4, 1)))
"""mib-2 and enterprises. Of these the gateway serves what its tree has, and of nothing else."""


@dataclass(frozen=True, slots=True)
class Community:
    """A community that may read, from where, and what. There is no other right that one could have."""

    name: str = field(repr=False)  # a credential: never shown
    sources: tuple[Network, ...]
    view: View = EVERYTHING


@dataclass(frozen=True, slots=True)
class User:
    """An SNMPv3 user that may read with authentication and privacy, from where, and what."""

    credentials: Credentials
    sources: tuple[Network, ...]
    view: View = EVERYTHING


@dataclass(frozen=True, slots=True)
class Emc1Device:
    """A device that is also shown as Morningstar's EMC-1 would (`emc1.py`), and where that is so by default."""

    unit_id: int
    listen: tuple[tuple[str, int], ...] = ()


@dataclass(frozen=True, slots=True)
class Receiver:
    """Who is told of conditions: by a community (v2c) or as a user (v3), one of the two."""

    host: str  # an IP address
    port: int
    inform: bool  # acknowledged, and repeated until it is; otherwise a trap
    community: Secret | None = None
    credentials: Credentials | None = None
    least: Severity = Severity.INFO  # what is less severe is not told
    hold_s: float = 30.0  # least time between two notifications about one condition
    per_minute: float = 60.0  # notifications in the long run; a minute's worth may come at once

    @property
    def label(self) -> str:
        """Address and port."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


REPLY_LIMIT = 1400
"""Octets of the longest reply: fits a frame over IPv6 and a tunnel, so it is never cut on the way."""


@dataclass(frozen=True, slots=True)
class SnmpSettings:
    """Where the agent listens, who may read, and what the MIB hangs under."""

    listen: tuple[tuple[str, int], ...] = (("127.0.0.1", 1161),)
    communities: tuple[Community, ...] = ()  # none by default: nobody can read
    users: tuple[User, ...] = ()
    enterprise_root: Oid = DEFAULT_ROOT
    contact: str = ""  # sysContact
    location: str = ""  # sysLocation
    v1: bool = False  # whether communities may be used with SNMPv1 too
    state_dir: Path | None = None  # where engine id and boots are kept; None: a new engine id at every start
    renew_engine: bool = True  # whether a lost engine id is replaced by a new one; otherwise SNMPv3 stays off
    requests_per_s: float = 2000.0  # of one source in the long run; ten seconds' worth may come at once
    reply_octets: int = REPLY_LIMIT
    emc1: tuple[Emc1Device, ...] = ()
    receivers: tuple[Receiver, ...] = ()
    log_table: bool = True  # whether the days of a history are shown, where there is one
    authentication_traps: bool = False  # whether receivers are told of wrong credentials
