"""The site: lines and devices as the faces see them.

A face holds a `Site`, looks devices up by unit id, reads `device.snapshot` and, when memory is not
enough, asks `device.line.read(...)`. It never sees a serial port.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Protocol

from gateway.core.identity import Identity
from gateway.core.snapshot import Snapshot
from gateway.core.stats import DeviceStats, LineStats
from gateway.devices.model import DeviceMap
from gateway.errors import RequestError

Outcome = bytes | RequestError
"""How a request ended: the reply PDU (may be the device's own exception) or why there is none."""


class LineState(StrEnum):
    """Whether the port is open."""

    DOWN = "down"
    OPEN = "open"


@dataclass(frozen=True, slots=True)
class LineStatus:
    """A line at one moment."""

    state: LineState
    since: float  # monotonic
    error: str  # why it is down; "" when open
    queue_depth: int
    use_ratio: float  # share of the last minute in which a transaction was on the wire, 0..1
    stretch: float = 1.0  # how much longer live values take than asked for; 1 where the line keeps up
    echo: str = "unknown"  # whether the line gives our own requests back: "unknown", "absent" or "present"


class Ticket(Protocol):
    """A read that is under way for somebody."""

    def cancel(self, keep: Callable[[Outcome], None] | None = None) -> None:
        """The asker is gone: `done` will not be called. Others who share the read are not affected.

        A request that is on the wire by now runs to its end; `keep` gets what came of it, for others who may ask.
        """
        ...


class LinePort(Protocol):
    """A line as the faces and the history see it."""

    @property
    def name(self) -> str:
        """The configured name."""
        ...

    @property
    def index(self) -> int:
        """1-based position in the configuration; the MIB's lineIndex."""
        ...

    @property
    def port(self) -> str:
        """The configured port, for people."""
        ...

    @property
    def stats(self) -> LineStats:
        """Counters since start."""
        ...

    def status(self, now: float) -> LineStatus:
        """State, queue and use at `now`."""
        ...

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Ticket:
        """Ask the line for one read (functions 01 to 04 and 2B/0E) for `client`, who gets a fair share of the line.

        `done` is called exactly once, from the event loop and never before `read` returns, unless the
        ticket was cancelled. Reads that wait for the same device share transactions where that saves line time.
        A background read waits until the line has time for it.
        """
        ...

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Ticket:
        """Ask the line for one single write (functions 05 and 06), which is made once and never repeated.

        `done` as for `read`. Who may write what is for the caller to decide; a line whose settings do not allow
        writes refuses it. ReplyTimeout means that nobody knows whether the device has taken it.
        """
        ...


@dataclass(slots=True, eq=False)
class Device:
    """A controller on a line. Only its line replaces `snapshot`, and `map` where it is `auto`: found by identification.

    Who keeps something that follows from a map does so for the maps that its `Site` was made with.
    """

    name: str
    unit_id: int
    address: int
    map: DeviceMap
    decode: Mapping[str, str] = field(default_factory=dict)  # point name → reading name
    expected: Identity = field(default_factory=Identity)  # what is configured of the unit itself
    reply_timeout_s: float | None = None  # None: its line's
    auto: bool = False  # `map` is UNKNOWN until the device has said that it is of a model
    line: LinePort = field(init=False)
    snapshot: Snapshot = field(default_factory=Snapshot)
    stats: DeviceStats = field(default_factory=DeviceStats)


@dataclass(frozen=True, slots=True)
class Site:
    """Everything that is configured south of the faces."""

    name: str
    lines: tuple[LinePort, ...]
    devices: tuple[Device, ...]  # ascending unit id
    by_unit: Mapping[int, Device]
    behind: Mapping[str, str] = field(default_factory=dict)  # line → the site that is behind it, where it is another
    maps: tuple[DeviceMap, ...] = ()  # of `devices`, when the site was made

    @property
    def outdated(self) -> bool:
        """Whether a device has another map by now."""
        return any(device.map is not was for device, was in zip(self.devices, self.maps, strict=True))

    @classmethod
    def of(
        cls, name: str, lines: Sequence[LinePort], devices: Sequence[Device], behind: Mapping[str, str] | None = None
    ) -> Site:
        """Build the site; ValueError when two devices have one unit id."""
        by_unit = {device.unit_id: device for device in devices}
        if len(by_unit) != len(devices):
            message = "unit ids are not unique"
            raise ValueError(message)
        ordered = tuple(sorted(devices, key=lambda device: device.unit_id))
        behind_of = MappingProxyType(dict(behind or {}))
        maps = tuple(device.map for device in ordered)
        return cls(name, tuple(lines), ordered, MappingProxyType(by_unit), behind_of, maps)

    def of_line(self, line: str) -> str:
        """The name of the site that a line and its devices belong to."""
        return self.behind.get(line, self.name)
