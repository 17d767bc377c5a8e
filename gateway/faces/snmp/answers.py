"""Replies, and how long they may be given again.

Pollers ask the same questions all day, with another request id. Rules:

1. A reply is found by its whole request without the octets of the request id, so what is found was checked once, octet
   by octet, and only the id has to be put in.
2. It is kept with the snapshots that it was made of, those of the devices whose cells were stepped over among them. As
   long as each of these devices still has that snapshot, it is the reply; otherwise the same reading is done again.
   A reply with a clock or a counter is not kept, nor is an error.
3. It is given only to who had the same rights at the time (`grant`), and within the same `room`.
4. What is kept is bounded, in number and octets; the longest kept goes first.
"""

from __future__ import annotations

import logging
from enum import Enum

from gateway.core.site import Device
from gateway.core.snapshot import Snapshot
from gateway.faces.snmp import reader, wire
from gateway.faces.snmp.counters import SnmpCounters
from gateway.faces.snmp.reader import NotSnmp, Request
from gateway.faces.snmp.reading import Reading
from gateway.faces.snmp.tree import Window

_log = logging.getLogger(__name__)

TOLD = 1000
"""Of so many answers that failed for a mistake of ours, one is logged: a datagram is quickly sent."""

MOST_ANSWERS = 4096
MOST_OCTETS = 2 << 20
_OBJECT_OCTETS = 500
"""What an answer takes besides its octets, about."""


class ErrorStatus(Enum):
    """Values of error-status that we send (RFC 3416 §3)."""

    NO_ERROR = 0
    TOO_BIG = 1
    NO_SUCH_NAME = 2
    GEN_ERR = 5
    NOT_WRITABLE = 17


class _Nothing:
    """In the place of a device for replies that depend on none."""

    snapshot = Snapshot()


_NOTHING = _Nothing()


class Answer:
    """A request of somebody, and the reply to it in two parts, with the octets of the request id between them.

    `head` is what stands before the PDU in a message with a community; None where the reply is only a PDU.
    `reading` may raise NotSnmp.
    """

    __slots__ = (
        "_device",
        "_devices",
        "_marks",
        "_request",
        "_seen",
        "_spans",
        "_version",
        "_window",
        "after",
        "before",
        "charged",
        "grant",
        "head",
        "lasting",
        "room",
    )

    def __init__(
        self, window: Window, request: Request, version: int, *, room: int, head: bytes | None, grant: object
    ) -> None:
        self._window = window
        self._request = request
        self._version = version
        self.head = head
        self.room = room
        self.grant = grant
        self.before = self.after = b""
        self.lasting = False  # whether it may be kept
        self.charged = 0  # octets that it was counted as when it was kept
        self._spans: list[tuple[int, int]] = []
        self._device: Device | _Nothing = _NOTHING
        self._devices: tuple[Device, ...] = ()
        self._seen = _NOTHING.snapshot.mark
        self._marks: list[object] = []

    def holds(self) -> bool:
        """Whether every device still has the snapshot that it had."""
        return self._device.snapshot.mark is self._seen and (
            not self._devices or [device.snapshot.mark for device in self._devices] == self._marks
        )

    def read(self, counters: SnmpCounters, now: float) -> None:
        """Make the reply of what there is now. Raises NotSnmp when a name is none."""
        self._window.refresh()
        reading = Reading(self._window, now)
        varbinds: bytes | None
        try:
            status, index, varbinds = self._read(reading, counters)
        except NotSnmp:
            raise
        except Exception:  # noqa: BLE001 - the datagram edge: a defect of ours must not cost the asker its reply
            counters.internal_errors += 1
            if counters.internal_errors % TOLD == 1:
                _log.exception("event=snmp_internal_error count=%d", counters.internal_errors)
            status, index, varbinds = ErrorStatus.GEN_ERR, 0, b""
        if varbinds is None or len(varbinds) > self.room:
            status, index, varbinds = ErrorStatus.TOO_BIG, 0, b""
        if status is ErrorStatus.NO_ERROR:
            self._depend(reading)
        else:
            self.lasting = False
            if self._version == reader.VERSION_1:
                # RFC 1157 §4.1: an error comes with what was asked; notWritable does not exist.
                status = ErrorStatus.NO_SUCH_NAME if status is ErrorStatus.NOT_WRITABLE else status
                varbinds = self._request.varbinds
        self._put(wire.result(status.value, index, varbinds))

    def octets(self) -> int:
        """What it takes of memory, about."""
        return len(self.before) + len(self.after) + 16 * len(self._devices) + _OBJECT_OCTETS

    def _read(self, reading: Reading, counters: SnmpCounters) -> tuple[ErrorStatus, int, bytes | None]:
        """Error status, index and varbinds; None instead of these for too many."""
        request = self._request
        if request.too_many:
            return ErrorStatus.TOO_BIG, 0, None
        if request.kind == reader.SET:
            counters.bad_community_uses += 1
            return ErrorStatus.NOT_WRITABLE, min(1, len(request.names)), request.varbinds
        if request.kind == reader.GET_BULK:
            return ErrorStatus.NO_ERROR, 0, reading.bulk(request, self.room)
        each = reading.get if request.kind == reader.GET else reading.next
        found = [each(name) for name in request.names]
        varbinds = b"".join([varbind for varbind, _ in found])
        index = 0
        if self._version == reader.VERSION_1:
            index = next((at for at, (_, there) in enumerate(found, 1) if not there), 0)
        return ErrorStatus.NO_SUCH_NAME if index else ErrorStatus.NO_ERROR, index, varbinds

    def _depend(self, reading: Reading) -> None:
        """Remember the devices and their snapshots; the reading of this very moment was made of them."""
        if reading.spans != self._spans or not self.lasting:
            devices = reading.devices()
            self.lasting = devices is not None
            if not devices:
                self._device, self._seen, self._devices = _NOTHING, _NOTHING.snapshot.mark, ()
                return
            self._spans = reading.spans
            self._device, self._devices = devices[0], tuple(devices[1:])
        self._seen = self._device.snapshot.mark
        self._marks = [device.snapshot.mark for device in self._devices]

    def _put(self, result: bytes) -> None:
        request_id = self._request.request_id
        before = wire.head(wire.RESPONSE, len(request_id) + len(result)) + request_id[:2]
        if self.head is not None:
            size = len(self.head) + len(before) + len(request_id) - 2 + len(result)
            before = wire.head(0x30, size) + self.head + before
        self.before, self.after = before, result


class Answers:
    """The answers that are kept, by request without its id."""

    def __init__(self) -> None:
        self.kept: dict[bytes, Answer] = {}
        self._octets = 0

    def keep(self, key: bytes, answer: Answer) -> None:
        """Remember a lasting answer, in the place of an older one to the same request."""
        self.drop(key)
        self.kept[key] = answer
        answer.charged = len(key) + answer.octets()
        self._octets += answer.charged
        while len(self.kept) > MOST_ANSWERS or self._octets > MOST_OCTETS:
            self.drop(next(iter(self.kept)))

    def drop(self, key: bytes) -> None:
        """Forget the answer to a request, if it is known."""
        known = self.kept.pop(key, None)
        if known is not None:
            self._octets -= known.charged
