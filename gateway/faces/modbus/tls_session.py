"""TLS on one connection: the protocol of a socket's transport, and the transport of a Modbus connection.

Rule 1: the connection is let in or refused as without TLS, before a byte is read; it is served when the handshake is
        done and the door (tls.py) has seen the client's certificate. It knows nothing of TLS (R-05).
Rule 2: a handshake ends within `handshake_timeout_s` of its first byte's chance, a record within `frame_timeout_s` of
        its first byte. Nothing waits for a handshake but its own connection.
Rule 3: a handshake that fails has one reason, out of `REASONS`; the client gets OpenSSL's alert and the connection
        ends (R-10, R-11).
Rule 4: memory is bounded by one record, what the transport below holds back, and `MAX_HELD_BACK` bytes of replies that
        go out together.
Rule 5: no exception leaves this file.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol, cast

from gateway.core.clients import Client
from gateway.errors import CertificateRefused
from gateway.faces.modbus.connection import MAX_HELD_BACK, Connection

logger = logging.getLogger(__name__)

RECORD_BYTES = 16384

_VERIFY_REASONS = {  # OpenSSL's X509_V_ERR_*
    3: "crl_missing",
    9: "certificate_not_yet_valid",
    10: "certificate_expired",
    11: "crl_out_of_date",
    12: "crl_out_of_date",
    2: "issuer_unknown",
    18: "issuer_unknown",
    19: "issuer_unknown",
    20: "issuer_unknown",
    21: "issuer_unknown",
    23: "certificate_revoked",
    26: "certificate_usage",
}
_SSL_REASONS = {
    "PEER_DID_NOT_RETURN_A_CERTIFICATE": "no_certificate",
    "UNSUPPORTED_PROTOCOL": "version_too_old",
    "NO_SHARED_CIPHER": "no_shared_cipher",
    "HTTP_REQUEST": "not_tls",
    "HTTPS_PROXY_REQUEST": "not_tls",
    "WRONG_VERSION_NUMBER": "not_tls",
    "UNKNOWN_PROTOCOL": "not_tls",
}
REASONS = frozenset(
    {*_VERIFY_REASONS.values(), *_SSL_REASONS.values(), "certificate_invalid", "role_malformed", "refused_by_client"}
    | {"name_not_allowed", "address_not_in_certificate", "certificate_unreadable"}
    | {"timeout", "hung_up", "rate_limited", "protocol_error", "internal"}
)
"""Every label under which a failed handshake is counted."""


class Door(Protocol):
    """Who decides on a client that has shown its certificate."""

    def affords(self, client: Client) -> bool:
        """Whether a client may shake hands now."""
        ...

    def context(self) -> ssl.SSLContext:
        """A context for one connection."""
        ...

    def enter(self, session: TlsSession, certificate: bytes) -> None:
        """Let a client with this certificate (DER) in; CertificateRefused when it cannot be served."""
        ...

    def refuse(self, peer: str, reason: str, why: str = "") -> None:
        """A handshake failed; `why` says more than the reason, in words without quotes."""
        ...

    def left(self, session: TlsSession) -> None:
        """A session is over."""
        ...


class TlsSession(asyncio.Transport, asyncio.Protocol):
    """One client's TLS session."""

    def __init__(
        self, connection: Connection, door: Door, *, handshake_timeout_s: float, frame_timeout_s: float
    ) -> None:
        super().__init__()
        self.connection = connection
        self._door = door
        self._handshake_timeout_s = handshake_timeout_s
        self._frame_timeout_s = frame_timeout_s
        self._raw: asyncio.Transport = cast("asyncio.Transport", None)  # from connection_made on
        self._received = ssl.MemoryBIO()
        self._to_send = ssl.MemoryBIO()
        self._tls: ssl.SSLObject | None = None
        self._records = _Records()
        self._done = False  # the handshake is, and the client is let in
        self._failed = False
        self._closing = False
        self._reading = True
        self._busy = False  # records are being read: what is written goes out together
        self._timer: asyncio.TimerHandle | None = None

    # What the transport below calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Ask whether the client may come in (rule 1), and wait for its handshake."""
        self._raw = cast("asyncio.Transport", transport)
        self.connection.connection_made(self)
        if not self._closing:
            self._guarded(self._begin)

    def data_received(self, data: bytes) -> None:
        """Shake hands, or hand over what was in the records."""
        self._received.write(data)
        self._records.feed(data)
        self._guarded(self._advance)

    def eof_received(self) -> bool:
        """The client sends no more, with or without saying so in TLS."""
        self._guarded(self._ended)
        return not self._closing

    def pause_writing(self) -> None:
        """The client does not take its replies."""
        self.connection.pause_writing()

    def resume_writing(self) -> None:
        """The client took its replies."""
        self.connection.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """The end."""
        if not self._done and not self._failed and self._tls is not None:
            self._failed = True
            self._door.refuse(self.connection.peer, "hung_up")
        self._closing = True
        self._stop_timer()
        self._door.left(self)
        self.connection.connection_lost(exc)

    # What the connection calls

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """What the transport below knows, and `ssl_object`."""
        return self._tls if name == "ssl_object" else self._raw.get_extra_info(name, default)

    def get_protocol(self) -> asyncio.BaseProtocol:
        """The connection."""
        return self.connection

    def is_closing(self) -> bool:
        """Whether `close` or `abort` was called, or the connection is lost."""
        return self._closing

    def is_reading(self) -> bool:
        """Whether requests are taken."""
        return self._reading

    def pause_reading(self) -> None:
        """Leave what comes to the kernel."""
        self._reading = False
        self._raw.pause_reading()

    def resume_reading(self) -> None:
        """Take what comes again, and first what is here."""
        self._reading = True
        self._raw.resume_reading()
        self._watch_record()
        if not self._busy:
            asyncio.get_running_loop().call_soon(self._guarded, self._advance)

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """As of the transport below; a record adds some 30 bytes to what is written."""
        self._raw.set_write_buffer_limits(high, low)

    def get_write_buffer_size(self) -> int:
        """Bytes that the kernel has not taken, or was not given yet."""
        return self._raw.get_write_buffer_size() + self._to_send.pending

    def can_write_eof(self) -> bool:
        """It ends with `close` only."""
        return False

    def write(self, data: bytes | bytearray | memoryview[Any]) -> None:
        """Send `data` after all that was written before."""
        if self._closing or self._tls is None:
            return
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._tls.write(rest) :]
        except ssl.SSLError:
            self.abort()
            return
        if not self._busy or self._to_send.pending >= MAX_HELD_BACK:
            self._flush()

    def close(self) -> None:
        """Take nothing more, send the rest and that it was all, then end the connection."""
        if self._closing:
            return
        self._closing = True
        if self._done and self._tls is not None:
            with suppress(ssl.SSLError, OSError):  # the client's own "that was all" is not waited for
                self._tls.unwrap()
        self._flush()
        self._raw.close()

    def abort(self) -> None:
        """End the connection now."""
        self._closing = True
        self._raw.abort()

    # The way in

    def _begin(self) -> None:
        if not self._door.affords(self.connection.client):
            self._refuse("rate_limited")
            return
        self._tls = self._door.context().wrap_bio(self._received, self._to_send, server_side=True)
        self._start_timer(self._handshake_timeout_s)

    def _advance(self) -> None:
        if self._closing or self._tls is None or not (self._done or self._shake_hands(self._tls)):
            return
        self._busy = True
        try:
            self._read(self._tls)
        finally:
            self._busy = False
            self._flush()
        self._watch_record()

    def _shake_hands(self, tls: ssl.SSLObject) -> bool:
        """Go on with the handshake; whether it is done."""
        try:
            tls.do_handshake()
            self._flush()
            self._acknowledge()
            self._stop_timer()
            self._door.enter(self, tls.getpeercert(binary_form=True) or b"")
        except ssl.SSLWantReadError:
            self._flush()
            return False
        except ssl.SSLError as error:
            self._refuse(_reason(error))
            return False
        except CertificateRefused as error:
            self._done = True  # so that the client is told properly that it ends
            self._refuse(error.reason, str(error))
            return False
        self._done = True
        return True

    def _acknowledge(self) -> None:
        """Have the kernel acknowledge the handshake's last message now.

        Under TLS 1.3 nothing answers it, and a client with Nagle's algorithm would hold its first request for 40 ms.
        """
        sock = self._raw.get_extra_info("socket")
        if sock is not None and hasattr(socket, "TCP_QUICKACK"):
            with suppress(OSError):  # a client that is gone already; its end is reported in the ordinary way
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

    def _read(self, tls: ssl.SSLObject) -> None:
        while self._reading and not self._closing:
            try:
                data = tls.read(RECORD_BYTES)
            except ssl.SSLWantReadError:
                return
            except ssl.SSLZeroReturnError:
                data = b""
            except ssl.SSLError:
                self.connection.end("tls_broken")
                return
            if not data:
                self._ended()
                return
            self.connection.data_received(data)

    def _ended(self) -> None:
        if not self._done:
            self._refuse("hung_up")
        elif not self._closing and not self.connection.eof_received():
            self.close()

    def _refuse(self, reason: str, why: str = "") -> None:
        if self._failed:
            return
        self._failed = True
        self._stop_timer()
        self._door.refuse(self.connection.peer, reason, why)
        self.connection.end("tls_refused")

    def _flush(self) -> None:
        data = self._to_send.read()
        if data:
            self._raw.write(data)

    # Time

    def _watch_record(self) -> None:
        """See that a record that has begun is completed in time (rule 2)."""
        if not self._done or self._closing:
            return
        if not self._records.partial:
            self._stop_timer()
        elif self._timer is None:
            self._start_timer(self._frame_timeout_s)

    def _start_timer(self, timeout_s: float) -> None:
        self._timer = asyncio.get_running_loop().call_later(timeout_s, self._guarded, self._too_slow)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _too_slow(self) -> None:
        self._timer = None
        if not self._done:
            self._refuse("timeout")
        elif self._reading and not self._closing:  # else it is not the client who is slow
            self.connection.end("slow_frame")

    def _guarded(self, step: Callable[[], None]) -> None:
        """Rule 5."""
        try:
            step()
        except Exception:
            logger.exception("event=connection_failed peer=%s", self.connection.peer)
            if not self._done and not self._failed:
                self._failed = True
                self._door.refuse(self.connection.peer, "internal")
            self.connection.end("error")
            self.abort()


class _Records:
    """Whether what was received ends within a record (RFC 5246 6.2.1: type, version, length, then so many bytes)."""

    def __init__(self) -> None:
        self._head = b""
        self._left = 0

    @property
    def partial(self) -> bool:
        return bool(self._head or self._left)

    def feed(self, data: bytes) -> None:
        at = 0
        while at < len(data):
            if self._left:
                step = min(self._left, len(data) - at)
                self._left -= step
                at += step
                continue
            step = 5 - len(self._head)
            self._head += data[at : at + step]
            at += step
            if len(self._head) == 5:
                self._left = int.from_bytes(self._head[3:5])
                self._head = b""


def _reason(error: ssl.SSLError) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return _VERIFY_REASONS.get(error.verify_code, "certificate_invalid")
    reason = error.reason or ""
    if "_ALERT_" in reason:
        return "refused_by_client"
    return _SSL_REASONS.get(reason, "protocol_error")
