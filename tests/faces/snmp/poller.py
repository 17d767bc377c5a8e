"""A poller of SNMPv3: it signs in as RFC 3414 §4 says, and reads its replies with pysnmp's classes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from ipaddress import ip_network
from typing import Any

from pyasn1.codec.ber import decoder, encoder
from pysnmp.proto import rfc1905
from pysnmp.proto.api import v2c

from gateway.faces.snmp import reader, v3, wire
from gateway.faces.snmp.secret import Secret
from gateway.faces.snmp.settings import Oid, User
from gateway.faces.snmp.usm import Auth, Credentials, LocalUser, Priv

LOOPBACK = (ip_network("127.0.0.0/8"), ip_network("::1/128"))
AUTH_PHRASE, PRIV_PHRASE = "authentic phrase", "private phrase"
USM_STATS = (1, 3, 6, 1, 6, 3, 15, 1, 1)
NOBODY = v3.Authority(b"", 0, 0)
AUTH_PRIV = v3.AUTH | v3.PRIV | v3.REPORTABLE


def credentials(
    name: str = "noc",
    auth: Auth = Auth.SHA_256,
    priv: Priv = Priv.AES_128,
    phrases: tuple[str, str] = (AUTH_PHRASE, PRIV_PHRASE),
) -> Credentials:
    return Credentials(name.encode(), auth, Secret(phrases[0].encode()), priv, Secret(phrases[1].encode()))


def a_user(name: str = "noc", auth: Auth = Auth.SHA_256, priv: Priv = Priv.AES_128) -> User:
    return User(credentials(name, auth, priv), LOOPBACK)


def pdu(kind: type, *names: Oid, bulk: tuple[int, int] = (0, 10), request_id: int = 4711) -> bytes:
    made = kind()
    if kind is v2c.GetBulkRequestPDU:
        v2c.apiBulkPDU.set_defaults(made)
        v2c.apiBulkPDU.set_non_repeaters(made, bulk[0])
        v2c.apiBulkPDU.set_max_repetitions(made, bulk[1])
    else:
        v2c.apiPDU.set_defaults(made)
    value = v2c.OctetString(b"mine") if kind is v2c.SetRequestPDU else v2c.null
    v2c.apiPDU.set_varbinds(made, [(name, value) for name in names])
    v2c.apiPDU.set_request_id(made, request_id)
    encoded: bytes = encoder.encode(made)
    return encoded


@dataclass(frozen=True)
class Read:
    """A reply of SNMPv3, read."""

    flags: int
    boots: int
    time: int
    kind: str  # class of the PDU
    request_id: int
    status: int
    names: list[Oid]
    values: list[Any]
    pdu: bytes


@dataclass
class Poller:
    """`exchange(datagram)` gives the reply or None."""

    exchange: Callable[[bytes], bytes | None]
    credentials: Credentials = field(default_factory=credentials)
    authority: v3.Authority = NOBODY
    context: bytes = b""
    max_size: int = v3.OWN_MAX_SIZE
    user: LocalUser | None = None
    message_id: int = 77

    def sign_in(self) -> None:
        found = self.learn(self.sealed(pdu(v2c.GetRequestPDU), v3.REPORTABLE))
        self.user = LocalUser(self.credentials, found.engine_id)
        self.authority = v3.Authority(found.engine_id, 0, 0)
        found = self.learn(self.sealed(pdu(v2c.GetRequestPDU), AUTH_PRIV))
        self.authority = v3.Authority(found.engine_id, found.boots, found.time)

    def learn(self, data: bytes) -> v3.Message:
        reply = self.exchange(data)
        assert reply is not None
        return v3.parse(reply, reader.version(reply)[2])

    def sealed(self, body: bytes, flags: int = AUTH_PRIV, engine_id: bytes | None = None) -> bytes:
        self.message_id += 1
        scoped = v3.scoped(self.authority.engine_id if engine_id is None else engine_id, self.context, body)
        sealer = v3.Sealer(self.user if flags & v3.AUTH else None, self.max_size)
        return sealer.seal(self.authority, wire.integer(0x02, self.message_id), flags, scoped)

    def ask(self, kind: type, *names: Oid, bulk: tuple[int, int] = (0, 10)) -> Read | None:
        reply = self.exchange(self.sealed(pdu(kind, *names, bulk=bulk)))
        return None if reply is None else self.read(reply)

    def read(self, data: bytes) -> Read:
        """Check authenticator and id, decrypt, and read with pysnmp."""
        message = v3.parse(data, reader.version(data)[2])
        assert reader.integer(message.message_id, 0, len(message.message_id))[0] == self.message_id
        plain = data[message.body_at :]
        if message.flags & v3.AUTH:
            assert self.user is not None
            size = self.user.mac.size
            blank = data[: message.mac_at] + bytes(size) + data[message.mac_at + size :]
            assert self.user.mac.of(blank) == message.mac
        if message.flags & v3.PRIV:
            assert self.user is not None
            first, end = reader.content(data, message.body_at, len(data), 0x04)
            vector = v3.vector(message.boots, message.time, message.salt)
            plain = self.user.cfb.decrypt(vector, data[first:end])
        body = plain[v3.scope(plain, 0).pdu_at :]
        found, rest = decoder.decode(body, asn1Spec=rfc1905.PDUs())
        assert rest == b""
        read = found.getComponent()
        return Read(
            message.flags,
            message.boots,
            message.time,
            type(read).__name__,
            int(read[0]),
            int(read[1]),
            [tuple(pair[0]) for pair in read[3]],
            [pair[1].getComponent() for pair in read[3]],
            body,
        )


def statistic(read: Read | None, oid: Sequence[int]) -> int:
    """The counter that a report shows; fails when it is no report of this counter."""
    assert read is not None
    assert (read.kind, read.names) == ("ReportPDU", [tuple(oid)])
    return int(read.values[0].getComponent().getComponent())
