"""Looking for controllers on a line: every address at every speed that is asked for.

Rule 1: only reads are ever sent: one register to find who is there, Read Device Identification and the serial number
        to tell what it is. A device without identification is found all the same.
Rule 2: an address is silent when no byte came within the time-out, and none is there that was not looked at; a reply
        that came later shows itself at the next address, and the one before is asked again with more patience.
Rule 3: a damaged answer is asked for again. One that stays damaged is reported as such: two controllers with one
        address sound like that. Noise alone is no answer.
Rule 4: the scan can be stopped between any two bytes; what was found until then counts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import serial

from gateway.devices.agreement import map_of_product
from gateway.devices.model import DeviceMap, Identification, Space
from gateway.devices.texts import decode_text
from gateway.errors import PortError, ReplyCrcError, ReplyMismatch, RequestError
from gateway.modbus.counters import RtuCounters
from gateway.modbus.pdu import Function, ReadRequest, is_exception, parse_identification, read_identification_request
from gateway.modbus.rtu import RtuClient, Timing
from gateway.modbus.transactions import Failed, Replied

LOOK_S = 0.02
"""How long one look at the port takes; changing it would set up the port anew each time."""
QUARANTINE_S = 0.03
TRIES = 3
PATIENCE = 4
"""How many times the time-out an address gets that seems to answer late."""

PROBE = ReadRequest(Function.READ_HOLDING_REGISTERS, 0, 1).encode()


class ScanStopped(Exception):
    """Somebody wants the scan to end."""


@dataclass(frozen=True, slots=True)
class Found:
    """Something at an address. `model` is None for what does not say that it is one we have a map of."""

    baudrate: int
    address: int
    identification: Identification | None = None
    model: str | None = None
    serial_number: str | None = None
    damaged: bool = False  # at least one of its answers was


@dataclass(frozen=True, slots=True)
class Step:
    """One address was asked. `found` is about `address`, or about the one before it (rule 2)."""

    baudrate: int
    address: int
    found: Found | None


class Scanner:
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

    def _look(self, baudrate: int, address: int, timeout_s: float) -> Found | None:
        found: Found | None = None
        for _ in range(TRIES):
            answer = self._ask(address, PROBE, timeout_s)
            if answer is None and found is None:
                return None
            found = found or Found(baudrate, address)
            if isinstance(answer, bytes):
                break
            found = replace(found, damaged=True)
        assert found is not None
        return self._name(found, timeout_s)

    def _name(self, found: Found, timeout_s: float) -> Found:
        answer = self._insist(found.address, read_identification_request(), timeout_s)
        if answer is None:
            return found
        try:
            objects = parse_identification(answer).objects
        except RequestError:
            return found
        texts = (objects.get(number, b"").decode("ascii", "replace").strip("\0 ") for number in range(3))
        identification = Identification(*texts)
        device_map = map_of_product(identification.product)
        if device_map is None:
            return replace(found, identification=identification)
        return replace(
            found,
            identification=identification,
            model=device_map.model,
            serial_number=self._serial_number(found.address, device_map, timeout_s),
        )

    def _serial_number(self, address: int, device_map: DeviceMap, timeout_s: float) -> str | None:
        rules = device_map.identity
        if rules.serial_first is None:
            return None
        function = device_map.read_function(Space.REGISTERS)
        request = ReadRequest(function, rules.serial_first, rules.serial_words).encode()
        answer = self._insist(address, request, timeout_s)
        if answer is None:
            return None
        text = decode_text("ascii", answer[2:], rules.serial_order)
        return None if text is None or " " in text else text

    def _insist(self, address: int, pdu: bytes, timeout_s: float) -> bytes | None:
        """The reply to one of a few tries, or None; an exception is no reply here."""
        for _ in range(TRIES):
            answer = self._ask(address, pdu, timeout_s)
            if isinstance(answer, bytes):
                return None if is_exception(answer) else answer
            if answer is None:
                return None
        return None

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
