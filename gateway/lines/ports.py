"""Opening a port by pyserial, and saying plainly why it cannot be opened.

Any pyserial URL works: a device path, `rfc2217://host:port`, `socket://host:port`. A device path is
locked (flock) so that no second program speaks on the line.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

import serial

from gateway.core.settings import LineSettings
from gateway.errors import PortError

CONNECT_TIMEOUT_S = 5.0


def open_port(settings: LineSettings) -> serial.Serial:
    """Open and lock the line's port, non-blocking; raises PortError with a message for people. Blocks."""
    is_url = "://" in settings.port
    try:
        port: serial.Serial = serial.serial_for_url(
            settings.port,
            baudrate=settings.baudrate,
            bytesize=settings.bytesize,
            parity=settings.parity,
            stopbits=settings.stopbits,
            timeout=0,
            write_timeout=None if is_url else 0,
            **({} if is_url else {"exclusive": True}),
        )
    except (serial.SerialException, OSError, ValueError) as error:
        raise PortError(f"{settings.port}: {_reason(settings.port, error)}") from error
    return port


def _reason(path: str, error: Exception) -> str:
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.ENOENT:
        return "no such device (unplugged?)"
    if number == errno.EACCES:
        return "permission denied (is the user in group dialout?)"
    if number in {errno.EBUSY, errno.EWOULDBLOCK} or "exclusively lock" in str(error):
        holder = _holder(path)
        return f"in use by {holder}" if holder else "in use by another program"
    return str(error)


def _holder(path: str) -> str:
    """Name and process id of a program that has the device open; "" when none can be seen."""
    try:
        wanted = Path(path).stat().st_rdev
    except OSError:
        return ""
    for fd in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if fd.stat().st_rdev != wanted or fd.parts[2] == str(os.getpid()):
                continue
            name = (fd.parent.parent / "comm").read_text(encoding="utf-8").strip()
        except OSError:
            continue
        return f"{name} (process {fd.parts[2]})"
    return ""
