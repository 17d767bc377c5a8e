"""The one error tree.

Every error that can end a request knows the Modbus exception code a TCP client is told
(`exception_code`, design: the table in docs/behaviour.md) and the `label` under which it is counted.
"""

from __future__ import annotations

from typing import ClassVar


class GatewayError(Exception):
    """Root of every error this project raises on purpose."""

    exception_code: ClassVar[int | None] = None
    label: ClassVar[str] = "gateway"


class RequestError(GatewayError):
    """A Modbus request that ends without the device's own reply; always has an exception code."""

    exception_code: ClassVar[int] = 0x04
    label: ClassVar[str] = "request"


class IllegalFunction(RequestError):
    """Function unknown to the gateway, or refused by policy (exception 01)."""

    exception_code = 0x01
    label = "illegal_function"


class IllegalDataAddress(RequestError):
    """Range outside the address space (exception 02)."""

    exception_code = 0x02
    label = "illegal_data_address"


class IllegalDataValue(RequestError):
    """Quantity, byte count or PDU length is wrong (exception 03)."""

    exception_code = 0x03
    label = "illegal_data_value"


class ReplyUnusable(RequestError):
    """The device answered, but nothing that can be used (exception 04)."""

    exception_code = 0x04
    label = "reply_unusable"


class ReplyCrcError(ReplyUnusable):
    """A reply came with a wrong CRC."""

    label = "crc"


class ReplyMismatch(ReplyUnusable):
    """A reply with a right CRC had the wrong function, byte count or shape."""

    label = "mismatch"


class Busy(RequestError):
    """The gateway will not take the request now (exception 06)."""

    exception_code = 0x06
    label = "busy"


class QueueFull(Busy):
    """The queue of the client, device or line is full."""

    label = "queue_full"


class QueueTimeout(Busy):
    """The request waited too long for its turn on the line."""

    label = "queue_timeout"


class RateLimited(Busy):
    """The client, or all clients together, ask more often than they may; the message says whose limit it is."""

    label = "rate_limited"


class EchoUnknown(Busy):
    """A write waits until it is known whether the line gives requests back: an echo looks like success."""

    label = "echo_unknown"


class ShuttingDown(Busy):
    """The gateway is stopping."""

    label = "shutting_down"


class WriteTooSoon(Busy):
    """The register or coil was written a moment ago."""

    label = "write_too_soon"


class WriteBudgetSpent(Busy):
    """The register was written so often today that more would wear its memory out."""

    label = "write_budget_spent"


class LedgerUnavailable(RequestError):
    """A write cannot be noted, so it is not made (exception 04)."""

    label = "ledger_unavailable"


class WriteDiffers(RequestError):
    """The device confirmed a write and holds another value (exception 04)."""

    label = "write_differs"


class PathUnavailable(RequestError):
    """No way to the device (exception 0A)."""

    exception_code = 0x0A
    label = "path_unavailable"


class UnitNotRouted(PathUnavailable):
    """The unit id belongs to no configured device."""

    label = "unit_not_routed"


class LineDown(PathUnavailable):
    """The serial line is not open."""

    label = "line_down"


class IdentityUnproven(PathUnavailable):
    """Another controller may be at the other end; nothing is asked of it before it has proved who it is."""

    label = "identity_unproven"


class DeviceSilent(RequestError):
    """The device gave no answer (exception 0B)."""

    exception_code = 0x0B
    label = "silent"


class Unconfirmed(DeviceSilent):
    """A write was, or may have been, sent, and nobody could find out what became of it."""

    label = "unconfirmed"


class ReplyTimeout(DeviceSilent):
    """No complete reply within the time-out, after all retries."""

    label = "timeout"


class ConnectionLost(ReplyTimeout):
    """The connection to the upstream ended before the reply came."""

    label = "connection_lost"


class RelayedSilence(ReplyTimeout):
    """An upstream gateway says that the device gave it no answer (its exception 0B)."""

    label = "exception"


class RelayedNoPath(RelayedSilence):
    """An upstream gateway says that it has no way to the device (its exception 0A)."""

    exception_code = 0x0A


class DeviceOffline(DeviceSilent):
    """The device is quarantined; refused at once, without waiting."""

    label = "offline"


class FramingLost(GatewayError):
    """A byte stream can no longer be cut into frames; the connection must be closed."""

    label = "framing_lost"


class MapError(GatewayError):
    """A device map is wrong; the message names the file and the entry."""

    label = "map"


class PortError(GatewayError):
    """A serial port cannot be opened; the message names the port and why."""

    label = "port"


class ListenError(GatewayError):
    """A face cannot listen; the message names the address and why."""

    label = "listen"


class BackupError(GatewayError):
    """A backup cannot be made or restored; the message names the file and why. Nothing was changed."""

    label = "backup"


class CertificateRefused(GatewayError):
    """A client's certificate cannot be served; `reason` is the label under which it is counted."""

    label = "certificate_refused"

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class TlsFilesError(GatewayError):
    """Certificate, key, CA or CRL files cannot be used. `problems` lists all: which file's key, and what is wrong."""

    label = "tls_files"

    def __init__(self, problems: tuple[tuple[str, str], ...]) -> None:
        super().__init__("; ".join(f"{key}: {text}" for key, text in problems))
        self.problems = problems


class HistoryError(GatewayError):
    """The history cannot be written or read; the message names the file and why.

    `kind` is for counting: "unwritable", "full", "corrupt", "locked", "newer" or "missing".
    """

    label = "history"

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


class ConfigError(GatewayError):
    """A configuration is wrong. `problems` lists all of them, each with key path and what is allowed."""

    label = "config"

    def __init__(self, problems: tuple[str, ...]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class ReadingFailed(GatewayError):
    """The configuration could not be read for want of a process; that says nothing about the file."""

    label = "reading_failed"
