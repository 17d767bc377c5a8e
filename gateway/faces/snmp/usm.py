"""Keys, authentication and privacy of the user-based security model: RFC 3414, 3826 and 7860.

Rules:

1. Authentication is HMAC-SHA-2 (RFC 7860), privacy AES in 128-bit CFB (RFC 3826). MD5, SHA-1 and DES do not exist here.
2. A pass phrase has 8 characters or more (RFC 3414 §11.2). Keys are localized once, when a `LocalUser` is made, and
   with them everything that costs time, so that a message costs a few library calls.
3. AES-192 and AES-256 take the first octets of the localized key, on which net-snmp and pysnmp agree as long as the
   digest is long enough. Where it is not (SHA-224 with AES-256), vendors stretch it in different ways: refused.
4. The library with AES (cfb.py) is loaded for the first user: sites without SNMPv3 do not pay its 9 MiB.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from dataclasses import dataclass
from enum import Enum

from gateway.faces.snmp.secret import Secret

MIN_PASS_PHRASE = 8
_EXPANDED = 1 << 20
"""RFC 3414 §A.2: the pass phrase is repeated to this many octets before it is hashed."""

_SALT_MASK = (1 << 64) - 1


class Auth(Enum):
    """An authentication protocol: its name in the configuration, digest, octets of the authenticator, HMAC block."""

    SHA_224 = ("SHA-224", "sha224", 16, 64)
    SHA_256 = ("SHA-256", "sha256", 24, 64)
    SHA_384 = ("SHA-384", "sha384", 32, 128)
    SHA_512 = ("SHA-512", "sha512", 48, 128)

    def __init__(self, label: str, digest: str, mac_size: int, block_size: int) -> None:
        self.label = label
        self.digest = digest
        self.mac_size = mac_size
        self.block_size = block_size

    @property
    def key_size(self) -> int:
        """Octets of a key."""
        return hashlib.new(self.digest).digest_size


class Priv(Enum):
    """A privacy protocol: its name in the configuration and the octets of its key."""

    AES_128 = ("AES-128", 16)
    AES_192 = ("AES-192", 24)
    AES_256 = ("AES-256", 32)

    def __init__(self, label: str, key_size: int) -> None:
        self.label = label
        self.key_size = key_size


def fits(auth: Auth, priv: Priv) -> bool:
    """Whether the digest is long enough for the cipher's key (rule 3)."""
    return auth.key_size >= priv.key_size


def password_to_key(auth: Auth, pass_phrase: bytes) -> bytes:
    """The user's key Ku (RFC 3414 §A.2)."""
    repeated = pass_phrase * (_EXPANDED // len(pass_phrase) + 1)
    return hashlib.new(auth.digest, memoryview(repeated)[:_EXPANDED]).digest()


def localized(auth: Auth, key: bytes, engine_id: bytes) -> bytes:
    """The key Kul of a user at one engine (RFC 3414 §2.6)."""
    return hashlib.new(auth.digest, key + engine_id + key).digest()


class Mac:
    """HMAC with one key, its two halves begun once."""

    __slots__ = ("_inner", "_outer", "blank", "size")

    def __init__(self, auth: Auth, key: bytes) -> None:
        padded = key.ljust(auth.block_size, b"\0")
        self._inner = hashlib.new(auth.digest, bytes(octet ^ 0x36 for octet in padded))
        self._outer = hashlib.new(auth.digest, bytes(octet ^ 0x5C for octet in padded))
        self.size = auth.mac_size
        self.blank = bytes(self.size)  # what stands in its place while it is made

    def of(self, message: bytes) -> bytes:
        """The authenticator of a message whose own authenticator is zeros."""
        inner, outer = self._inner.copy(), self._outer.copy()
        inner.update(message)
        outer.update(inner.digest())
        return outer.digest()[: self.size]


@dataclass(frozen=True, slots=True)
class Credentials:
    """A user as configured. ValueError for a pass phrase or a pair of protocols that must not be used."""

    name: bytes
    auth: Auth
    auth_password: Secret
    priv: Priv
    priv_password: Secret

    def __post_init__(self) -> None:
        if min(len(self.auth_password), len(self.priv_password)) < MIN_PASS_PHRASE:
            raise ValueError(f"a pass phrase is shorter than {MIN_PASS_PHRASE} characters")
        if not fits(self.auth, self.priv):
            raise ValueError(f"{self.auth.label} gives too short a key for {self.priv.label}")


class LocalUser:
    """A user at one engine, ready to sign and to encrypt."""

    __slots__ = ("_salt", "cfb", "credentials", "mac", "name")

    def __init__(self, credentials: Credentials, engine_id: bytes) -> None:
        from gateway.faces.snmp.cfb import Cfb  # noqa: PLC0415 - rule 4

        auth, priv = credentials.auth, credentials.priv
        self.credentials = credentials
        self.name = credentials.name
        auth_key = localized(auth, password_to_key(auth, credentials.auth_password.reveal()), engine_id)
        stretched = localized(auth, password_to_key(auth, credentials.priv_password.reveal()), engine_id)
        priv_key = stretched[: priv.key_size]
        self.mac = Mac(auth, auth_key)
        self.cfb = Cfb(priv_key)
        self._salt = secrets.randbits(64)
        self._self_test(auth_key, priv_key)

    def salt(self) -> bytes:
        """The privacy parameters of the next message: never the same twice (RFC 3826 §3.1.2.1)."""
        self._salt = self._salt + 1 & _SALT_MASK
        return self._salt.to_bytes(8, "big")

    def __repr__(self) -> str:
        return f"LocalUser({self.name!r})"

    def _self_test(self, auth_key: bytes, priv_key: bytes) -> None:
        """RuntimeError when the machine's libraries do not do what this module believes of them."""
        from gateway.faces.snmp.cfb import BLOCK, once  # noqa: PLC0415 - rule 4

        vector, sample = secrets.token_bytes(BLOCK), secrets.token_bytes(45)
        expected = once(priv_key, vector, sample)
        auth, priv = self.credentials.auth, self.credentials.priv
        if self.mac.of(sample) != hmac.digest(auth_key, sample, auth.digest)[: self.mac.size]:
            raise RuntimeError(f"{auth.label} is not usable on this machine")
        if self.cfb.encrypt(vector, sample) != expected or self.cfb.decrypt(vector, expected) != sample:
            raise RuntimeError(f"{priv.label} is not usable on this machine")
