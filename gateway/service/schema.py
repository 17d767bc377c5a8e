"""The configuration file as classes: every key, its type, range, default and what it is for.

Rule 1: a key exists only here, those of SNMP in service/schema_snmp.py. Problem texts, config/full.toml,
docs/configuration.md and the suggestions for misspelt keys are checked against (or made from) these classes.
Rule 2: a class checks one value at a time. Whatever compares two keys lives in service/crosscheck.py, which
works on the raw file, so that both kinds of problem are reported together.
Rule 3: a key that this version cannot honour is not here.
"""

from __future__ import annotations

from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field

from gateway.core.ratelimit import ClientRate, LineRates
from gateway.core.settings import LineSettings, PollSettings, UpstreamSettings
from gateway.core.write_wear import WearLimits
from gateway.service.keys import (
    A_FILE,
    A_NAME,
    LISTENS,
    LOOPBACK,
    NETWORKS,
    RANGES,
    AbsolutePath,
    Hours,
    Key,
    Listens,
    Name,
    Networks,
    Ranges,
    Rate,
    Seconds,
    Table,
)
from gateway.service.parsing import HTTP_LISTEN
from gateway.service.schema_snmp import CommunityTable, Emc1Table, NotifyTable, SnmpTable, UserTable, ViewTable
from gateway.service.schema_tls import ROLES, Roles, TlsTable

__all__ = [
    "CacheTable",
    "ClientNetworkTable",
    "CommunityTable",
    "Config",
    "DeviceTable",
    "Emc1Table",
    "HistoryTable",
    "HttpTable",
    "Key",
    "LineTable",
    "ListenerTable",
    "ModbusTable",
    "NotifyTable",
    "PollTable",
    "RateTable",
    "SnmpTable",
    "Table",
    "TlsTable",
    "UserTable",
    "ViewTable",
    "WriteTable",
]

PORT_SCHEMES = ("rfc2217", "socket", "tcp")

_LINE = LineSettings(name="", index=1, port="")
_UPSTREAM = UpstreamSettings(host="", port=0)
_POLL = PollSettings()
_CLIENT_RATE = ClientRate()
_LINE_RATES = LineRates()
_RATE = "0.0 to 1000000.0 a second; 0.0 is no limit"
_WEAR = WearLimits()


def _port(text: str) -> str:
    if "://" not in text:
        if not text.startswith("/") or not text.isprintable():
            raise ValueError("no absolute path")
        return text
    parts = urlsplit(text)
    known = text.startswith(tuple(f"{scheme}://" for scheme in PORT_SCHEMES))
    options = parts.fragment or (parts.query and parts.scheme == "tcp")  # of the others pyserial knows some
    if not known or not parts.hostname or not parts.port or "@" in parts.netloc or parts.path not in ("", "/"):
        raise ValueError("not a known URL")
    if options:
        raise ValueError("options that nobody knows")
    return text


class DeviceTable(Table):
    """`[[line.device]]`: a controller on the line."""

    name: Annotated[Name, Key(A_NAME, "What the controller is called on every face; unique in the gateway.")]
    address: Annotated[int, Key("1 to 247", "Its Modbus address on the line; factory setting 1.")] = Field(ge=1, le=247)
    unit_id: Annotated[
        int,
        Key("1 to 247", "What Modbus TCP clients ask for, and the SNMP index; unique in the gateway."),
    ] = Field(ge=1, le=247)
    model: Annotated[
        str,
        Key(
            'a model with a map, or "auto"',
            "The map by which its registers are read; auto: that of the product it says it is.",
        ),
    ]
    decode: Annotated[
        dict[str, str],
        Key(
            'a table point = "reading", both named in the map',
            "Another reading of a point than the document's, for units that differ from it.",
        ),
    ] = Field(default_factory=dict)
    reply_timeout_s: Annotated[
        Seconds | None,
        Key("0.05 to 10.0", "How long this controller may take before its reply begins; left out: as its line says."),
    ] = Field(default=None, ge=0.05, le=10.0)
    product: Annotated[
        Annotated[str, Field(pattern=r"^[!-~]([ -~]{0,62}[!-~])?$")] | None,
        Key(
            "the product code of a unit of the model, such as PS-MPPT-40M",
            "What the unit must call itself, else nothing of it is served.",
        ),
    ] = None
    serial_number: Annotated[
        Annotated[str, Field(pattern=r"^[!-~]{1,32}$")] | None,
        Key(
            "1 to 32 printable ASCII characters without blanks",
            "The serial number that the unit must tell, else nothing of it is served; one without is not refused.",
        ),
    ] = None


class LineTable(Table):
    """`[[line]]`: a serial port, or a Modbus TCP upstream, and the controllers on it."""

    name: Annotated[Name, Key(A_NAME, "What the line is called on every face; unique.")]
    port: Annotated[
        Annotated[str, AfterValidator(_port)],
        Key(
            "a device path such as /dev/serial/by-id/usb-FTDI_…, rfc2217://host:port, socket://host:port, or "
            "tcp://host:port for a Modbus TCP server",
            "The serial port, or the upstream; used by one line only, a device path is locked.",
        ),
    ]
    baudrate: Annotated[int, Key("300 to 230400", "Bits a second.")] = Field(default=_LINE.baudrate, ge=300, le=230400)
    bytesize: Annotated[Literal[8], Key("8 (Modbus RTU has no other)", "Data bits.")] = 8
    parity: Annotated[Literal["N", "E", "O"], Key('"N", "E" or "O"', "Parity: none, even or odd.")] = "N"
    stopbits: Annotated[Literal[1, 2], Key("1 or 2", "Stop bits.")] = 2
    reply_timeout_s: Annotated[
        Seconds,
        Key("0.05 to 10.0", "How long a controller may take before its reply begins."),
    ] = Field(default=_LINE.reply_timeout_s, ge=0.05, le=10.0)
    retries: Annotated[
        int,
        Key("0 to 5", "How often a client's read is repeated; a missed poll waits for its next turn."),
    ] = Field(default=_LINE.retries, ge=0, le=5)
    quarantine_s: Annotated[
        Seconds,
        Key("0.01 to 2.0", "Silence kept after a failure, so that a late reply is never taken for the next one."),
    ] = Field(default=_LINE.quarantine_s, ge=0.01, le=2.0)
    gap_s: Annotated[
        Seconds,
        Key("0.0 to 1.0", "Silence kept between frames; 3.5 characters are kept in any case."),
    ] = Field(default=_LINE.gap_s, ge=0.0, le=1.0)
    pipelining: Annotated[
        int,
        Key(
            "1 to 32; tcp:// only",
            "How many requests may be under way at once on a connection, if the server stands it; "
            "1 sends one after the other.",
        ),
    ] = Field(default=_UPSTREAM.pipelining, ge=1, le=32)
    connections: Annotated[
        int,
        Key(
            "1 to 8; tcp:// only",
            "How many connections there may be side by side, when requests wait and the server stands it; "
            "for a converter or gateway that closes after every reply.",
        ),
    ] = Field(default=_UPSTREAM.connections, ge=1, le=8)
    connect_timeout_s: Annotated[
        Seconds,
        Key("0.1 to 60.0; tcp:// only", "How long a connection may take, name lookup included."),
    ] = Field(default=_UPSTREAM.connect_timeout_s, ge=0.1, le=60.0)
    site: Annotated[
        Name | None,
        Key(
            A_NAME,
            "The site that the line's controllers are shown under, where another gateway's site is behind it; "
            "left out: the file's.",
        ),
    ] = None
    queue_limit: Annotated[
        int,
        Key("1 to 1000", "How many client reads may wait for the line; one more is answered 06."),
    ] = Field(default=_LINE.queue_limit, ge=1, le=1000)
    queue_limit_s: Annotated[
        Seconds,
        Key("0.1 to 60.0", "How long a client read may wait for the line; after that it is answered 06."),
    ] = Field(default=_LINE.queue_limit_s, ge=0.1, le=60.0)
    device: Annotated[
        Annotated[tuple[DeviceTable, ...], Field(strict=False)],
        Key("one [[line.device]] table or more", "The controllers on the line."),
    ] = Field(min_length=1)


class PollTable(Table):
    """`[poll]`: how often values are wanted; the line decides what is possible."""

    live_s: Annotated[
        Seconds,
        Key("0.2 to 3600.0", "How often live values, energy and today's values are wanted."),
    ] = Field(default=_POLL.live_s, ge=0.2, le=3600.0)
    settings_s: Annotated[
        Seconds,
        Key("1.0 to 86400.0", "How often the controller's settings are wanted."),
    ] = Field(default=_POLL.settings_s, ge=1.0, le=86400.0)
    night_s: Annotated[
        Seconds | None,
        Key(
            "0.2 to 3600.0",
            "How often live values are wanted of a controller that says that it is night; "
            "left out or below live_s: as by day.",
        ),
    ] = Field(default=_POLL.night_s, ge=0.2, le=3600.0)


class CacheTable(Table):
    """`[cache]`: what may be answered from memory."""

    max_age_s: Annotated[
        Seconds,
        Key("0.1 to 3600.0", "Registers older than this are never served as a Modbus reply."),
    ] = Field(default=5.0, ge=0.1, le=3600.0)


class ListenerTable(Table):
    """`[[modbus.listener]]`: addresses that stand for one line, for masters whose unit ids cannot be chosen."""

    listen: Annotated[
        Listens,
        Key(
            'a list of "IPv4:port" or "[IPv6]:port", at least one',
            "Where the line's controllers are asked by their addresses on it: the unit id is `line.device.address`.",
        ),
    ] = Field(min_length=1)
    line: Annotated[Name, Key("the name of a line", "The line that it stands for; each line has one listener at most.")]
    tls: Annotated[
        bool, Key("true or false", "Only through TLS, with the files and roles of [modbus.tls], which must be there.")
    ] = False


class WriteTable(Table):
    """`[[modbus.write]]`: who may write what; a request is allowed when rules allow all of it."""

    source: Annotated[
        Networks,
        Key(NETWORKS + ", at least one", "Who may write, by address; left out: from anywhere, if role says who."),
    ] = Field(default=(), min_length=1)
    role: Annotated[
        Roles,
        Key(ROLES, "Who may write, by the role of its certificate: over TLS only. With source: both must hold."),
    ] = Field(default=(), min_length=1)
    unit_id: Annotated[
        Annotated[tuple[Annotated[int, Field(ge=1, le=247)], ...], Field(strict=False)],
        Key("a list of unit ids of the file", "On which controllers; left out: on all."),
    ] = ()
    point: Annotated[
        Annotated[tuple[Name, ...], Field(strict=False)],
        Key("a list of points of the map that can be written", "What may be written, by name."),
    ] = ()
    registers: Annotated[
        Ranges,
        Key(RANGES, "Further registers, without those that must be named."),
    ] = ()
    coils: Annotated[Ranges, Key(RANGES, "Further coils, without those that must be named.")] = ()


class ClientNetworkTable(Table):
    """`[[modbus.rate.network]]`: other rates for some clients; the first table that names an address decides."""

    source: Annotated[Networks, Key(NETWORKS + ", at least one", "For whom.")] = Field(min_length=1)
    requests_per_s: Annotated[Rate, Key(_RATE, "As in [modbus.rate].")] = Field(
        default=_CLIENT_RATE.requests_per_s, ge=0.0, le=1e6
    )
    client_line_per_s: Annotated[Rate, Key(_RATE, "As in [modbus.rate].")] = Field(
        default=_CLIENT_RATE.line_per_s, ge=0.0, le=1e6
    )


class RateTable(Table):
    """`[modbus.rate]`: how often clients may ask; beyond it 06, then the client is not read from for up to 1 s."""

    requests_per_s: Annotated[
        Rate,
        Key(
            _RATE,
            "Requests of one client address, mostly answered from memory; this machine itself has no such limit, "
            "unless a network names it.",
        ),
    ] = Field(default=_CLIENT_RATE.requests_per_s, ge=0.0, le=1e6)
    client_line_per_s: Annotated[Rate, Key(_RATE, "Of these, requests that need a line.")] = Field(
        default=_CLIENT_RATE.line_per_s, ge=0.0, le=1e6
    )
    device_per_s: Annotated[Rate, Key(_RATE, "The same of all clients together, for one controller.")] = Field(
        default=_LINE_RATES.device_per_s, ge=0.0, le=1e6
    )
    line_per_s: Annotated[Rate, Key(_RATE, "The same of all clients together, for one line.")] = Field(
        default=_LINE_RATES.line_per_s, ge=0.0, le=1e6
    )
    burst_s: Annotated[Seconds, Key("0.1 to 60.0", "How many seconds' worth may come at once.")] = Field(
        default=2.0, ge=0.1, le=60.0
    )
    network: Annotated[
        Annotated[tuple[ClientNetworkTable, ...], Field(strict=False)],
        Key("[[modbus.rate.network]] tables", "Other rates for the clients of some networks."),
    ] = ()


class ModbusTable(Table):
    """`[modbus]`: the Modbus TCP face."""

    listen: Annotated[Listens, Key(LISTENS, "Where Modbus TCP clients connect.")] = ("127.0.0.1:1502",)
    max_connections: Annotated[
        int,
        Key("1 to 1024", "How many clients may be connected at once, over all listen addresses."),
    ] = Field(default=64, ge=1, le=1024)
    max_per_client: Annotated[
        int,
        Key("1 to 1024", "How many connections one client address may have at once."),
    ] = Field(default=64, ge=1, le=1024)
    priority: Annotated[
        Networks,
        Key(NETWORKS, "Clients that always get in: over a limit, a connection without priority makes room."),
    ] = ()
    allow: Annotated[Networks, Key(NETWORKS, "Who may connect; others are closed before a byte is read.")] = LOOPBACK
    status_unit: Annotated[
        bool, Key("true or false", "Unit id 255 answers the gateway's own registers (registers/gateway.md).")
    ] = False
    strict_map: Annotated[
        bool,
        Key("true or false", "Answer 02 for ranges outside of the map without asking the controller."),
    ] = False
    writes: Annotated[
        bool,
        Key(
            "true or false",
            "Writing to controllers, as far as [[modbus.write]] allows it; each write is noted in `state_dir` first.",
        ),
    ] = False
    eeprom_writes_per_day: Annotated[
        int,
        Key("1 to 1000", "How often a register that wears may be written within 24 hours; after that 06."),
    ] = Field(default=_WEAR.per_day, ge=1, le=1000)
    write_interval_s: Annotated[
        Seconds,
        Key(
            "0.0 to 3600.0",
            "How soon a register or coil may be written again; before that 06. Slave control is free of it.",
        ),
    ] = Field(default=_WEAR.interval_s, ge=0.0, le=3600.0)
    write: Annotated[
        Annotated[tuple[WriteTable, ...], Field(strict=False)],
        Key("[[modbus.write]] tables", "Who may write what; without one nobody can."),
    ] = ()
    tls: Annotated[
        TlsTable | None,
        Key("a [modbus.tls] table", "Modbus/TCP Security; left out: none."),
    ] = None
    rate: Annotated[RateTable, Key("a [modbus.rate] table", "How often clients may ask.")] = RateTable()
    listener: Annotated[
        Annotated[tuple[ListenerTable, ...], Field(strict=False)],
        Key(
            "[[modbus.listener]] tables",
            "Further addresses, each for one line, where the unit id is the address there.",
        ),
    ] = ()


class HttpTable(Table):
    """`[http]`: /metrics, /sd, /healthz and /readyz."""

    listen: Annotated[Listens, Key(LISTENS, "Where Prometheus scrapes and health checks ask.")] = (HTTP_LISTEN,)
    basic_auth_file: Annotated[
        AbsolutePath,
        Key(A_FILE, "Names and passwords of who may ask, one name:password a line; /healthz stays open."),
    ] = ""
    bearer_token_file: Annotated[
        AbsolutePath,
        Key(A_FILE, "A token of 16 printable ASCII characters or more; who shows it may ask."),
    ] = ""
    tls_certificate: Annotated[
        AbsolutePath,
        Key(A_FILE, "The certificate (PEM, with its chain) of HTTPS; needs tls_private_key."),
    ] = ""
    tls_private_key: Annotated[
        AbsolutePath, Key(A_FILE, "The certificate's private key (PEM, without a password).")
    ] = ""


class HistoryTable(Table):
    """`[history]`: the controllers' daily log, kept for ever in state_dir."""

    enabled: Annotated[
        bool,
        Key("true or false", "Read the controllers' daily logs in idle line time and keep every day in state_dir."),
    ] = True
    interval_h: Annotated[
        Hours,
        Key(
            "1.0 to 720.0",
            "By when a log is read again at the latest; it is read anyway soon after a day must have ended.",
        ),
    ] = Field(default=24.0, ge=1.0, le=720.0)


class LogTable(Table):
    """`[log]`: what is logged, and how it looks."""

    level: Annotated[
        Literal["debug", "info", "warning", "error"],
        Key('"debug", "info", "warning" or "error"', "From which level on events are logged; --log-level goes before."),
    ] = "info"
    form: Annotated[
        Literal["text", "json"],
        Key('"text" or "json"', "How an event looks: key=value, or a JSON object a line."),
    ] = "text"


class Config(Table):
    """The whole file."""

    site: Annotated[Name, Key(A_NAME, "The site's name, shown on every face.")]
    state_dir: Annotated[
        Annotated[str, Field(pattern=r"^/[^\x00-\x1f]*$")],
        Key("an absolute path", "Where the gateway keeps what must outlive it, such as the write ledger."),
    ] = "/var/lib/prostar-gateway"
    line: Annotated[
        Annotated[tuple[LineTable, ...], Field(strict=False)],
        Key("one [[line]] table or more", "The serial lines and upstreams."),
    ] = Field(min_length=1)
    poll: Annotated[PollTable, Key("a [poll] table", "How often values are wanted.")] = PollTable()
    cache: Annotated[CacheTable, Key("a [cache] table", "What may be answered from memory.")] = CacheTable()
    modbus: Annotated[ModbusTable, Key("a [modbus] table", "The Modbus TCP face.")] = ModbusTable()
    snmp: Annotated[SnmpTable, Key("an [snmp] table", "The SNMP face.")] = SnmpTable()
    http: Annotated[HttpTable, Key("an [http] table", "The HTTP face.")] = HttpTable()
    history: Annotated[HistoryTable, Key("a [history] table", "The controllers' daily log.")] = HistoryTable()
    log: Annotated[LogTable, Key("a [log] table", "The log of the gateway itself.")] = LogTable()
