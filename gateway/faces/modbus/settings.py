"""Settings of the Modbus TCP face; `service/config.py` makes them from the TOML."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from ipaddress import IPv4Network, IPv6Network, ip_network
from pathlib import Path

from gateway.core.ratelimit import ClientRate, LineRates
from gateway.core.write_rules import WriteRule
from gateway.core.write_wear import WearLimits
from gateway.faces.modbus.tls_names import WantedNames

Network = IPv4Network | IPv6Network

LOOPBACK: tuple[Network, ...] = (ip_network("127.0.0.0/8"), ip_network("::1/128"))


EVERYBODY = ClientRate()
THIS_MACHINE = ClientRate(requests_per_s=0.0)
LINES = LineRates()


@dataclass(frozen=True, slots=True)
class RateSettings:
    """How often clients may ask; the first network that holds a client's address decides, else `client`.

    What the gateway's own machine reads from memory is not limited: who is there can load the machine anyway.
    """

    client: ClientRate = EVERYBODY
    lines: LineRates = LINES
    burst_s: float = 2.0  # how many seconds' worth may come at once
    networks: tuple[tuple[tuple[Network, ...], ClientRate], ...] = ((LOOPBACK, THIS_MACHINE),)


@dataclass(frozen=True, slots=True)
class LineListen:
    """Addresses that stand for one line: there the unit id is the device's address on that line."""

    listen: tuple[tuple[str, int], ...]
    line: str
    tls: bool = False  # only through TLS; needs `ModbusSettings.tls`


@dataclass(frozen=True, slots=True)
class WriteSettings:
    """Who may write what, how often, and in which folder it is noted."""

    rules: tuple[WriteRule, ...]
    ledger: Path
    limits: WearLimits = field(default_factory=WearLimits)


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """Where they are: PEM files."""

    certificate: Path  # the server's own first, then its issuers up to the root
    key: Path  # without a passphrase
    client_ca: Path  # who is trusted to issue certificates of clients
    crl: Path | None = None  # those of all issuers of client certificates

    def named(self) -> Iterator[tuple[str, Path]]:
        """Each file with the configuration's key for it."""
        yield "certificate_file", self.certificate
        yield "key_file", self.key
        yield "client_ca_file", self.client_ca
        if self.crl is not None:
            yield "crl_file", self.crl


@dataclass(frozen=True, slots=True)
class TlsSettings:
    """Modbus/TCP Security: where, by which files, whose certificates, and what one without a role is good for."""

    listen: tuple[tuple[str, int], ...]
    files: TlsFiles
    require_role: bool = True  # False: who has no role may read
    client_names: WantedNames | None = None  # a client's certificate has one of these; None: any, or no name at all
    require_address: bool = False  # True: a client's certificate has the address that the client connects from
    handshake_timeout_s: float = 5.0


@dataclass(frozen=True, slots=True)
class ModbusSettings:
    """Who may connect, how many, and for how long the server waits for what."""

    listen: tuple[tuple[str, int], ...] = (("127.0.0.1", 1502),)
    lines: tuple[LineListen, ...] = ()
    max_connections: int = 64  # over it the longest idle connection makes room, else the newcomer is refused
    max_per_client: int = 64  # the same for the connections of one client
    evict_idle_s: float = 10.0  # only a connection that asked nothing for so long has to make room
    priority: tuple[Network, ...] = ()  # they always get in: any other connection makes room for them
    rate: RateSettings = RateSettings()
    allow: tuple[Network, ...] = LOOPBACK
    max_age_s: float = 5.0  # `[cache] max_age_s`: older is never served from memory
    writes: WriteSettings | None = None  # None: every write is refused
    tls: TlsSettings | None = None  # None: no TLS
    status_unit: bool = False  # True: unit id 255 answers the gateway's own registers (core/status_registers.py)
    strict_map: bool = False  # True: exception 02 outside of the map without asking the device
    idle_timeout_s: float = 600.0  # no request for so long: the connection is closed
    frame_timeout_s: float = 5.0  # a request must be complete so long after its first byte
    write_timeout_s: float = 10.0  # a client that reads no replies for so long is cut off
    reply_timeout_s: float = 60.0  # last resort: a request that is unanswered for so long ends its connection
    stop_grace_s: float = 2.0  # how long a stopping server waits for replies under way
