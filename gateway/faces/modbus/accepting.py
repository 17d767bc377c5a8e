"""Listening sockets, and what happens when there are no descriptors for those who want in.

Rule 1: clients never get the last `SPARE_DESCRIPTORS`: the serial lines and the HTTP face need theirs.
Rule 2: when there are no others, nothing is accepted for `ACCEPT_PAUSE_S`; who wants in waits in the kernel's queue.
        That costs no work in between, and a log line a minute.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import resource
import select
import socket
from collections.abc import Callable
from typing import Any

from gateway.core.log_budget import LogBudget
from gateway.faces.modbus.sockets import Hub

logger = logging.getLogger(__name__)

ACCEPT_TURN = 32
ACCEPT_PAUSE_S = 1.0
SPARE_DESCRIPTORS = 32

_NO_DESCRIPTORS = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


class Acceptor:
    """A listening socket: `take` gets every accepted one, non-blocking, with its peer's address."""

    def __init__(self, hub: Hub, sock: socket.socket, label: str, take: Callable[[socket.socket, Any], None]) -> None:
        self.sock = sock
        self.pauses = 0
        self._hub = hub
        self._label = label
        self._take = take
        self._pause: asyncio.TimerHandle | None = None
        self._told = LogBudget()
        hub.add(sock.fileno(), select.EPOLLIN, self._event, None)

    def close(self) -> None:
        """Accept no more; connections that nobody has accepted are refused."""
        if self._pause is not None:
            self._pause.cancel()
        self._hub.remove(self.sock.fileno())
        self.sock.close()

    def _event(self, _events: int) -> None:
        for _ in range(ACCEPT_TURN):
            try:
                sock, peername = self.sock.accept()
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                if error.errno in _NO_DESCRIPTORS:
                    self._wait_for_descriptors(error.strerror or str(error))
                    return
                continue  # that one went before it was accepted
            if sock.fileno() >= resource.getrlimit(resource.RLIMIT_NOFILE)[0] - SPARE_DESCRIPTORS:
                sock.close()
                self._wait_for_descriptors("only spare descriptors are left")
                return
            sock.settimeout(0.0)
            self._take(sock, peername)

    def _wait_for_descriptors(self, reason: str) -> None:
        self.pauses += 1
        loop = asyncio.get_running_loop()
        if self._told.spend(reason, loop.time()) is not None:
            logger.warning('event=accept_paused listener="%s" reason="%s" pauses=%d', self._label, reason, self.pauses)
        self._hub.change(self.sock.fileno(), 0)
        self._pause = loop.call_later(ACCEPT_PAUSE_S, self._again)

    def _again(self) -> None:
        self._pause = None
        self._hub.change(self.sock.fileno(), select.EPOLLIN)
