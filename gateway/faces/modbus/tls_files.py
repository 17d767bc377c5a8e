"""Certificate, key, CA and CRL files: read, judged as a whole, and kept as they were when they were judged.

Rule 1: all files are good and fit together, or none of them is used; every problem is told.
Rule 2: what was judged is what is used, whatever happens on disk afterwards: the bytes are kept in memory, in
        anonymous files that only this process can name.
Rule 3: each connection has an `SSLContext` of its own, without tickets. What one handshake leaves behind, no other
        can find, so no session can be resumed, under whatever version and by whatever means: a certificate is
        looked at each time, and nothing outlives it (R-42 and R-43 ask otherwise where they can: "should", "may").
Rule 4: no text of a problem, log line or metric holds a byte of a file.
"""

from __future__ import annotations

import os
import re
import ssl
import weakref
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID

from gateway.errors import TlsFilesError
from gateway.faces.modbus.settings import TlsFiles
from gateway.faces.modbus.tls_names import Names, names_of

MAX_BYTES = 1 << 20
CIPHERS = (
    "ECDHE-ECDSA-AES128-GCM-SHA256",
    "ECDHE-RSA-AES128-GCM-SHA256",
    "ECDHE-ECDSA-AES256-GCM-SHA384",
    "ECDHE-RSA-AES256-GCM-SHA384",
    "ECDHE-ECDSA-CHACHA20-POLY1305",
    "ECDHE-RSA-CHACHA20-POLY1305",
)
"""What may be agreed on under TLS 1.2: registered (R-12, R-38), with certificates (R-13), counter mode (R-36),
SHA-256 or better (R-50 to R-55), a new key each time. TLS 1.3 has suites of its own."""

_CRL_BLOCK = re.compile(rb"-----BEGIN X509 CRL-----.+?-----END X509 CRL-----\r?\n?", re.DOTALL)

Problems = list[tuple[str, str]]


class Credentials:
    """Files that were judged good: until when (Unix time) the server's certificate is, and whose it is."""

    def __init__(
        self, files: dict[str, bytes], crls: Sequence[x509.CertificateRevocationList], own: x509.Certificate
    ) -> None:
        self.not_after = own.not_valid_after_utc.timestamp()
        self.names: Names = names_of(own)
        self._crls = tuple(crls)
        self._kept = {key: os.memfd_create(key, os.MFD_CLOEXEC) for key in files}
        weakref.finalize(self, _close, tuple(self._kept.values()))
        for key, fd in self._kept.items():
            with open(fd, "wb", closefd=False) as file:
                file.write(files[key])

    def context(self) -> ssl.SSLContext:
        """A context for one connection (rule 3); raises ssl.SSLError for files that OpenSSL does not take."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.set_ciphers(":".join(CIPHERS))
        context.load_cert_chain(self._path("certificate_file"), self._path("key_file"), password=_no_passphrase)
        context.load_verify_locations(self._path("client_ca_file"))
        context.verify_mode = ssl.CERT_REQUIRED
        if self._crls:
            context.load_verify_locations(self._path("crl_file"))
            context.verify_flags |= ssl.VerifyFlags.VERIFY_CRL_CHECK_CHAIN
        context.options |= (
            ssl.OP_NO_TICKET  # rule 3
            | ssl.OP_NO_COMPRESSION
            | ssl.OP_NO_RENEGOTIATION  # the extension of R-60 is sent; a peer cannot make us work with it
            | ssl.OP_CIPHER_SERVER_PREFERENCE
        )
        context.num_tickets = 0
        return context

    def revoked(self, certificate: x509.Certificate) -> bool:
        """Whether the CRL of its issuer names a certificate."""
        return any(
            crl.issuer == certificate.issuer
            and crl.get_revoked_certificate_by_serial_number(certificate.serial_number) is not None
            for crl in self._crls
        )

    def _path(self, key: str) -> str:
        return f"/proc/self/fd/{self._kept[key]}"


def load(files: TlsFiles, now: float) -> Credentials:
    """What is in the files, at wall time `now`; TlsFilesError with every problem (rule 1)."""
    problems: Problems = []
    found = {key: data for key, path in files.named() if (data := _read(key, path, problems)) is not None}
    moment = datetime.fromtimestamp(now, UTC)
    chain = _certificates("certificate_file", found, problems)
    _certificates("client_ca_file", found, problems)
    crls = _crls(found, moment, problems)
    if chain:
        _judge_own(chain[0], moment, problems)
    _judge_key(chain, found, problems)
    if problems:
        raise TlsFilesError(tuple(problems))
    credentials = Credentials(found, crls, chain[0])
    try:
        credentials.context()
    except ssl.SSLError as error:
        reason = (error.reason or "refused").lower().replace("_", " ")
        raise TlsFilesError((("certificate_file", f"OpenSSL does not take these files: {reason}"),)) from None
    return credentials


def _read(key: str, path: Path, problems: Problems) -> bytes | None:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        problems.append((key, f"{path} cannot be read: {error.strerror or error}"))
        return None
    if len(data) > MAX_BYTES:
        problems.append((key, f"{path} is too long; allowed: 1 MiB"))
        return None
    return data


def _certificates(key: str, found: dict[str, bytes], problems: Problems) -> list[x509.Certificate]:
    if key not in found:
        return []
    try:
        return x509.load_pem_x509_certificates(found[key])
    except ValueError:
        problems.append((key, "holds no certificate that can be read; allowed: PEM"))
        return []


def _crls(found: dict[str, bytes], moment: datetime, problems: Problems) -> list[x509.CertificateRevocationList]:
    if "crl_file" not in found:
        return []
    try:
        crls = [x509.load_pem_x509_crl(block) for block in _CRL_BLOCK.findall(found["crl_file"])]
    except ValueError:
        crls = []
    if not crls:
        problems.append(("crl_file", "holds no CRL that can be read; allowed: PEM"))
    for crl in crls:
        if crl.next_update_utc is not None and crl.next_update_utc <= moment:
            problems.append(("crl_file", f"is out of date since {crl.next_update_utc:%Y-%m-%d %H:%M} UTC"))
    return crls


def _judge_own(certificate: x509.Certificate, moment: datetime, problems: Problems) -> None:
    key = "certificate_file"
    if certificate.not_valid_after_utc <= moment:
        problems.append((key, f"expired on {certificate.not_valid_after_utc:%Y-%m-%d %H:%M} UTC"))
    if certificate.not_valid_before_utc > moment:
        problems.append((key, f"is not valid before {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC"))
    try:
        usage = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    except x509.ExtensionNotFound:
        return
    except (ValueError, x509.DuplicateExtension):
        problems.append((key, "has extensions that cannot be read"))
        return
    if ExtendedKeyUsageOID.SERVER_AUTH not in usage and ExtendedKeyUsageOID.ANY_EXTENDED_KEY_USAGE not in usage:
        problems.append((key, "is not for servers; allowed: extendedKeyUsage serverAuth"))


def _judge_key(chain: Sequence[x509.Certificate], found: dict[str, bytes], problems: Problems) -> None:
    if "key_file" not in found:
        return
    try:
        key = load_pem_private_key(found["key_file"], None).public_key()
    except TypeError:
        problems.append(("key_file", "has a passphrase, which nobody can type; allowed: a key without one"))
        return
    except (ValueError, UnsupportedAlgorithm):
        problems.append(("key_file", "holds no private key that can be read; allowed: PEM"))
        return
    if chain:
        one, other = (
            part.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo) for part in (key, chain[0].public_key())
        )
        if one != other:
            problems.append(("key_file", "is not the key of the first certificate in certificate_file"))


def _no_passphrase() -> bytes:
    """Have OpenSSL never ask the terminal; that there is none is known already."""
    return b""


def _close(descriptors: Sequence[int]) -> None:
    for fd in descriptors:
        os.close(fd)
