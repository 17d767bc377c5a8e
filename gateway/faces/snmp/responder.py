"""One datagram in, one datagram or nothing out; no socket and no clock (docs/adr/0002).

1. Order of checks: source, size, version and community (`wire.peek`), and only then decoding, by pysnmp's message
   classes. Every datagram ends in exactly one counter.
2. GET, GETNEXT and GETBULK follow RFC 3416 §4.2.1-4.2.3. A reply is never longer than REPLY_LIMIT: GETBULK sends fewer
   varbinds, the others tooBig.
3. There is no code that could write. SET is answered notWritable, whatever it names (RFC 3416 §4.2.5).
4. Nothing but our own tree is reachable from here: no MIB of pysnmp's engine is ever loaded.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from pyasn1.codec.ber import decoder, encoder
from pysnmp.proto import rfc1901, rfc1905

from gateway.faces.snmp import wire
from gateway.faces.snmp.access import Access, Address
from gateway.faces.snmp.counters import SnmpCounters
from gateway.faces.snmp.settings import Oid
from gateway.faces.snmp.tree import Tree

_log = logging.getLogger(__name__)

DATAGRAM_LIMIT = 1472
"""Octets in one Ethernet frame after IPv4 and UDP headers; no request needs more."""

REPLY_LIMIT = 1400
"""Octets of the longest reply: fits a frame over IPv6 and a tunnel, so it is never cut on the way."""

MAX_ARCS = 128
"""RFC 2578 §3.5: an OID has no more."""

_LENGTH_GROWTH = 6
"""The lengths of message, PDU and list each take one octet when empty and at most three when full."""


class ErrorStatus(Enum):
    """Values of error-status that we send (RFC 3416 §3)."""

    NO_ERROR = 0
    TOO_BIG = 1
    GEN_ERR = 5
    NOT_WRITABLE = 17


class Refusal(Enum):
    """Why a datagram gets no answer; the value is the reason in the log."""

    SOURCE = "source_not_listed"
    OVERSIZED = "oversized"
    MALFORMED = "malformed"
    VERSION = "version"
    COMMUNITY = "community"
    PDU_TYPE = "pdu_type"


class Refused(Exception):
    """The datagram is dropped."""

    def __init__(self, refusal: Refusal) -> None:
        super().__init__(refusal.value)
        self.refusal = refusal


@dataclass(frozen=True, slots=True)
class Request:
    """A decoded PDU of one of the four kinds that an agent answers."""

    pdu: Any  # of pysnmp.proto.rfc1905
    request_id: int
    names: tuple[Oid, ...]


class Responder:
    """Answers SNMPv2c from a tree."""

    def __init__(self, access: Access, tree: Tree, counters: SnmpCounters) -> None:
        self._access = access
        self._tree = tree
        self._counters = counters

    def answer(self, data: bytes, source: Address, now: float) -> bytes:
        """The reply to a datagram; raises Refused when there is to be none."""
        counters = self._counters
        counters.in_packets += 1
        if not self._access.listed(source):
            counters.refused_sources += 1
            raise Refused(Refusal.SOURCE)
        if len(data) > DATAGRAM_LIMIT:
            counters.oversized += 1
            raise Refused(Refusal.OVERSIZED)
        try:
            version, community = wire.peek(data)
        except wire.NotSnmp as error:
            counters.parse_errors += 1
            raise Refused(Refusal.MALFORMED) from error
        if version != wire.VERSION_2C:
            counters.bad_versions += 1
            raise Refused(Refusal.VERSION)
        if not self._access.may_read(community, source):
            counters.bad_community_names += 1
            raise Refused(Refusal.COMMUNITY)
        request = self._decode(data)
        try:
            reply = self._respond(request, community, now)
        except Exception:  # noqa: BLE001 - the datagram edge: a defect of ours must not cost the asker its reply
            counters.internal_errors += 1
            _log.exception("snmp_internal_error source=%s", source)
            reply = wire.response(community, request.request_id, ErrorStatus.GEN_ERR.value, 0, b"")
        counters.responses += 1
        return reply

    def rehearse(self, now: float) -> None:
        """Answer one request of each kind to nobody, so that the first real one finds everything loaded."""
        name = wire.varbind(wire.object_identifier((1, 3)), b"\x05\x00")
        for tag in _READ_TAGS:
            pdu = wire.integer(0x02, 1) + wire.integer(0x02, 0) + wire.integer(0x02, 1) + wire.tlv(0x30, name)
            message = wire.integer(0x02, wire.VERSION_2C) + wire.tlv(0x04, b"") + wire.tlv(tag, pdu)
            request = _decode(wire.tlv(0x30, message))
            assert request is not None
            self._respond(request, b"", now)

    def _decode(self, data: bytes) -> Request:
        try:
            request = _decode(data)
        except Exception as error:
            # The datagram edge: on malformed BER pyasn1 raises more than its own errors.
            self._counters.parse_errors += 1
            raise Refused(Refusal.MALFORMED) from error
        if request is None:
            self._counters.silent_drops += 1
            raise Refused(Refusal.PDU_TYPE)
        return request

    def _respond(self, request: Request, community: bytes, now: float) -> bytes:
        def reply(status: ErrorStatus, index: int, varbinds: bytes) -> bytes:
            return wire.response(community, request.request_id, status.value, index, varbinds)

        self._tree.refresh()
        room = REPLY_LIMIT - len(reply(ErrorStatus.NO_ERROR, 0, b"")) - _LENGTH_GROWTH
        pdu = request.pdu
        status, index = ErrorStatus.NO_ERROR, 0
        varbinds: bytes | None
        if isinstance(pdu, rfc1905.GetBulkRequestPDU):
            varbinds = self._bulk(request.names, int(pdu[1]), int(pdu[2]), now, room)
        elif isinstance(pdu, rfc1905.GetNextRequestPDU):
            varbinds = b"".join(self._next(name, now)[1] for name in request.names)
        elif isinstance(pdu, rfc1905.GetRequestPDU):
            varbinds = b"".join(self._get(name, now) for name in request.names)
        else:
            self._counters.bad_community_uses += 1
            status, index = ErrorStatus.NOT_WRITABLE, min(1, len(request.names))
            varbinds = b"".join(encoder.encode(pair) for pair in pdu[3])
        if varbinds is None or len(varbinds) > room:
            return reply(ErrorStatus.TOO_BIG, 0, b"")
        return reply(status, index, varbinds)

    def _get(self, name: Oid, now: float) -> bytes:
        found = self._tree.get(name, now)
        if found is not None:
            return found
        missing = wire.NO_SUCH_INSTANCE if self._tree.has_object(name) else wire.NO_SUCH_OBJECT
        return wire.varbind(wire.object_identifier(name), missing)

    def _next(self, name: Oid, now: float) -> tuple[Oid | None, bytes]:
        """The successor and its varbind; None for the successor at the end of the view."""
        found = self._tree.after(name, now)
        if found is not None:
            return found
        return None, wire.varbind(wire.object_identifier(name), wire.END_OF_MIB_VIEW)

    def _bulk(
        self, names: Sequence[Oid], non_repeaters: int, max_repetitions: int, now: float, room: int
    ) -> bytes | None:
        """As many varbinds as fit, in the order of RFC 3416 §4.2.3; None when not even the first does."""
        single = max(0, min(non_repeaters, len(names)))
        out: list[bytes] = []
        used = 0
        repeaters = list(names[single:])

        def fits(varbind: bytes) -> bool:
            nonlocal used
            if used + len(varbind) > room:
                return False
            used += len(varbind)
            out.append(varbind)
            return True

        for name in names[:single]:
            if not fits(self._next(name, now)[1]):
                return b"".join(out) if out else None
        for _ in range(max_repetitions if repeaters else 0):
            ended = True
            for position, name in enumerate(repeaters):
                successor, varbind = self._next(name, now)
                if not fits(varbind):
                    return b"".join(out) if out else None
                if successor is not None:
                    repeaters[position] = successor
                    ended = False
            if ended:
                break
        return b"".join(out)


_READ_TAGS = (0xA0, 0xA1, 0xA5)
"""GetRequest, GetNextRequest and GetBulkRequest (RFC 3416 §3)."""

_ANSWERED = (
    rfc1905.GetRequestPDU,
    rfc1905.GetNextRequestPDU,
    rfc1905.GetBulkRequestPDU,
    rfc1905.SetRequestPDU,
)


def _decode(data: bytes) -> Request | None:
    """The request in a message, None when it is no request; raises anything at all on malformed BER."""
    message, rest = decoder.decode(data, asn1Spec=rfc1901.Message())
    if rest:
        raise wire.NotSnmp("octets behind the message")
    pdu = message[2].getComponent()
    if not isinstance(pdu, _ANSWERED):
        return None
    names = tuple(tuple(int(arc) for arc in pair[0]) for pair in pdu[3])
    for name in names:
        if len(name) > MAX_ARCS or any(arc > 0xFFFFFFFF for arc in name):
            raise wire.NotSnmp("not an OID that SNMP allows")
    return Request(pdu, int(pdu[0]), names)
