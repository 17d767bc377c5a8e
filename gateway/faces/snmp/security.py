"""Incoming SNMPv3 messages: RFC 3412 §7.2 and RFC 3414 §3.2, in their order, for an engine that is authoritative.

Rules:

1. Whatever does not pass is a `Rejected` with the counter that RFC 3411 and 3414 name for it; where a report is due, it
   goes back in clear, or signed for notInTimeWindow, which the asker must be able to believe.
2. There is one security level: authPriv. A known user that asks with less is answered unsupportedSecLevel, so no
   level is left at which access would have to be refused later.
3. A user that is known but not from this address does not exist here.
4. A message that is authentic and does not decrypt to a scoped PDU was encrypted with another key: decryptionErrors.
5. Who has passed once is opened by the short way (`askers.py`), which compares what it does not read; what it does not
   expect goes the whole way, which is the only one that rejects.
"""

from __future__ import annotations

import hmac
from collections.abc import Container, Iterable
from enum import Enum
from typing import Self

from gateway.faces.snmp import v3, wire
from gateway.faces.snmp.askers import Askers
from gateway.faces.snmp.counters import SnmpCounters
from gateway.faces.snmp.engine import MAX_BOOTS, Engine
from gateway.faces.snmp.reader import NotSnmp, content
from gateway.faces.snmp.settings import Oid
from gateway.faces.snmp.usm import Credentials, LocalUser

TIME_WINDOW_S = 150
"""RFC 3414 §2.2.3."""

_USM_STATS: Oid = (1, 3, 6, 1, 6, 3, 15, 1, 1)
_MPD_STATS: Oid = (1, 3, 6, 1, 6, 3, 11, 2, 1)
_SALT_SIZE = 8


class Rejection(Enum):
    """Why a message is not acted upon: reason in the log, field of SnmpCounters, OID of the report if one is due."""

    SECURITY_MODEL = ("security_model", "unknown_security_models", None)
    INVALID = ("invalid_flags", "invalid_messages", None)
    ENGINE_ID = ("engine_id", "unknown_engine_ids", (*_USM_STATS, 4, 0))
    USER = ("user", "unknown_user_names", (*_USM_STATS, 3, 0))
    LEVEL = ("security_level", "unsupported_security_levels", (*_USM_STATS, 1, 0))
    DIGEST = ("digest", "wrong_digests", (*_USM_STATS, 5, 0))
    TIME_WINDOW = ("time_window", "not_in_time_windows", (*_USM_STATS, 2, 0))
    DECRYPTION = ("decryption", "decryption_errors", (*_USM_STATS, 6, 0))
    CONTEXT = ("context", "unknown_contexts", (1, 3, 6, 1, 6, 3, 12, 1, 5, 0))
    CONTEXT_ENGINE = ("context_engine", "unknown_pdu_handlers", (*_MPD_STATS, 3, 0))

    def __init__(self, label: str, field: str, oid: Oid | None) -> None:
        self.label = label
        self.field = field
        self.oid = oid


class Rejected(Exception):
    """The message is not acted upon; `report` goes back to its sender, when not empty."""

    def __init__(self, rejection: Rejection, report: bytes) -> None:
        super().__init__(rejection.label)
        self.rejection = rejection
        self.report = report


class Opened:
    """A message of an authenticated user, decrypted; `room` is what its asker and the limit leave for a PDU."""

    __slots__ = ("context", "flags", "message_id", "pdu_at", "plain", "room", "user")

    def __init__(self, user: LocalUser, message_id: bytes, flags: int, room: int) -> None:
        self.user = user
        self.message_id = message_id  # encoded INTEGER
        self.flags = flags
        self.room = room
        self.plain = b""
        self.context = b""
        self.pdu_at = 0

    def decrypted(self, plain: bytes, context: bytes, pdu_at: int) -> Self:
        """The same with the scoped PDU, the name of its context, and where the PDU begins in it."""
        self.plain = plain
        self.context = context
        self.pdu_at = pdu_at
        return self


class Security:
    """The users of one engine."""

    def __init__(self, engine: Engine, users: Iterable[Credentials], counters: SnmpCounters, limit: int) -> None:
        """A reply has at most `limit` octets, whatever its asker takes."""
        self.engine = engine
        self._counters = counters
        self._limit = limit
        self._users = {each.name: LocalUser(each, engine.engine_id) for each in users}
        self._sealers = {name: v3.Sealer(user) for name, user in self._users.items()}
        self._clear = v3.Sealer(None)
        self._authority = v3.Authority(engine.engine_id, engine.boots, 0)
        self._askers = Askers()
        self._scope = v3.scoped(engine.engine_id, b"", b"")[2:]  # engine id and name of the default context

    def open(self, message: v3.Message, usable: Container[bytes], now: float) -> Opened:
        """Check and decrypt a message; `usable` are the names that count where it came from. Raises Rejected."""
        flags = message.flags
        if message.model != v3.USER_BASED:
            raise self.rejected(Rejection.SECURITY_MODEL, message, now)
        if flags & v3.PRIV and not flags & v3.AUTH:
            raise self.rejected(Rejection.INVALID, message, now)
        engine = self.engine
        if message.engine_id != engine.engine_id:
            raise self.rejected(Rejection.ENGINE_ID, message, now)
        user = self._users.get(message.user) if message.user in usable else None
        if user is None:
            raise self.rejected(Rejection.USER, message, now)
        if not flags & v3.PRIV:
            raise self.rejected(Rejection.LEVEL, message, now)
        if not self._authentic(message, user):
            raise self.rejected(Rejection.DIGEST, message, now)
        if message.boots != engine.boots or engine.boots >= MAX_BOOTS or not self._timely(message.time, now):
            raise self.rejected(Rejection.TIME_WINDOW, message, now, user, v3.AUTH)
        plain, scope = self._decrypted(message, user, now)
        if scope.engine_id != engine.engine_id:
            raise self.rejected(Rejection.CONTEXT_ENGINE, message, now, user, v3.AUTH | v3.PRIV)
        most = min(self._limit, message.max_size) - self._overhead(user)
        self._askers.learn(message, user, most)
        opened = Opened(user, message.message_id, flags, most - len(scope.context))
        return opened.decrypted(plain, scope.context, scope.pdu_at)

    def open_known(self, data: bytes, usable: Container[bytes], now: float) -> Opened | None:
        """What `open` makes of a message to the default context by who passed it before; None: `open` has to look."""
        found = self._askers.open(data)
        if found is None:
            return None
        asker, message_id, plain = found
        if asker.user.name not in usable or not self._timely(asker.time, now):
            return None
        if len(plain) < 2:
            return None
        size = plain[1]
        start = 2 if size < 0x80 else size - 0x7E
        scope = self._scope
        if not plain.startswith(scope, start) or plain[:start] != wire.head(0x30, len(plain) - start):
            return None
        return Opened(asker.user, message_id, asker.flags, asker.room).decrypted(plain, b"", start + len(scope))

    def reply(self, opened: Opened, pdu: bytes, now: float) -> bytes:
        """The message that answers `opened` with `pdu`."""
        if opened.context:
            body = v3.scoped(self.engine.engine_id, opened.context, pdu)
        else:
            body = wire.head(0x30, len(self._scope) + len(pdu)) + self._scope + pdu
        sealer = self._sealers[opened.user.name]
        return sealer.seal(self._authority_at(now), opened.message_id, v3.AUTH | v3.PRIV, body)

    def _overhead(self, user: LocalUser) -> int:
        """Octets of a reply in the default context around the varbinds, at most."""
        return 138 + len(self.engine.engine_id) * 2 + len(user.name) + user.mac.size

    def _timely(self, time: int, now: float) -> bool:
        return -TIME_WINDOW_S <= time - self.engine.time(now) <= TIME_WINDOW_S

    def rejected(
        self,
        rejection: Rejection,
        message: v3.Message | Opened,
        now: float,
        user: LocalUser | None = None,
        flags: int = 0,
    ) -> Rejected:
        """Count, and make the exception with the report that is due, sent at the level that `flags` say."""
        count = getattr(self._counters, rejection.field) + 1
        setattr(self._counters, rejection.field, count)
        # RFC 3412 §7.1.3: a report only to who asked for one; what cannot be read has no request id, so 0.
        if rejection.oid is None or not message.flags & v3.REPORTABLE:
            return Rejected(rejection, b"")
        pdu = wire.tlv(wire.REPORT, _PDU_HEAD + wire.tlv(0x30, wire.counter(rejection.oid, count)))
        body = v3.scoped(self.engine.engine_id, b"", pdu)
        self._counters.reports += 1
        sealer = self._clear if user is None else self._sealers[user.name]
        return Rejected(rejection, sealer.seal(self._authority_at(now), message.message_id, flags, body))

    def _authority_at(self, now: float) -> v3.Authority:
        """This engine at `now`; the same object within a second."""
        time = self.engine.time(now)
        if time != self._authority.time:
            self._authority = v3.Authority(self.engine.engine_id, self.engine.boots, time)
        return self._authority

    @staticmethod
    def _authentic(message: v3.Message, user: LocalUser) -> bool:
        size = user.mac.size
        if len(message.mac) != size:
            return False
        data, at = message.data, message.mac_at
        return hmac.compare_digest(message.mac, user.mac.of(data[:at] + bytes(size) + data[at + size :]))

    def _decrypted(self, message: v3.Message, user: LocalUser, now: float) -> tuple[bytes, v3.Scope]:
        data = message.data
        try:
            start, end = content(data, message.body_at, len(data), 0x04)
            if len(message.salt) == _SALT_SIZE and end == len(data):
                plain = user.cfb.decrypt(v3.vector(message.boots, message.time, message.salt), data[start:end])
                return plain, v3.scope(plain, 0)
        except NotSnmp:
            pass
        raise self.rejected(Rejection.DECRYPTION, message, now, user, v3.AUTH)


_PDU_HEAD = wire.integer(0x02, 0) * 3
"""Request id, error status and error index of a report."""
