"""Settings of a line as the engine needs them; `service/config.py` makes them from the TOML."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gateway.modbus.rtu import Timing


@dataclass(frozen=True, slots=True)
class PollSettings:
    """How often values are wanted; the line decides what is possible."""

    live_s: float = 1.0
    settings_s: float = 300.0
    night_s: float | None = None  # live values while the device says that it is night; None: as by day


@dataclass(frozen=True, slots=True)
class UpstreamSettings:
    """Where a Modbus TCP upstream is, and how it is used."""

    host: str
    port: int
    pipelining: int = 8  # how many requests may be under way on a connection; fewer where the server does not stand it
    connections: int = 1  # how many there may be side by side; fewer where the server does not stand it
    connect_timeout_s: float = 3.0


@dataclass(frozen=True, slots=True)
class LineSettings:
    """One line: a serial port, or a Modbus TCP upstream, which has no use for the settings of a port."""

    name: str
    index: int  # 1-based position in the configuration; the MIB's lineIndex
    port: str
    baudrate: int = 9600
    bytesize: int = 8
    parity: str = "N"
    stopbits: int = 2
    reply_timeout_s: float = 0.5  # from the end of the request to the first byte that is due
    retries: int = 2  # for client reads; a missed poll waits for its next turn
    quarantine_s: float = 0.1  # silence asked for after a failure before the line is used again
    gap_s: float = 0.0  # extra silence between frames for slow devices; never below 3.5 characters
    queue_limit: int = 64  # waiting client reads; over it exception 06
    queue_limit_s: float = 5.0  # a client read that waited longer is answered 06
    writes: bool = False  # whether this line ever sends a write
    poll: PollSettings = PollSettings()
    upstream: UpstreamSettings | None = None  # None: a serial port

    def same_wire(self, other: LineSettings) -> bool:
        """Whether a line that runs by these can go on by the others without its port being opened anew."""
        return self == replace(
            other,
            index=self.index,
            reply_timeout_s=self.reply_timeout_s,
            retries=self.retries,
            queue_limit=self.queue_limit,
            queue_limit_s=self.queue_limit_s,
            writes=self.writes,
            poll=self.poll,
        )

    def timing(self) -> Timing:
        """Wire times at this speed; the gap is the configured one where that is longer than 3.5 characters."""
        timing = Timing.of(self.baudrate, self.bytesize, self.parity, self.stopbits)
        return replace(timing, gap_s=max(timing.gap_s, self.gap_s))
