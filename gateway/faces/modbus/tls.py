"""The door of Modbus/TCP Security: whose certificate is good, which role it has, and by which files that is judged.

Rule 1: who comes in has shown a certificate that the configured CA stands for, at this handshake and not at another
        one (R-02, R-06; tls_files.py rule 3). Its role is read from it then, for as long as the connection lasts
        (R-04, R-30); the role decides on every request, refused with 01 (R-31).
Rule 2: a certificate without a role has the least rights: none, or to read where `require_role` is off (R-23). A role
        that no rule names is no more than that it is one.
Rule 3: where there are `client_names`, the certificate has one of them; with `require_address` it names the address
        that the client connects from (tls_names.py). By itself neither lets anybody in.
Rule 4: a handshake that fails is counted under its reason, and told once a minute for each peer and reason.
Rule 5: a handshake takes as long as `HANDSHAKE_TOKENS` requests from memory, and costs its client as many of its tokens
        (core/clients.py), or those that it has; who has none is cut off before it begins.
Rule 6: `adjust` takes files that were judged good together, and settings. Open connections go on, but those that would
        not be let in any more end.
"""

from __future__ import annotations

import logging
import ssl

from cryptography import x509

from gateway.clock import Clock
from gateway.core.clients import Client
from gateway.core.log_budget import LogBudget
from gateway.core.stats import TlsStats
from gateway.errors import CertificateRefused, TlsFilesError
from gateway.faces.modbus.connection import Connection
from gateway.faces.modbus.dispatch import Dispatcher
from gateway.faces.modbus.settings import TlsSettings
from gateway.faces.modbus.tls_files import Credentials, load
from gateway.faces.modbus.tls_names import names_of
from gateway.faces.modbus.tls_session import TlsSession
from gateway.modbus.role import ROLE_OID, parse_role

logger = logging.getLogger(__name__)

HANDSHAKE_TOKENS = 100
_OID = x509.ObjectIdentifier(ROLE_OID)


class TlsDoor:
    """All TLS listeners of a face. `barred` is the way in for those who may not even read."""

    def __init__(
        self, settings: TlsSettings, barred: Dispatcher, clock: Clock, stats: TlsStats, *, frame_timeout_s: float
    ) -> None:
        self._settings = settings
        self._barred = barred
        self._clock = clock
        self._stats = stats
        self._frame_timeout_s = frame_timeout_s
        self._credentials: Credentials | None = None
        self._sessions: dict[TlsSession, x509.Certificate] = {}
        self._told = LogBudget()

    def open(self) -> None:
        """Have files to work with; TlsFilesError when they cannot be used."""
        if self._credentials is not None:
            return
        try:
            self._use(load(self._settings.files, self._clock.wall()))
        except TlsFilesError as error:
            self._stats.problem = str(error)
            raise

    def adjust(self, settings: TlsSettings, credentials: Credentials) -> None:
        """Other settings and their files, which were judged good, from now on (rule 6).

        Who was let in to read without a role is cut off when it needs one now.
        """
        role_required = settings.require_role and not self._settings.require_role
        self._settings = settings
        self._use(credentials)
        logger.info("event=tls_reloaded")
        for session, certificate in tuple(self._sessions.items()):
            connection = session.connection
            if credentials.revoked(certificate):
                reason = "certificate_revoked"
            elif role_required and connection.role is None:
                reason = "role_required"
            else:
                reason = self._misnamed(certificate, connection.peer)
            if reason:
                logger.warning("event=connection_ended peer=%s reason=%s", connection.peer, reason)
                connection.end(reason)

    def session(self, connection: Connection) -> TlsSession:
        """What stands between a socket and a new connection."""
        return TlsSession(
            connection,
            self,
            handshake_timeout_s=self._settings.handshake_timeout_s,
            frame_timeout_s=self._frame_timeout_s,
        )

    # What the sessions call (tls_session.Door)

    def affords(self, client: Client) -> bool:
        """Whether a client may shake hands now (rule 5)."""
        return client.bucket.take(self._clock.monotonic(), HANDSHAKE_TOKENS) > 0

    def context(self) -> ssl.SSLContext:
        """See `Credentials.context`."""
        assert self._credentials is not None, "opened first"
        return self._credentials.context()

    def enter(self, session: TlsSession, certificate: bytes) -> None:
        """Let a client in by the names and the role of its certificate (rules 1 to 3)."""
        parsed, role = _identify(certificate)
        misnamed = self._misnamed(parsed, session.connection.peer)
        if misnamed:
            raise CertificateRefused(misnamed, f"its names: {names_of(parsed)}")
        self._sessions[session] = parsed
        self._stats.handshakes += 1
        if role is None and self._settings.require_role:
            session.connection.identified(None, self._barred)
        else:
            session.connection.identified(role)
        left_out = self._told.spend(("in", session.connection.peer, role), self._clock.monotonic())
        if left_out is not None:
            shown = "none" if role is None else f'"{role}"'
            peer, serial = session.connection.peer, parsed.serial_number
            logger.info("event=tls_client peer=%s role=%s certificate=%x left_out=%d", peer, shown, serial, left_out)

    def refuse(self, peer: str, reason: str, why: str = "") -> None:
        """Count and tell a handshake that failed (rule 4)."""
        self._stats.refused[reason] += 1
        left_out = self._told.spend(("out", peer, reason), self._clock.monotonic())
        if left_out is not None:
            more = f' why="{why}"' if why else ""
            logger.warning("event=tls_refused peer=%s reason=%s left_out=%d%s", peer, reason, left_out, more)

    def left(self, session: TlsSession) -> None:
        """A session is over."""
        self._sessions.pop(session, None)

    def keep(self, problem: str) -> None:
        """Go on with what was read before, because the files on disk are of no use."""
        self._stats.reload_failures += 1
        self._stats.problem = problem
        kept = "none" if self._credentials is None else "old"
        logger.error('event=tls_reload_failed kept=%s error="%s"', kept, problem.replace('"', "'"))

    def _misnamed(self, certificate: x509.Certificate, peer: str) -> str:
        """Why a certificate is not let in from an address by its names (rule 3); "" when it is."""
        settings, names = self._settings, names_of(certificate)
        if settings.client_names is not None and not settings.client_names.fit(names):
            return "name_not_allowed"
        if settings.require_address and not names.hold(peer):
            return "address_not_in_certificate"
        return ""

    def _use(self, credentials: Credentials) -> None:
        self._credentials = credentials
        self._stats.problem = ""
        self._stats.not_after = credentials.not_after


def _identify(der: bytes) -> tuple[x509.Certificate, str | None]:
    """A certificate and its role; CertificateRefused for what can be no client's certificate."""
    try:
        certificate = x509.load_der_x509_certificate(der)
        extensions = tuple(certificate.extensions)
    except x509.DuplicateExtension as error:  # RFC 5280 4.2; R-65 where it is the role
        reason = "role_malformed" if error.oid == _OID else "certificate_unreadable"
        raise CertificateRefused(reason, "an extension comes twice") from None
    except (ValueError, x509.InvalidVersion, x509.UnsupportedGeneralNameType) as error:
        raise CertificateRefused("certificate_unreadable", "an extension, or all of it") from error
    values = [e.value.value for e in extensions if isinstance(e.value, x509.UnrecognizedExtension) and e.oid == _OID]
    return certificate, parse_role(values)
