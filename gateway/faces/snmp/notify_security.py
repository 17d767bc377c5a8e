"""How notifications are put into messages, and what the answers to informs say: no socket and no clock.

1. With a community (v2c) there is nothing to it.
2. Of a trap the sender is the authoritative engine (RFC 3414 §3.1): our engine id, boots and time, so a receiver knows
   us again after a restart, and a recorded trap is old.
3. Of an inform the receiver is. It is asked who it is by a message in clear, and what time it has by one that is signed
   and too old; both answers are reports, and the second one must be signed itself. After that its time is ours to keep.
4. An answer counts only when its message id is one that we sent. What a report in clear can do is to make us learn an
   engine id, with which a stranger can do nothing: it does not know the pass phrases. That takes milliseconds, so each
   message of ours has one such answer.
"""

from __future__ import annotations

import hmac
import secrets
from dataclasses import dataclass
from typing import Protocol

from gateway.faces.snmp import reader, v3, wire
from gateway.faces.snmp.engine import Engine
from gateway.faces.snmp.reader import NotSnmp
from gateway.faces.snmp.secret import Secret
from gateway.faces.snmp.settings import Oid
from gateway.faces.snmp.usm import Credentials, LocalUser

TIME_WINDOW_S = 150
MOST_OUTSTANDING = 64
_MASK = 0x7FFFFFFF
_SALT_SIZE = 8

_USM_STATS: Oid = (1, 3, 6, 1, 6, 3, 15, 1, 1)
_REPORTS: dict[Oid, str] = {
    (*_USM_STATS, 1, 0): "security_level",
    (*_USM_STATS, 2, 0): "time_window",
    (*_USM_STATS, 3, 0): "user",
    (*_USM_STATS, 4, 0): "engine_id",
    (*_USM_STATS, 5, 0): "digest",
    (*_USM_STATS, 6, 0): "decryption",
}


@dataclass(frozen=True, slots=True)
class Heard:
    """What a datagram of a receiver says about the request that it is about."""

    request_id: int
    acknowledged: bool = False
    again: bool = False  # send it once more: what was missing is known now
    refused: str = ""  # why the receiver does not take it


class Channel(Protocol):
    """The way to one receiver."""

    def seal(self, request_id: int, pdu: bytes, now: float) -> bytes:
        """The datagram to send for a PDU."""
        ...

    def heard(self, data: bytes, now: float) -> Heard | None:
        """What a datagram says; None when it is not for us to understand. NotSnmp when it is no SNMP."""
        ...


class CommunityChannel:
    """Rule 1."""

    def __init__(self, community: Secret) -> None:
        self._head = wire.integer(0x02, reader.VERSION_2C) + wire.tlv(0x04, community.reveal())
        self._community = community

    def seal(self, request_id: int, pdu: bytes, now: float) -> bytes:
        """See Channel."""
        del request_id, now
        return wire.tlv(0x30, self._head + pdu)

    def heard(self, data: bytes, now: float) -> Heard | None:
        """See Channel."""
        del now
        version, _, at = reader.version(data)
        if version != reader.VERSION_2C:
            return None
        community, at = reader.community(data, at)
        if not hmac.compare_digest(community, self._community.reveal()):
            return None
        kind, request_id, _ = _pdu(data, at)
        return Heard(request_id, acknowledged=True) if kind == wire.RESPONSE else None


class TrapChannel:
    """Rule 2."""

    def __init__(self, credentials: Credentials, engine: Engine) -> None:
        self._engine = engine
        self._sealer = v3.Sealer(LocalUser(credentials, engine.engine_id))
        self._message_id = secrets.randbits(31)

    def seal(self, request_id: int, pdu: bytes, now: float) -> bytes:
        """See Channel."""
        del request_id
        engine = self._engine
        self._message_id = (self._message_id + 1) & _MASK
        authority = v3.Authority(engine.engine_id, engine.boots, engine.time(now))
        body = v3.scoped(engine.engine_id, b"", pdu)
        return self._sealer.seal(authority, wire.integer(0x02, self._message_id), v3.AUTH | v3.PRIV, body)

    def heard(self, data: bytes, now: float) -> Heard | None:
        """Nothing answers a trap."""
        del data, now
        return None


class InformChannel:
    """Rules 3 and 4."""

    def __init__(self, credentials: Credentials) -> None:
        self._credentials = credentials
        self._engine_id = b""
        self._user: LocalUser | None = None
        self._sealer = v3.Sealer(None)
        self._boots = 0
        self._time = 0
        self._learned_at = 0.0
        self._message_id = secrets.randbits(31)
        self._outstanding: dict[int, int] = {}  # message id → request id

    def seal(self, request_id: int, pdu: bytes, now: float) -> bytes:
        """See Channel; a question who it is, until that is known."""
        self._message_id = (self._message_id + 1) & _MASK
        self._outstanding[self._message_id] = request_id
        if len(self._outstanding) > MOST_OUTSTANDING:
            del self._outstanding[next(iter(self._outstanding))]
        message_id = wire.integer(0x02, self._message_id)
        if self._user is None:
            question = wire.tlv(reader.GET, wire.integer(0x02, request_id) + wire.integer(0x02, 0) * 2 + _NOTHING)
            return self._sealer.seal(_NOBODY, message_id, v3.REPORTABLE, v3.scoped(b"", b"", question))
        authority = v3.Authority(self._engine_id, self._boots, self._time_at(now))
        body = v3.scoped(self._engine_id, b"", pdu)
        return self._sealer.seal(authority, message_id, v3.AUTH | v3.PRIV | v3.REPORTABLE, body)

    def heard(self, data: bytes, now: float) -> Heard | None:
        """See Channel."""
        version, _, at = reader.version(data)
        if version != reader.VERSION_3:
            return None
        message = v3.parse(data, at)
        message_id, _ = reader.integer(message.message_id, 0, len(message.message_id))
        request_id = self._outstanding.get(message_id)
        if request_id is None or message.model != v3.USER_BASED:
            return None
        if not message.flags & v3.AUTH:
            return self._in_clear(message, message_id, request_id)
        return self._signed(message, message_id, request_id, now)

    def _in_clear(self, message: v3.Message, message_id: int, request_id: int) -> Heard | None:
        data = message.data
        if message.flags & v3.PRIV:
            return None
        reason = _report(data, v3.scope(data, message.body_at).pdu_at)
        if reason != "engine_id":
            return Heard(request_id, refused=reason) if reason else None
        if message.engine_id == self._engine_id:
            return Heard(request_id, again=True)
        if not 5 <= len(message.engine_id) <= 32:  # RFC 3411, SnmpEngineID
            return None
        del self._outstanding[message_id]
        self._engine_id = message.engine_id
        self._user = LocalUser(self._credentials, message.engine_id)
        self._sealer = v3.Sealer(self._user)
        self._boots = self._time = 0
        return Heard(request_id, again=True)

    def _signed(self, message: v3.Message, message_id: int, request_id: int, now: float) -> Heard | None:
        plain = self._opened(message, now)
        if plain is None:
            return None
        at = v3.scope(plain, 0).pdu_at
        kind, answered, _ = _pdu(plain, at)
        if kind == wire.REPORT:
            reason = _report(plain, at)
            return Heard(request_id, again=True) if reason == "time_window" else Heard(request_id, refused=reason)
        if kind != wire.RESPONSE or not message.flags & v3.PRIV or answered != request_id:
            return None
        self._outstanding.pop(message_id, None)
        return Heard(request_id, acknowledged=True)

    def _opened(self, message: v3.Message, now: float) -> bytes | None:
        """The scoped PDU of a signed message; None when it is not the receiver's, or not of now."""
        user, data = self._user, message.data
        if user is None or message.engine_id != self._engine_id or message.user != user.name:
            return None
        size = user.mac.size
        blank = data[: message.mac_at] + bytes(size) + data[message.mac_at + size :]
        authentic = len(message.mac) == size and hmac.compare_digest(message.mac, user.mac.of(blank))
        if not authentic or not self._in_time(message, now):
            return None
        if not message.flags & v3.PRIV:
            return data[message.body_at :]
        start, end = reader.content(data, message.body_at, len(data), 0x04)
        if len(message.salt) != _SALT_SIZE or end != len(data):
            return None
        return user.cfb.decrypt(v3.vector(message.boots, message.time, message.salt), data[start:end])

    def _time_at(self, now: float) -> int:
        return self._time + max(0, int(now - self._learned_at)) if self._boots else 0

    def _in_time(self, message: v3.Message, now: float) -> bool:
        """RFC 3414 §3.2 7b: later than what is known is learned, far earlier is refused."""
        estimate = self._time_at(now)
        if message.boots < self._boots or (message.boots == self._boots and message.time < estimate - TIME_WINDOW_S):
            return False
        if (message.boots, message.time) > (self._boots, estimate) or not self._boots:
            self._boots, self._time, self._learned_at = message.boots, message.time, now
        return True


_NOBODY = v3.Authority(b"", 0, 0)
_NOTHING = wire.tlv(0x30, b"")


def _pdu(data: bytes, at: int) -> tuple[int, int, int]:
    """Kind, request id and where the variable bindings begin, of the PDU that begins at `at` and ends with `data`."""
    if at >= len(data):
        raise NotSnmp("no PDU")
    kind = data[at]
    at, end = reader.content(data, at, len(data), kind)
    if end != len(data):
        raise NotSnmp("octets behind the PDU")
    request_id, at = reader.integer(data, at, end)
    _, at = reader.integer(data, at, end)
    _, at = reader.integer(data, at, end)
    return kind, request_id, at


def _report(data: bytes, at: int) -> str:
    """Why a message was not acted upon; "" when the PDU is no report that we know."""
    kind, _, at = _pdu(data, at)
    if kind != wire.REPORT:
        return ""
    start, end = reader.content(data, at, len(data), 0x30)
    start, _ = reader.content(data, start, end, 0x30)
    _, stop = reader.content(data, start, end, 0x06)
    return _REPORTS.get(reader.oid(data[start:stop]), "other")
