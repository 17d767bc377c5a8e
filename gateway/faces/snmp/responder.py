"""One datagram in, one datagram or nothing out; no socket and no clock (docs/adr/0002, docs/adr/0003).

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
from gateway.faces.snmp.answers import Answer, Answers
from gateway.faces.snmp.counters import SnmpCounters
from gateway.faces.snmp.quick import Quick
from gateway.faces.snmp.reader import NotSnmp, Request, Unusual
from gateway.faces.snmp.security import Opened, Rejected, Rejection, Security
from gateway.faces.snmp.settings import SnmpSettings, View
from gateway.faces.snmp.singles import Singles
from gateway.faces.snmp.tree import Tree, Window

_log = logging.getLogger(__name__)

DATAGRAM_LIMIT = 1472
"""Octets in one Ethernet frame after IPv4 and UDP headers; no request needs more."""

ODD_OCTETS = 22
"""What only pysnmp can read takes milliseconds: it uses up a request of its source's allowance for each so many octets,
which take as long as a plain one."""

_PDU_GROWTH = 38
"""Octets of a reply around community and varbinds, at most."""


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

    `contexts` are the trees by context name; "" is the default. `quick` answers what was asked before and is a number.
    `security` is None as long as SNMPv3 is not spoken.
    `on_authentication_failure` is told where a message with a wrong community or digest came from.
    """

    def __init__(self, settings: SnmpSettings, contexts: Mapping[bytes, Tree], counters: SnmpCounters) -> None:
        self._contexts = contexts
        self._windows: dict[View, Windows] = {}
        self._access = Access(settings.communities, settings.users, self._windows_of, settings.requests_per_s)
        self._sources = self._access.known
        self._answers = Answers()
        self._kept = self._answers.kept
        self._singles = Singles()
        self._known = self._singles.known
        self.quick = Quick(self._sources, self._singles, counters, DATAGRAM_LIMIT + 1)
        self._counters = counters
        self._v1 = settings.v1
        self._limit = settings.reply_octets
        self.security: Security | None = None
        self.on_authentication_failure: Callable[[str], None] = lambda _host: None

    def answer(self, data: bytes, host: str, now: float, context: bytes = b"") -> bytes:
        """The reply to a datagram; raises Refused when there is to be none. `context` is that of the listener."""
        counters = self._counters
        source = self._admitted(data, host, now)
        security = self.security
        opened = None if security is None else security.open_known(data, source.users, now)
        if security is not None and opened is not None:
            return self._secure(security, opened, source, now, context)
        try:
            version, start, at = reader.version(data)
            if version == reader.VERSION_2C or (version == reader.VERSION_1 and self._v1):
                community, at = reader.community(data, at)
            elif version == reader.VERSION_3 and security is not None:
                return self._secure(security, self._opened(security, data, at, source, now), source, now, context)
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
        request = self._request(data, at, version, source)
        head = data[start:at]
        room = self._limit - len(head) - _PDU_GROWTH
        answer = self._read(Answer(window, request, version, room=room, head=head, grant=source.communities), now)
        counters.responses += 1
        if request.id_at and not context and version == reader.VERSION_2C:
            self._remember(data, request, window, answer)
        return answer.before + request.request_id[2:] + answer.after

    def _admitted(self, data: bytes, host: str, now: float) -> Source:
        """What may be used from `host`, before the datagram is read; raises Refused."""
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
        return source

    def again(self, data: bytes, host: str, now: float) -> bytes | None:
        """The reply to a request of a community that was answered before in the default context; the caller counts it.

        None when it is not known: `answer` has to look at it.
        """
        source = self._sources.get(host)
        if source is None or source.left < 1.0:
            return None
        at = reader.message_id_at(data)
        if not at:
            return None
        beginning = data[:at]
        way = self._known.get(beginning)
        if way is not None:
            self._singles.usual = slice(at)
            reply = self._singles.reply(way, data, source.communities, now)
        else:
            rest = at + data[at - 1]
            reply = self._kept_reply(beginning + data[rest:], data[at:rest], source.communities, None, now)
        if reply is not None:
            source.left -= 1.0
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
                answer = Answer(
                    self._contexts[b""], request, reader.VERSION_2C, room=self._limit, head=None, grant=None
                )
                answer.read(self._counters, now)

    def _opened(self, security: Security, data: bytes, at: int, source: Source, now: float) -> Opened:
        """The SNMPv3 message whose version ends at `at`; raises Refused, and NotSnmp."""
        try:
            return security.open(v3.parse(data, at), source.users, now)
        except Rejected as rejected:
            if rejected.rejection is Rejection.DIGEST:
                self.on_authentication_failure(source.host)
            raise Refused(rejected.rejection, rejected.report) from None

    def _secure(self, security: Security, opened: Opened, source: Source, now: float, context: bytes) -> bytes:
        """The reply to a message that was opened; raises Refused."""
        window = source.users[opened.user.name].get(opened.context or context)
        if window is None:
            rejected = security.rejected(Rejection.CONTEXT, opened, now, opened.user, v3.AUTH | v3.PRIV)
            raise Refused(rejected.rejection, rejected.report)
        plain, at, room = opened.plain, opened.pdu_at, opened.room
        pdu = self._pdu_again(plain, at, window, room, now)
        if pdu is None:
            request = self._request(plain, at, reader.VERSION_3, source)
            answer = self._read(Answer(window, request, reader.VERSION_3, room=room, head=None, grant=window), now)
            if request.id_at:
                self._remember(plain, request, window, answer)
            pdu = answer.before + request.request_id[2:] + answer.after
        reply = security.reply(opened, pdu, now)
        self._counters.responses += 1
        return reply

    def _pdu_again(self, plain: bytes, at: int, window: Window, room: int, now: float) -> bytes | None:
        """The Response to a scoped PDU whose own PDU begins at `at`, if it was answered before."""
        try:
            at, size = reader.id_place(plain, at)
        except IndexError:
            return None
        way = self._known.get(plain[:at])
        if way is not None:
            return None if way[-1].room > room else self._singles.reply(way, plain, window, now)
        request_id = plain[at : at + size]
        return self._kept_reply(plain[:at] + plain[at + size :], request_id, window, room, now)

    def _kept_reply(self, key: bytes, request_id: bytes, grant: object, room: int | None, now: float) -> bytes | None:
        """A reply that is kept, made anew if what it shows has changed; `room` None: as it was."""
        answer = self._kept.get(key)
        if answer is None or answer.grant is not grant or (room is not None and answer.room != room):
            return None
        if not answer.holds() and not self._renewed(key, answer, now):
            return None
        return answer.before + request_id + answer.after

    def _remember(self, data: bytes, request: Request, window: Window, answer: Answer) -> None:
        """Keep what helps to answer the same again: `data` ends with the request."""
        if request.kind != reader.GET_BULK and len(request.names) == 1:
            self._singles.learn(data, request, window, room=answer.room, head=answer.head, grant=answer.grant)
        elif answer.lasting:
            self._answers.keep(_without_id(data, request), answer)

    def _renewed(self, key: bytes, answer: Answer, now: float) -> bool:
        """Read anew for an answer whose devices have changed; False when it cannot be kept any more."""
        answer.read(self._counters, now)
        if not answer.lasting:
            self._answers.drop(key)
        return answer.lasting

    def _read(self, answer: Answer, now: float) -> Answer:
        try:
            answer.read(self._counters, now)
        except NotSnmp as error:
            self._counters.parse_errors += 1
            raise Refused(Refusal.MALFORMED) from error
        return answer

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

    def _request(self, data: bytes, at: int, version: int, source: Source) -> Request:
        try:
            request: Request | None = reader.plain_request(data, at)
            if version != reader.VERSION_1 or request is None or request.kind != reader.GET_BULK:
                assert request is not None
                return request
        except Unusual:
            pass
        source.left -= len(data) / ODD_OCTETS
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


def _without_id(data: bytes, request: Request) -> bytes:
    return data[: request.id_at] + data[request.id_at + len(request.request_id) - 2 :]
