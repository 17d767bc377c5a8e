"""Certificates for the TLS tests: those of the recipe in docs/tls.md, and others that a test makes wrong on purpose."""

from __future__ import annotations

import atexit
import base64
import re
import shutil
import ssl
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from pyasn1.codec.der import decoder, encoder
from pyasn1.type import char, univ

from gateway.faces.modbus.settings import TlsFiles

DOCUMENT = Path(__file__).parents[4] / "docs" / "tls.md"
ODD = x509.ObjectIdentifier("1.3.6.1.4.1.50316.802.2")
ROLE = x509.ObjectIdentifier("1.3.6.1.4.1.50316.802.1")
CLIENT, SERVER = ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH


def recipe(name: str = "sh") -> str:
    """The commands of a block of the document, as a reader copies them."""
    (block,) = re.findall(rf"^```{name}\n(.*?)^```$", DOCUMENT.read_text(), re.MULTILINE | re.DOTALL)
    return str(block)


def run(commands: str, folder: Path) -> None:
    """Do it in a shell that stops at the first failure."""
    result = subprocess.run(["sh", "-eu"], input=commands, cwd=folder, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


@cache
def _made(*, rsa: bool) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="prostar-gateway-pki-"))
    atexit.register(shutil.rmtree, folder)
    commands = recipe()
    run(
        commands.replace("-newkey ec -pkeyopt ec_paramgen_curve:P-256", "-newkey rsa:2048") if rsa else commands, folder
    )
    return folder


@dataclass(frozen=True)
class Pki:
    """A folder with what the recipe makes."""

    folder: Path

    @classmethod
    def of_the_recipe(cls, folder: Path, *, rsa: bool = False) -> Pki:
        shutil.copytree(_made(rsa=rsa), folder, dirs_exist_ok=True)
        return cls(folder)

    def files(self, *, crl: bool = False) -> TlsFiles:
        """What the server gets."""
        server, key, ca, revoked = (self.folder / name for name in ("server.pem", "server.key", "ca.pem", "crl.pem"))
        return TlsFiles(server, key, ca, revoked if crl else None)

    def client(self, name: str | None, version: ssl.TLSVersion | None = None) -> ssl.SSLContext:
        """A client's context with the certificate of that name, or with none."""
        context = ssl.create_default_context(cafile=str(self.folder / "ca.pem"))
        if version is not None:
            context.minimum_version = context.maximum_version = version
        if name is not None:
            context.load_cert_chain(self.folder / f"{name}.pem", self.folder / f"{name}.key")
        return context

    def revoke(self) -> None:
        """Revoke the operator's certificate, by the document's commands."""
        run(recipe("sh revoke"), self.folder)

    def issue(
        self,
        name: str,
        *,
        extensions: Sequence[x509.ExtensionType] = (),
        days: tuple[float, float] = (-1, 1),
        usage: x509.ObjectIdentifier = CLIENT,
        issuer: str = "ca",
        names: Sequence[str] = ("localhost",),
    ) -> None:
        """Make NAME.pem and NAME.key; `days` from and until when, relative to now; `names`: DNS names and addresses."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        builder = self._builder(subject, self.certificate(issuer).subject, key.public_key(), days)
        alternatives = [x509.SubjectAlternativeName([_name(text) for text in names])] if names else []
        for extension in (x509.ExtendedKeyUsage([usage]), *alternatives, *extensions):
            builder = builder.add_extension(extension, critical=False)
        signer = load_pem_private_key((self.folder / f"{issuer}.key").read_bytes(), None)
        assert isinstance(signer, ec.EllipticCurvePrivateKey)
        if usage == SERVER:  # a client with Python 3.13 or newer refuses a server without it
            by = x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key())
            builder = builder.add_extension(by, critical=False)
        self._write(name, builder.sign(signer, hashes.SHA256()))
        self._write_key(name, key)

    def issue_twice(self, name: str, *roles: str) -> None:
        """Make a certificate with two role extensions, which no library makes: rename one, and sign again."""
        one, other = (x509.UnrecognizedExtension(oid, utf8(text)) for oid, text in zip((ROLE, ODD), roles, strict=True))
        self.issue(name, extensions=[one, other])
        tbs = self.certificate(name).tbs_certificate_bytes
        assert tbs.count(_oid(ODD)) == 1
        tbs = tbs.replace(_oid(ODD), _oid(ROLE))
        signer = load_pem_private_key((self.folder / "ca.key").read_bytes(), None)
        assert isinstance(signer, ec.EllipticCurvePrivateKey)
        whole = univ.Sequence()
        whole[0] = decoder.decode(tbs)[0]
        whole[1] = univ.Sequence()
        whole[1][0] = univ.ObjectIdentifier("1.2.840.10045.4.3.2")  # ecdsa-with-SHA256
        whole[2] = univ.BitString.fromOctetString(signer.sign(tbs, ec.ECDSA(hashes.SHA256())))
        der = encoder.encode(whole)
        assert tbs in der
        pem = f"-----BEGIN CERTIFICATE-----\n{base64.encodebytes(der).decode()}-----END CERTIFICATE-----\n"
        (self.folder / f"{name}.pem").write_text(pem)

    def authority(self, name: str) -> None:
        """Make another authority with the subject of the site's own."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = self.certificate("ca").subject
        certificate = self._builder(subject, subject, key.public_key(), (-1, 1)).add_extension(
            x509.BasicConstraints(ca=True, path_length=None), critical=True
        )
        self._write(name, certificate.sign(key, hashes.SHA256()))
        self._write_key(name, key)

    def certificate(self, name: str) -> x509.Certificate:
        """The first certificate of NAME.pem."""
        return x509.load_pem_x509_certificate((self.folder / f"{name}.pem").read_bytes())

    @staticmethod
    def _builder(
        subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: tuple[float, float]
    ) -> x509.CertificateBuilder:
        now = datetime.now(UTC)
        return (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(issuer)
            .public_key(key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now + timedelta(days=days[0]))
            .not_valid_after(now + timedelta(days=days[1]))
        )

    def _write(self, name: str, certificate: x509.Certificate) -> None:
        (self.folder / f"{name}.pem").write_bytes(certificate.public_bytes(Encoding.PEM))

    def _write_key(self, name: str, key: ec.EllipticCurvePrivateKey) -> None:
        pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        (self.folder / f"{name}.key").write_bytes(pem)


def _name(text: str) -> x509.GeneralName:
    with suppress(ValueError):
        return x509.IPAddress(ip_address(text))
    return x509.DNSName(text)


def utf8(text: str) -> bytes:
    """As DER."""
    encoded: bytes = encoder.encode(char.UTF8String(text))
    return encoded


def _oid(oid: x509.ObjectIdentifier) -> bytes:
    encoded: bytes = encoder.encode(univ.ObjectIdentifier(oid.dotted_string))
    return encoded


def role(value: bytes) -> x509.UnrecognizedExtension:
    """A role extension with this DER value."""
    return x509.UnrecognizedExtension(ROLE, value)
