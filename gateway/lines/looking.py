"""What a scan asks at an address, whatever the line is, and what it finds there.

Rule 1: only reads are ever sent: one register to find who is there, Read Device Identification and the serial number
        to tell what it is. A device without identification is found all the same.
Rule 2: a damaged answer is asked for again. One that stays damaged is reported as such.
Rule 3: the scan can be stopped at any time; what was found until then counts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

from gateway.devices.agreement import map_of_product
from gateway.devices.model import DeviceMap, Identification, Space
from gateway.devices.texts import decode_text
from gateway.errors import RequestError
from gateway.modbus.pdu import Function, ReadRequest, is_exception, parse_identification, read_identification_request

TRIES = 3
PROBE = ReadRequest(Function.READ_HOLDING_REGISTERS, 0, 1).encode()


class ScanStopped(Exception):
    """Somebody wants the scan to end."""


@dataclass(frozen=True, slots=True)
class Found:
    """Something at an address. `model` is None for what does not say that it is one we have a map of."""

    baudrate: int  # 0 where there is none: Modbus TCP
    address: int
    identification: Identification | None = None
    model: str | None = None
    serial_number: str | None = None
    damaged: bool = False  # at least one of its answers was


@dataclass(frozen=True, slots=True)
class Step:
    """One address was asked. `found` is about `address`, or about the one before it."""

    baudrate: int
    address: int
    found: Found | None


class Looker(ABC):
    """Asks at one address after the other."""

    @abstractmethod
    def _ask(self, address: int, pdu: bytes, timeout_s: float) -> bytes | RequestError | None:
        """One transaction: the reply PDU, why it is damaged, or None for silence."""

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
