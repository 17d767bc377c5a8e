"""Looking for controllers on a line: every address at every speed that is asked for.

Rule 1: what is asked is the same on every line (looking.py).
Rule 2: an address is silent when no byte came within the time-out, and none is there that was not looked at; a reply
        that came later shows itself at the next address, and the one before is asked again with more patience.
Rule 3: a damaged answer is asked for again. One that stays damaged is reported as such: two controllers with one
        address sound like that. Noise alone is no answer.
Rule 4: the scan can be stopped between any two bytes; what was found until then counts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

import serial

from gateway.errors import PortError, ReplyCrcError, ReplyMismatch, RequestError
from gateway.lines.looking import Looker, ScanStopped, Step
from gateway.modbus.counters import RtuCounters
from gateway.modbus.rtu import RtuClient, Timing
from gateway.modbus.transactions import Failed, Replied

LOOK_S = 0.02
"""How long one look at the port takes; changing it would set up the port anew each time."""
QUARANTINE_S = 0.03
PATIENCE = 4
"""How many times the time-out an address gets that seems to answer late."""


class Scanner(Looker):
    """Asks on an open port (`gateway.lines.ports.open_port`), and blocks while it does.

    `stopping` is asked all the time; once it is true, ScanStopped is raised. PortError when the port fails.
    """

    def __init__(self, port: serial.Serial, timing: Timing, timeout_s: float, stopping: Callable[[], bool]) -> None:
        self._port = port
        self._timing = timing
        self._timeout_s = timeout_s
        self._stopping = stopping
        self._counters = RtuCounters()
        self._rtu = RtuClient(timing, self._counters, quarantine_s=QUARANTINE_S)
        port.timeout = LOOK_S
        self._rtu.reset(time.monotonic())

    def walk(self, baudrate: int, addresses: Sequence[int]) -> Iterator[Step]:
        """Ask every address in turn."""
        before: int | None = None  # the last address, when it was silent
        for address in addresses:
            strays = self._strays()
            found = self._look(baudrate, address, self._timeout_s)
            yield Step(baudrate, address, found)
            if before is not None and self._strays() > strays:
                late = self._look(baudrate, before, PATIENCE * self._timeout_s)
                if late is not None:
                    yield Step(baudrate, address, late)
            before = address if found is None else None

    def _strays(self) -> int:
        return self._counters.wrong_unit + self._counters.late_bytes

    def _ask(self, address: int, pdu: bytes, timeout_s: float) -> bytes | RequestError | None:
        """One transaction: the reply PDU, why it is damaged, or None for silence and for noise alone."""
        while self._rtu.ready_at(time.monotonic()) > time.monotonic():
            self._receive()
        now = time.monotonic()
        frame = self._rtu.send(address, pdu, now, timeout_s)
        self._write(frame)
        silent_at = now + self._timing.wire_s(len(frame)) + timeout_s
        heard = False
        event: Replied | Failed | None = None
        while event is None:
            looked_at = time.monotonic()
            heard, event = self._receive(heard=heard)
            now = time.monotonic()
            if self._is_waiting():  # it came while a busy machine did not let us look: no time has passed without it
                now = looked_at
            if event is None and not heard and now >= silent_at:
                self._rtu.reset(now)
                return None
            event = event or self._rtu.on_timer(now)
        if isinstance(event, Replied):
            return event.pdu
        return event.error if isinstance(event.error, ReplyCrcError | ReplyMismatch) else None

    def _write(self, frame: bytes) -> None:
        try:
            self._port.write(frame)
        except (OSError, serial.SerialException) as error:
            raise PortError(str(error)) from error

    def _is_waiting(self) -> bool:
        """Whether bytes are there that were not looked at."""
        try:
            return bool(self._port.in_waiting)
        except (OSError, TypeError, AttributeError, serial.SerialException) as error:
            raise PortError(str(error)) from error

    def _receive(self, *, heard: bool = False) -> tuple[bool, Replied | Failed | None]:
        """Look at the port once; tells whether bytes came, now or before, and how the transaction ended."""
        if self._stopping():
            raise ScanStopped
        try:
            data = self._port.read(1)
            data += self._port.read(self._port.in_waiting) if data else b""
        except (OSError, TypeError, AttributeError, serial.SerialException) as error:
            raise PortError(str(error)) from error
        return heard or bool(data), self._rtu.receive(bytes(data), time.monotonic())
