"""One datagram in, one datagram or nothing out; no socket and no clock (docs/adr/0002, docs/adr/0006).

1. Order of checks: source, its allowance, size, version, then community or user, and only then the PDU. Every datagram
   ends in exactly one counter.
2. GET, GETNEXT and GETBULK follow RFC 3416 §4.2.1-4.2.3, with SNMPv1 as RFC 3584 §4 maps it. A reply is never longer
   than the configured limit and what the asker takes: GETBULK sends fewer varbinds, the others tooBig.
3. There is no code that could write. SET is answered notWritable (v1: noSuchName), whatever it names (RFC 3416 §4.2.5).
4. A credential leads to windows of our own trees and to nothing else: no MIB of pysnmp's engine is ever loaded.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from enum import Enum

from gateway.faces.snmp import reader, v3, wire
from gateway.faces.snmp.access import Access, Source, Windows
from gateway.faces.snmp.counters import SnmpCounters
from gateway.faces.snmp.reader import NotSnmp, Request, Unusual
from gateway.faces.snmp.security import Rejected, Rejection, Security
from gateway.faces.snmp.settings import SnmpSettings, View
from gateway.faces.snmp.tree import Tree, Window

_log = logging.getLogger(__name__)

DATAGRAM_LIMIT = 1472
"""Octets in one Ethernet frame after IPv4 and UDP headers; no request needs more."""

_PDU_GROWTH = 32
"""Octets of a reply around request id, community and varbinds, at most."""


class ErrorStatus(Enum):
    """Values of error-status that we send (RFC 3416 §3)."""

    NO_ERROR = 0
    TOO_BIG = 1
    NO_SUCH_NAME = 2
    GEN_ERR = 5
    NOT_WRITABLE = 17


class Refusal(Enum):
    """Why a datagram gets no answer before SNMPv3 comes into it; `label` is the reason in the log."""

    SOURCE = "source_not_listed"
    RATE = "rate"
    OVERSIZED = "oversized"
    MALFORMED = "malformed"
    VERSION = "version"
    COMMUNITY = "community"
    PDU_TYPE = "pdu_type"

    @property
    def label(self) -> str:
        """The reason in the log."""
        return self.value


class Refused(Exception):
    """The datagram is not acted upon; `report` goes back all the same, when it is not empty."""

    def __init__(self, refusal: Refusal | Rejection, report: bytes = b"") -> None:
        super().__init__(refusal.label)
        self.refusal = refusal
        self.report = report


class Responder:
    """Answers from the trees of one agent.

    `contexts` are the trees by context name; "" is the default. `security` is None as long as SNMPv3 is not spoken.
    `on_authentication_failure` is told where a message with a wrong community or digest came from.
    """

    def __init__(self, settings: SnmpSettings, contexts: Mapping[bytes, Tree], counters: SnmpCounters) -> None:
        self._contexts = contexts
        self._windows: dict[View, Windows] = {}
        self._access = Access(settings.communities, settings.users, self._windows_of, settings.requests_per_s)
        self._counters = counters
        self._v1 = settings.v1
        self._limit = settings.reply_octets
        self.security: Security | None = None
        self.on_authentication_failure: Callable[[str], None] = lambda _host: None

    def answer(self, data: bytes, host: str, now: float, context: bytes = b"") -> bytes:
        """The reply to a datagram; raises Refused when there is to be none. `context` is that of the listener."""
        counters = self._counters
        counters.in_packets += 1
        source = self._access.source(host)
        if source is None:
            counters.refused_sources += 1
            raise Refused(Refusal.SOURCE)
        if not source.take(now):
            counters.rate_limited += 1
            raise Refused(Refusal.RATE)
        if len(data) > DATAGRAM_LIMIT:
            counters.oversized += 1
            raise Refused(Refusal.OVERSIZED)
        try:
            version, start, at = reader.version(data)
            if version == reader.VERSION_2C or (version == reader.VERSION_1 and self._v1):
                community, at = reader.community(data, at)
            elif version == reader.VERSION_3 and self.security is not None:
                message = v3.parse(data, at)
                return self._secure(self.security, message, source, now, context)
            else:
                counters.bad_versions += 1
                raise Refused(Refusal.VERSION)
        except NotSnmp as error:
            counters.parse_errors += 1
            raise Refused(Refusal.MALFORMED) from error
        window = self._window(source.communities, community, context)
        if window is None:
            counters.bad_community_names += 1
            self.on_authentication_failure(host)
            raise Refused(Refusal.COMMUNITY)
        request = self._request(data, at, version)
        head = data[start:at]
        room = self._limit - len(head) - len(request.request_id) - _PDU_GROWTH
        reply = wire.tlv(0x30, head + self._pdu(window, request, version, now, room))
        counters.responses += 1
        return reply

    def rehearse(self, now: float) -> None:
        """Answer one request of each kind to nobody, so that the first real one finds everything loaded."""
        name = wire.varbind(wire.object_identifier((1, 3)), b"\x05\x00")
        for kind in (reader.GET, reader.GET_NEXT, reader.GET_BULK):
            pdu = wire.tlv(kind, wire.integer(0x02, 1) * 3 + wire.tlv(0x30, name))
            for read in (reader.plain_request, lambda pdu, at: reader.odd_request(pdu, at, reader.VERSION_2C)):
                try:
                    request = read(pdu, 0)
                except Unusual:
                    continue
                assert request is not None
                self._pdu(self._contexts[b""], request, reader.VERSION_2C, now, self._limit)

    def _secure(self, security: Security, message: v3.Message, source: Source, now: float, context: bytes) -> bytes:
        try:
            opened = security.open(message, source.users, now)
            window = source.users[message.user].get(opened.scope.context or context)
            if window is None:
                raise security.rejected(Rejection.CONTEXT, message, now, opened.user, v3.AUTH | v3.PRIV)
        except Rejected as rejected:
            if rejected.rejection is Rejection.DIGEST:
                self.on_authentication_failure(source.host)
            raise Refused(rejected.rejection, rejected.report) from None
        request = self._request(opened.plain, opened.scope.pdu_at, reader.VERSION_3)
        room = min(self._limit, message.max_size) - len(request.request_id) - _PDU_GROWTH - security.overhead(opened)
        reply = security.reply(opened, self._pdu(window, request, reader.VERSION_3, now, room), now)
        self._counters.responses += 1
        return reply

    def _windows_of(self, view: View) -> Windows:
        """What a view shows of each context; made once a view."""
        windows = self._windows.get(view)
        if windows is None:
            windows = {context: tree.window(view) for context, tree in self._contexts.items()}
            self._windows[view] = windows
        return windows

    @staticmethod
    def _window(communities: Mapping[bytes, Windows], community: bytes, context: bytes) -> Window | None:
        """What a community shows; `name@context` asks for another context than the listener's."""
        windows = communities.get(community)
        if windows is None:
            name, sign, context = community.rpartition(b"@")
            windows = communities.get(name) if sign else None
        return None if windows is None else windows.get(context)

    def _request(self, data: bytes, at: int, version: int) -> Request:
        try:
            request: Request | None = reader.plain_request(data, at)
            if version != reader.VERSION_1 or request is None or request.kind != reader.GET_BULK:
                assert request is not None
                return request
        except Unusual:
            pass
        try:
            request = reader.odd_request(data, at, version)
        except Exception as error:
            # The datagram edge: on malformed BER pyasn1 raises more than its own errors.
            self._counters.parse_errors += 1
            raise Refused(Refusal.MALFORMED) from error
        if request is None:
            self._counters.silent_drops += 1
            raise Refused(Refusal.PDU_TYPE)
        return request

    def _pdu(self, window: Window, request: Request, version: int, now: float, room: int) -> bytes:
        """The Response to a request, with varbinds of at most `room` octets."""
        window.refresh()
        status, index = ErrorStatus.NO_ERROR, 0
        varbinds: bytes | None
        try:
            if request.kind == reader.SET:
                self._counters.bad_community_uses += 1
                status, index = ErrorStatus.NOT_WRITABLE, min(1, len(request.names))
                varbinds = request.varbinds
            elif request.kind == reader.GET_BULK:
                varbinds = _bulk(window, request, now, room)
            else:
                each = _get if request.kind == reader.GET else _next
                found = [each(window, name, now) for name in request.names]
                if version == reader.VERSION_1:
                    index = next((at for at, (_, there) in enumerate(found, 1) if not there), 0)
                    status = ErrorStatus.NO_SUCH_NAME if index else status
                varbinds = b"".join([varbind for varbind, _ in found])
        except NotSnmp as error:
            self._counters.parse_errors += 1
            raise Refused(Refusal.MALFORMED) from error
        except Exception:  # noqa: BLE001 - logged with its traceback
            # The datagram edge: a defect of ours must not cost the asker its reply.
            self._counters.internal_errors += 1
            _log.exception("event=snmp_internal_error")
            status, index, varbinds = ErrorStatus.GEN_ERR, 0, b""
        if varbinds is None or len(varbinds) > room:
            status, index, varbinds = ErrorStatus.TOO_BIG, 0, b""
        if version == reader.VERSION_1 and status is not ErrorStatus.NO_ERROR:
            # RFC 1157 §4.1: an error comes with what was asked; notWritable does not exist.
            status = ErrorStatus.NO_SUCH_NAME if status is ErrorStatus.NOT_WRITABLE else status
            varbinds = request.varbinds
        return wire.response(request.request_id, status.value, index, varbinds)


def _get(window: Window, name: bytes, now: float) -> tuple[bytes, bool]:
    """The varbind for a name, and whether it has a value."""
    place = window.places.get(name)
    if place is not None:
        varbind = window.slots[place].varbind(now)
        if varbind is not None:
            return varbind, True
        return wire.varbind(name, wire.NO_SUCH_INSTANCE), False
    missing = wire.NO_SUCH_INSTANCE if window.has_object(reader.oid(name)) else wire.NO_SUCH_OBJECT
    return wire.varbind(name, missing), False


def _next(window: Window, name: bytes, now: float) -> tuple[bytes, bool]:
    """The varbind behind a name, and whether there is one."""
    found = window.from_place(_behind(window, name), now)
    return (wire.varbind(name, wire.END_OF_MIB_VIEW), False) if found is None else (found[1], True)


def _behind(window: Window, name: bytes) -> int:
    place = window.places.get(name)
    return window.place_after(reader.oid(name)) if place is None else place + 1


def _bulk(window: Window, request: Request, now: float, room: int) -> bytes | None:
    """As many varbinds as fit, in the order of RFC 3416 §4.2.3; None when not even the first does."""
    names = request.names
    single = min(request.first, len(names)) if request.first > 0 else 0
    out: list[bytes] = []
    left = room
    for name in names[:single]:
        varbind = _next(window, name, now)[0]
        left -= len(varbind)
        if left < 0:
            return b"".join(out) if out else None
        out.append(varbind)
    repeaters = names[single:]
    places = [_behind(window, name) for name in repeaters]
    from_place = window.from_place
    for _ in range(request.second if repeaters else 0):
        ended = True
        for position, place in enumerate(places):
            found = from_place(place, now)
            if found is None:
                varbind = wire.varbind(repeaters[position], wire.END_OF_MIB_VIEW)
            else:
                at, varbind = found
                places[position] = at + 1
                repeaters[position] = window.slots[at].name
                ended = False
            left -= len(varbind)
            if left < 0:
                return b"".join(out) if out else None
            out.append(varbind)
        if ended:
            break
    return b"".join(out)
