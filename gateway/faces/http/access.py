"""Who may ask the HTTP face: names with passwords, or a bearer token, each from a file.

Rule 1: without a file everybody may ask; with one or both, whoever shows any of the credentials. `/healthz` is open
        to all: it tells nothing, and what watches processes has no secret.
Rule 2: what was shown is compared in constant time with every credential there is, as digests.
Rule 3: a secret is in no message, and digests are all that is kept of it.
Rule 4: files are read when a listener starts and when the configuration is read again; one that cannot be used keeps
        the listener closed, or what was read before in use, and never opens to all. A TLS context is never loaded
        again: one that met half of a renewed pair has neither certificate.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import os
import ssl
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gateway.errors import ListenError
from gateway.faces.http.request import NO_STORE, Handler, Reply, Request
from gateway.faces.http.settings import HttpSettings

OPEN_PATHS = frozenset({"/healthz"})
TOKEN_CHARACTERS = 16
"""A token has at least so many."""

_REALM = "prostar-gateway"


def _digest(text: bytes) -> bytes:
    return hashlib.sha256(text).digest()


@dataclass(frozen=True, slots=True, repr=False)
class Access:
    """The credentials of one listener; none: everybody may ask."""

    passwords: tuple[bytes, ...] = ()  # digests of name:password
    token: bytes | None = None  # its digest

    @classmethod
    def read(cls, settings: HttpSettings) -> Access:
        """What the files of the settings hold; ListenError names the file and what is wrong with it."""
        passwords: tuple[bytes, ...] = ()
        token: bytes | None = None
        if settings.basic_auth_file:
            passwords = tuple(map(_digest, read_passwords(settings.basic_auth_file)))
        if settings.bearer_token_file:
            token = _digest(read_token(settings.bearer_token_file))
        return cls(passwords, token)

    @property
    def challenges(self) -> tuple[str, ...]:
        """What WWW-Authenticate offers; empty when everybody may ask."""
        basic = (f'Basic realm="{_REALM}", charset="UTF-8"',) if self.passwords else ()
        bearer = (f'Bearer realm="{_REALM}"',) if self.token is not None else ()
        return basic + bearer

    def admits(self, authorization: str) -> bool:
        """Whether this Authorization header (RFC 7617, RFC 6750) shows one of the credentials."""
        if not self.challenges:
            return True
        scheme, _, shown = authorization.partition(" ")
        if scheme.lower() == "basic":
            try:
                secret = base64.b64decode(shown.strip(), validate=True)
            except (binascii.Error, ValueError):
                return False
            return _among(_digest(secret), self.passwords)
        if scheme.lower() == "bearer" and self.token is not None:
            return _among(_digest(shown.strip().encode(errors="replace")), (self.token,))
        return False


def _among(shown: bytes, known: tuple[bytes, ...]) -> bool:
    """Compare with all of them, so that the time tells nothing."""
    found = False
    for each in known:
        found |= hmac.compare_digest(shown, each)
    return found


def read_passwords(path: str) -> list[bytes]:
    """The `name:password` lines of a file; empty lines and those with # in front are left out."""
    lines = [line for line in _read(path).splitlines() if line.strip() and not line.startswith(b"#")]
    if not lines:
        raise ListenError(f"{path}: holds no name:password line")
    for number, line in enumerate(lines, start=1):
        name, colon, password = line.partition(b":")
        if not (name and colon and password):
            raise ListenError(f"{path}: entry {number} is not name:password")
    return lines


def read_token(path: str) -> bytes:
    """The token that is all of a file but white space around it."""
    token = _read(path).strip()
    if len(token) < TOKEN_CHARACTERS or not all(0x21 <= byte <= 0x7E for byte in token):
        raise ListenError(f"{path}: a token has at least {TOKEN_CHARACTERS} printable ASCII characters and no blanks")
    return token


def tls_context(settings: HttpSettings) -> ssl.SSLContext | None:
    """TLS 1.2 or newer with the certificate of the settings, None without one; ListenError names the file."""
    if not settings.tls_certificate:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    for path in (settings.tls_certificate, settings.tls_private_key):
        _read(path)
    try:
        # The password is asked for on the terminal otherwise; a service has none.
        context.load_cert_chain(settings.tls_certificate, settings.tls_private_key, password="")
    except (ssl.SSLError, OSError, ValueError) as error:
        reason = getattr(error, "reason", None) or "the key has a password"
        raise ListenError(
            f"{settings.tls_certificate} and {settings.tls_private_key}: no certificate with its key in PEM form: "
            f"{str(reason).replace('_', ' ').lower()}"
        ) from None
    return context


def _read(path: str) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise ListenError(f"{path}: {os.strerror(error.errno) if error.errno else error}") from None


def guard(handler: Handler, current: Callable[[], Access], refused: Callable[[], None]) -> Handler:
    """The handler behind a 401 for who is not admitted by the `current` credentials; `refused` counts."""

    async def guarded(request: Request) -> Reply | None:
        access = current()
        if request.path in OPEN_PATHS or access.admits(request.field("authorization")):
            return await handler(request)
        refused()
        challenges = tuple(("WWW-Authenticate", challenge) for challenge in access.challenges)
        return Reply(401, b"credentials are needed\n", fields=(*NO_STORE, *challenges))

    return guarded
