"""What systemd is told (sd_notify(3)): ready, reloading, stopping, and that the gateway is alive.

Datagrams to the socket that the environment names; without one nothing is sent. It is our own because it is less
than what a library would have to be asked for: the ones on offer are unkept, or are built against libsystemd.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from contextlib import suppress


class Systemd:
    """The service manager that started this process, or nobody."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # An address that begins with @ is in the abstract namespace, which Linux spells with a zero byte.
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self.watchdog_s = _watchdog_s(environment) if address else None
        """How often it must be told that we are alive, at least; None: it does not want to know."""

    def ready(self, status: str) -> None:
        """Started, or reloaded; `status` is for people."""
        self._tell(f"READY=1\nSTATUS={status}")

    def reloading(self, monotonic_s: float) -> None:
        """The configuration is being read again, since `monotonic_s` (CLOCK_MONOTONIC)."""
        self._tell(f"RELOADING=1\nMONOTONIC_USEC={int(monotonic_s * 1e6)}")

    def stopping(self) -> None:
        """On its way out."""
        self._tell("STOPPING=1")

    def alive(self, status: str) -> None:
        """Feed the watchdog; `status` is for people."""
        self._tell(f"WATCHDOG=1\nSTATUS={status}")

    def _tell(self, text: str) -> None:
        if not self._address:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            sender.setblocking(False)  # noqa: FBT003 - its only parameter, and positional-only
            sender.sendto(text.encode(), self._address)


def _watchdog_s(environment: Mapping[str, str]) -> float | None:
    """WATCHDOG_USEC, if it is meant for this process (sd_watchdog_enabled(3))."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    text = environment.get("WATCHDOG_USEC", "")
    return int(text) / 1e6 if text.isascii() and text.isdigit() and int(text) > 0 else None
