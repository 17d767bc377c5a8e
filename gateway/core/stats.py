"""Counters, written by the engine and the faces and read by every face.

Plain mutable numbers on one loop: an increment is the whole cost.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Container
from dataclasses import dataclass, field, replace

from gateway.core.histogram import Histogram
from gateway.modbus.counters import RtuCounters, UpstreamCounters


@dataclass(slots=True)
class LineStats:
    """What a line did since start. `sent` = `ok` + the sum of `failed` + those under way."""

    sent: int = 0
    ok: int = 0
    failed: Counter[str] = field(default_factory=Counter)  # error label → count, incl. "exception"
    retries: int = 0
    polls: int = 0
    client_reads: int = 0  # transactions made for clients and the history
    joined: int = 0  # reads that shared another's transaction
    writes: int = 0
    opens: int = 0
    busy_s: float = 0.0  # time the line was occupied by a transaction
    seconds_by_purpose: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    seconds_by_client: dict[str, float] = field(default_factory=dict)
    queue_wait: Histogram = field(default_factory=Histogram)  # of client reads and writes
    reply_time: Histogram = field(default_factory=Histogram)  # request out to reply whole
    wire: RtuCounters = field(default_factory=RtuCounters)
    upstream: UpstreamCounters | None = None  # of a Modbus TCP upstream only


@dataclass(slots=True)
class DeviceStats:
    """What was asked of a device since start."""

    polls: int = 0
    failures: int = 0
    exceptions: int = 0
    went_offline: int = 0
    implausible: int = 0
    line_s: float = 0.0  # line time spent on it
    errors: Counter[str] = field(default_factory=Counter)  # error label → count
    refresh_s: float | None = None  # mean period of its live values as of late
    identity_mismatches: int = 0


@dataclass(slots=True)
class TlsStats:
    """Modbus/TCP Security since start."""

    handshakes: int = 0  # that let a client in
    refused: Counter[str] = field(default_factory=Counter)  # reason → failed handshakes
    reload_failures: int = 0
    problem: str = ""  # why the files last read cannot be used; "" when they are in use
    not_after: float | None = None  # Unix time when the server's certificate expires; None: there is none yet


@dataclass(slots=True)
class ModbusServerStats:
    """The Modbus TCP face since start."""

    connections: int = 0
    open_connections: int = 0
    refused_connections: int = 0
    requests: int = 0
    cache_hits: int = 0
    forwarded: int = 0
    exceptions: Counter[int] = field(default_factory=Counter)  # exception code → count
    malformed: Counter[str] = field(default_factory=Counter)  # reason → count
    refused: Counter[str] = field(default_factory=Counter)  # the policy's reason → count
    limited: Counter[str] = field(default_factory=Counter)  # whose rate limit was met → requests
    writes: Counter[str] = field(default_factory=Counter)  # what became of single writes that were allowed → count
    closed: Counter[str] = field(default_factory=Counter)  # why the server ended a connection → count
    tls: TlsStats | None = None  # None: there is no TLS listener


@dataclass(slots=True)
class NotifyStats:
    """The SNMP notifications to one receiver since start."""

    receiver: str  # address and port, as configured
    kind: str  # "trap" or "inform"
    notifications: int = 0
    sent: int = 0  # datagrams with a notification; an inform may take several
    repeated: int = 0  # of these, those that were sent before
    acknowledged: int = 0
    refused: Counter[str] = field(default_factory=Counter)  # reason → answers that say that the receiver takes it not
    failures: int = 0  # datagrams that the system did not take
    waiting: int = 0  # notifications that wait or are under way
    acknowledged_at: float | None = None  # monotonic; None: never
    silent: bool = False  # it leaves informs unanswered


@dataclass(slots=True)
class LogStats:
    """The log since start."""

    dropped: int = 0  # lines that could not be written in time


@dataclass(slots=True)
class ServiceStats:
    """The process since start."""

    reloads: Counter[str] = field(default_factory=Counter)  # what became of it → count
    reload_works: bool = True  # whether the file was right when it was last read
    configured_at: float = 0.0  # monotonic, when the configuration in use was taken
    restarts: Counter[str] = field(default_factory=Counter)  # task → how often a bug ended it
    log: LogStats = field(default_factory=LogStats)


@dataclass(slots=True)
class DeviceHistoryStats:
    """The daily log of one device: what is stored of the controller that is there now, and the harvests since start."""

    harvests: int = 0
    failures: Counter[str] = field(default_factory=Counter)  # why a harvest ended early → count
    days: int | None = None  # stored; None: not known yet
    apart: int | None = None  # blocks kept apart, because their hourmeter cannot be
    harvested_at: float | None = None  # monotonic; None: never
    waiting_since: float | None = None  # monotonic: a read of the log waits for idle line time; None: none waits


@dataclass(slots=True)
class HistoryStats:
    """The history since start."""

    devices: dict[int, DeviceHistoryStats] = field(default_factory=dict)  # by unit id
    store_up: bool = True  # False: what was read cannot be stored
    store_errors: Counter[str] = field(default_factory=Counter)  # kind → count
    moved: int = 0  # how often dates were moved, because the clock was set

    def of(self, units: Container[int]) -> HistoryStats:
        """The same for another site, of which these units are as before; the others begin anew."""
        return replace(self, devices={unit: stats for unit, stats in self.devices.items() if unit in units})
