"""Opening and closing a port by pyserial, and saying plainly why it cannot be opened. Everything here blocks.

Any pyserial URL works: a device path, `rfc2217://host:port`, `socket://host:port`. A device path is
locked (flock) so that no second program that asks speaks on the line; one that did not ask is named. A network
connection whose other end is gone without a word is ended after a dozen seconds.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import socket
import termios
from pathlib import Path

import serial

from gateway.core.settings import LineSettings
from gateway.errors import PortError

log = logging.getLogger(__name__)

KEEPALIVE = {
    socket.SO_KEEPALIVE: (socket.SOL_SOCKET, 1),
    socket.TCP_KEEPIDLE: (socket.IPPROTO_TCP, 5),
    socket.TCP_KEEPINTVL: (socket.IPPROTO_TCP, 2),
    socket.TCP_KEEPCNT: (socket.IPPROTO_TCP, 3),
    socket.TCP_USER_TIMEOUT: (socket.IPPROTO_TCP, 12_000),
    socket.TCP_NODELAY: (socket.IPPROTO_TCP, 1),
}
"""Options of a connection to a terminal server: seconds, but the user time-out is in milliseconds."""

PSEUDO_TERMINALS = range(136, 144)
"""Their major device numbers on Linux."""


def is_network(port: str) -> bool:
    """Whether the port is a URL and not a device path."""
    return "://" in port


def open_port(settings: LineSettings) -> serial.Serial:
    """Open and lock the line's port, non-blocking; raises PortError with a message for people."""
    network = is_network(settings.port)
    try:
        port: serial.Serial = serial.serial_for_url(
            _url(settings.port),
            baudrate=settings.baudrate,
            bytesize=settings.bytesize,
            parity=settings.parity,
            stopbits=settings.stopbits,
            timeout=0,
            write_timeout=None if network else 0,
            **({} if network else {"exclusive": True}),
        )
    except (serial.SerialException, OSError, ValueError) as error:
        raise PortError(f"{settings.port}: {_reason(settings.port, error)}") from error
    if network:
        _watch(port)
    else:
        with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
            port.set_low_latency_mode(True)  # FTDI adapters hold bytes back for 16 ms otherwise
        _tell_empty_from_gone(port)
        _name_intruder(settings)
    return port


def close_port(port: serial.Serial) -> None:
    """Close it whatever state it is in; may take seconds."""
    connection: socket.socket | None = getattr(port, "_socket", None)
    if connection is None:
        with contextlib.suppress(OSError, termios.error, serial.SerialException):
            port.reset_output_buffer()  # the kernel would wait until what nobody takes is sent
    with contextlib.suppress(OSError, serial.SerialException):
        port.close()
    if connection is not None:  # pyserial leaves it open when the other end was gone already
        connection.close()


def _url(port: str) -> str:
    """The port as pyserial is given it.

    Servers answer to modem lines that a port lacks with silence; nothing here depends on that answer.
    """
    if not port.startswith("rfc2217://") or "ign_set_control" in port:
        return port
    return f"{port}{'&' if '?' in port else '?'}ign_set_control"


def _tell_empty_from_gone(port: serial.Serial) -> None:
    """Let an empty read mean that the device is gone; as pyserial sets it up, it may only mean that nothing came."""
    with contextlib.suppress(OSError, termios.error):
        attributes = termios.tcgetattr(port.fileno())
        attributes[6][termios.VMIN] = 1
        termios.tcsetattr(port.fileno(), termios.TCSANOW, attributes)


def _watch(port: serial.Serial) -> None:
    connection: socket.socket | None = getattr(port, "_socket", None)
    if connection is None:
        return
    for option, (level, value) in KEEPALIVE.items():
        with contextlib.suppress(OSError):
            connection.setsockopt(level, option, value)


def _reason(path: str, error: Exception) -> str:
    cause = error if isinstance(error, OSError) and error.errno is not None else error.__context__
    number = cause.errno if isinstance(cause, OSError) else None
    if number in {errno.EBUSY, errno.EWOULDBLOCK} or "exclusively lock" in str(error):
        holder = holder_of(path)
        return f"in use by {holder}" if holder else "in use by another program"
    if is_network(path):
        if isinstance(cause, TimeoutError):
            return "no answer to the connection attempt"
        return str(cause.strerror).lower() if isinstance(cause, OSError) and cause.strerror else str(error)
    if number == errno.ENOENT:
        return "no such device (unplugged?)"
    if number == errno.EACCES:
        return "permission denied (is the user in group dialout?)"
    return str(error)


def holder_of(path: str, *, but: int = 0) -> str:
    """Name and process id of a program that has the device open, "" when none can be seen; `but` is not named."""
    try:
        wanted = _identity(Path(path))
    except OSError:
        return ""
    for fd in Path("/proc").glob("[0-9]*/fd/*"):
        pid = int(fd.parts[2])
        try:
            if pid == but or _identity(fd) != wanted:
                continue
            name = (fd.parent.parent / "comm").read_text(encoding="utf-8").strip()
        except OSError:
            continue
        return "this program" if pid == os.getpid() else f"{name} (process {pid})"
    return ""


def _identity(path: Path) -> tuple[int, int]:
    """What one device has and no other: its number; those of pseudo terminals are of their mount, one a container."""
    found = path.stat()
    return found.st_rdev, found.st_dev if os.major(found.st_rdev) in PSEUDO_TERMINALS else 0


def _name_intruder(settings: LineSettings) -> None:
    """Warn of a program that opened the device without asking for the lock, such as a getty or ModemManager."""
    if Path(settings.port).resolve().is_relative_to("/dev/pts"):
        return  # the other end of a pty holds it too
    intruder = holder_of(settings.port, but=os.getpid())
    if intruder:
        log.warning('event=port_shared line=%s port="%s" with="%s"', settings.name, settings.port, intruder)
