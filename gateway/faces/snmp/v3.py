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

OWN_MAX_SIZE = 1472
"""What we take: one Ethernet frame after IPv4 and UDP headers."""

_VERSION = wire.integer(0x02, VERSION_3)
_GLOBAL_TAIL = wire.integer(0x02, USER_BASED)
_FLAGS = [wire.tlv(0x04, bytes((flags,))) for flags in range(8)]
_SIZE = wire.integer(0x02, OWN_MAX_SIZE)


@dataclass(frozen=True, slots=True)
class Message:
    """A message that came, its security not yet looked at."""

    data: bytes
    message_id: bytes  # encoded INTEGER
    max_size: int
    flags: int
    model: int
    engine_id: bytes
    boots: int
    time: int
    user: bytes
    mac_at: int  # where the authenticator is in `data`
    mac: bytes
    salt: bytes
    body_at: int  # where the scoped PDU, plain or encrypted, begins


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
    end = len(data)
    first, body = content(data, at, end, 0x30)
    message_id, at = integer(data, first, body)
    encoded_id = data[first:at]
    max_size, at = integer(data, at, body)
    start, at = content(data, at, body, 0x04)
    model, at_end = integer(data, at, body)
    if at - start != 1 or at_end != body or message_id < 0 or max_size < MIN_MAX_SIZE or model < 1:
        raise NotSnmp("msgGlobalData")
    flags = data[start]
    if model != USER_BASED:
        return Message(data, encoded_id, max_size, flags, model, b"", 0, 0, b"", 0, b"", b"", 0)
    start, after = content(data, body, end, 0x04)
    at, stop = content(data, start, after, 0x30)
    first, at = content(data, at, stop, 0x04)
    engine_id = data[first:at]
    boots, at = integer(data, at, stop)
    time, at = integer(data, at, stop)
    first, at = content(data, at, stop, 0x04)
    user = data[first:at]
    mac_at, at = content(data, at, stop, 0x04)
    mac = data[mac_at:at]
    first, at = content(data, at, stop, 0x04)
    if at != stop or stop != after or boots < 0 or time < 0 or len(user) > 32:
        raise NotSnmp("msgSecurityParameters")
    return Message(
        data, encoded_id, max_size, flags, model, engine_id, boots, time, user, mac_at, mac, data[first:at], after
    )


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


def seal(user: LocalUser | None, authority: Authority, message_id: bytes, flags: int, body: bytes) -> bytes:
    """A whole message around the scoped PDU `body`, signed and encrypted as `flags` say.

    `message_id` is an encoded INTEGER; `user` may be None without AUTH and PRIV.
    """
    engine_id, boots, time = authority
    name, mac, salt = b"", b"", b""
    if flags & AUTH:
        assert user is not None
        name, mac = user.name, bytes(user.mac.size)
    if flags & PRIV:
        assert user is not None
        salt = user.salt()
        body = wire.tlv(0x04, user.cfb.encrypt(vector(boots, time, salt), body))
    head = wire.tlv(0x04, engine_id) + wire.integer(0x02, boots) + wire.integer(0x02, time) + wire.tlv(0x04, name)
    tail = wire.tlv(0x04, salt)
    security = wire.tlv(0x04, wire.tlv(0x30, head + wire.tlv(0x04, mac) + tail))
    rest = wire.tlv(0x30, message_id + _SIZE + _FLAGS[flags] + _GLOBAL_TAIL) + security + body
    message = wire.tlv(0x30, _VERSION + rest)
    if user is None or not flags & AUTH:
        return message
    stop = len(message) - len(body) - len(tail)
    return message[: stop - user.mac.size] + user.mac.of(message) + message[stop:]
