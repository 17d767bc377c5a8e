"""The role in a client's certificate (MB-TCP-Security V3.6 §8.4).

Rule 1: the role is the value of one extension, `ROLE_OID`, an ASN.1 UTF8String and nothing else (R-21, R-22).
Rule 2: the whole string is one role, and a certificate has one at most (R-65).
Rule 3: no extension is no role, which is `None`, never "" (R-23).
Rule 4: what is not exactly so is refused. A role is told in logs and named in the configuration, so it is 1 to 64
        printable characters without quotes, backslashes or a blank at either end.
"""

from __future__ import annotations

from collections.abc import Sequence

from gateway.errors import CertificateRefused

ROLE_OID = "1.3.6.1.4.1.50316.802.1"
MAX_CHARACTERS = 64
_UTF8_STRING = 0x0C
_FORBIDDEN = frozenset("\"'\\")


def parse_role(values: Sequence[bytes]) -> str | None:
    """The role of a certificate from the DER values of its role extensions; None where it has none.

    Raises CertificateRefused for more than one, another ASN.1 type or encoding, and a string that is no role.
    """
    if not values:
        return None
    if len(values) > 1:
        raise _malformed(f"{len(values)} role extensions")
    try:
        role = _utf8_string(values[0]).decode()
    except UnicodeDecodeError:
        raise _malformed("the role is not UTF-8") from None
    if not is_role(role):
        raise _malformed(f"a role has 1 to {MAX_CHARACTERS} printable characters and no quotes")
    return role


def is_role(text: str) -> bool:
    """Whether a text can be a role (rule 4)."""
    return (
        0 < len(text) <= MAX_CHARACTERS and text.isprintable() and text == text.strip() and _FORBIDDEN.isdisjoint(text)
    )


def _utf8_string(der: bytes) -> bytes:
    """The bytes of a DER UTF8String that fills `der` (X.690 8.1.3, 10.1: the shortest form of the length)."""
    if len(der) < 2 or der[0] != _UTF8_STRING:
        raise _malformed("the role is not an ASN.1 UTF8String")
    length, at = der[1], 2
    if length >= 0x80:
        at += length & 0x7F
        length = int.from_bytes(der[2:at])
        if at == 2 or at > len(der) or der[2] == 0 or length < 0x80:
            raise _malformed("the length of the role is not DER")
    if len(der) != at + length:
        raise _malformed("the length of the role is not that of its extension")
    return der[at:]


def _malformed(message: str) -> CertificateRefused:
    return CertificateRefused("role_malformed", message)
