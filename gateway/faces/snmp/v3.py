"""The SNMPv3 message (RFC 3412 §6, RFC 3414 §2.4) as octets: taken apart and put together, nothing decided."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from gateway.faces.snmp import wire
from gateway.faces.snmp.reader import VERSION_3, NotSnmp, content, integer
from gateway.faces.snmp.usm import LocalUser

AUTH = 0x01
PRIV = 0x02
REPORTABLE = 0x04
USER_BASED = 3
"""msgSecurityModel of USM."""

MIN_MAX_SIZE = 484
"""RFC 3412 §6.1: every engine takes messages of this size."""

MAX_USER_NAME = 32
"""RFC 3414 §2.4."""

OWN_MAX_SIZE = 1472
"""What we take: one Ethernet frame after IPv4 and UDP headers."""

_VERSION = wire.integer(0x02, VERSION_3)
_GLOBAL_TAIL = wire.integer(0x02, USER_BASED)
_FLAGS = [wire.tlv(0x04, bytes((flags,))) for flags in range(8)]


class Message:
    """A message that came, its security not yet looked at."""

    __slots__ = (
        "body_at", "boots", "data", "engine_id", "flags", "mac", "mac_at", "max_size", "message_id", "model", "salt",
        "time", "user",
    )  # fmt: skip

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.message_id = b""  # encoded INTEGER
        self.max_size = 0
        self.flags = 0
        self.model = 0
        self.engine_id = b""
        self.boots = 0
        self.time = 0
        self.user = b""
        self.mac_at = 0  # where the authenticator is in `data`
        self.mac = b""
        self.salt = b""
        self.body_at = 0  # where the scoped PDU, plain or encrypted, begins


class Authority(NamedTuple):
    """The authoritative engine of a message, at its moment."""

    engine_id: bytes
    boots: int
    time: int


@dataclass(frozen=True, slots=True)
class Scope:
    """The context of a PDU, and where that begins."""

    engine_id: bytes
    context: bytes
    pdu_at: int


def parse(data: bytes, at: int) -> Message:
    """The message whose version ends at `at`; NotSnmp when it is none."""
    message = Message(data)
    end = len(data)
    first, body = content(data, at, end, 0x30)
    number, at = integer(data, first, body)
    message.message_id = data[first:at]
    message.max_size, at = integer(data, at, body)
    start, at = content(data, at, body, 0x04)
    flags = data[start:at]
    message.model, at = integer(data, at, body)
    if len(flags) != 1 or at != body or number < 0 or message.max_size < MIN_MAX_SIZE or message.model < 1:
        raise NotSnmp("msgGlobalData")
    message.flags = flags[0]
    if message.model != USER_BASED:
        return message
    start, after = content(data, body, end, 0x04)
    at, stop = content(data, start, after, 0x30)
    first, at = content(data, at, stop, 0x04)
    message.engine_id = data[first:at]
    message.boots, at = integer(data, at, stop)
    message.time, at = integer(data, at, stop)
    first, at = content(data, at, stop, 0x04)
    message.user = data[first:at]
    message.mac_at, at = content(data, at, stop, 0x04)
    message.mac = data[message.mac_at : at]
    first, at = content(data, at, stop, 0x04)
    message.salt = data[first:at]
    if at != stop or stop != after or message.boots < 0 or message.time < 0 or len(message.user) > MAX_USER_NAME:
        raise NotSnmp("msgSecurityParameters")
    message.body_at = after
    return message


def scope(data: bytes, at: int) -> Scope:
    """The scoped PDU at `at`, which ends with `data`; NotSnmp when there is none."""
    start, end = content(data, at, len(data), 0x30)
    if end != len(data):
        raise NotSnmp("octets behind the scoped PDU")
    first, at = content(data, start, end, 0x04)
    engine_id = data[first:at]
    first, at = content(data, at, end, 0x04)
    return Scope(engine_id, data[first:at], at)


def scoped(engine_id: bytes, context: bytes, pdu: bytes) -> bytes:
    """A scoped PDU."""
    return wire.tlv(0x30, wire.tlv(0x04, engine_id) + wire.tlv(0x04, context) + pdu)


def vector(boots: int, time: int, salt: bytes) -> bytes:
    """The initialization vector of AES (RFC 3826 §3.1.2.1)."""
    return boots.to_bytes(4, "big") + time.to_bytes(4, "big") + salt


class Sealer:
    """Makes messages of one user at one authoritative engine; `user` None: in clear, without a name.

    What stands between the message id and the authenticator changes once a second and is kept.
    """

    __slots__ = ("_authority", "_before", "_heads", "_size", "_user", "_vector")

    def __init__(self, user: LocalUser | None, max_size: int = OWN_MAX_SIZE) -> None:
        self._user = user
        self._size = wire.integer(0x02, max_size)
        fixed = len(self._size + _FLAGS[0] + _GLOBAL_TAIL)
        # What stands before a message id of so many octets: 10 when its length takes five.
        self._heads = [_VERSION + wire.head(0x30, size + fixed) for size in range(11)]
        self._authority: Authority | None = None
        self._before = [b""] * 8  # by flags
        self._vector = b""  # the first half of one

    def seal(self, authority: Authority, message_id: bytes, flags: int, body: bytes) -> bytes:
        """A whole message around the scoped PDU `body`, signed and encrypted as `flags` say.

        `message_id` is an encoded INTEGER. Without a user the flags AUTH and PRIV cannot be set.
        """
        if authority is not self._authority:
            self._authority = authority
            self._before = [self._between(authority, flags) for flags in range(8)]
            self._vector = vector(authority.boots, authority.time, b"")
        user = self._user
        start = self._heads[len(message_id)] + message_id + self._before[flags]
        if user is None or not flags & AUTH:
            return wire.tlv(0x30, start + _EMPTY + _EMPTY + body)
        if flags & PRIV:
            salt = user.salt()
            sealed = user.cfb.encrypt(self._vector + salt, body)
            rest = _SALT + salt + wire.head(0x04, len(sealed)) + sealed
        else:
            rest = _EMPTY + body
        mac = user.mac
        start = wire.head(0x30, len(start) + mac.size + len(rest)) + start
        return start + mac.of(start + mac.blank + rest) + rest

    def _between(self, authority: Authority, flags: int) -> bytes:
        """What stands behind the message id, up to the octets of the authenticator if there is one."""
        user = self._user if flags & AUTH else None
        name, mac = (b"", 0) if user is None else (user.name, user.mac.size)
        salt = 8 if user is not None and flags & PRIV else 0
        head = wire.tlv(0x04, authority.engine_id) + wire.integer(0x02, authority.boots)
        head += wire.integer(0x02, authority.time) + wire.tlv(0x04, name)
        inner = len(head) + 2 + mac + 2 + salt
        sequence = wire.head(0x30, inner)
        before = wire.head(0x04, len(sequence) + inner) + sequence + head
        return self._size + _FLAGS[flags] + _GLOBAL_TAIL + before + (wire.head(0x04, mac) if mac else b"")


_EMPTY = wire.tlv(0x04, b"")
_SALT = wire.head(0x04, 8)
