"""Modbus/TCP Security, from the configuration: its settings, what is wrong with its files, what is worth a second look.

Files that are bad do not keep the gateway from starting: that may be the clock's fault, after a power cut, and the
other faces do not need them. `check-config` calls them problems; a running gateway keeps the TLS port closed.
"""

from __future__ import annotations

import stat
from collections.abc import Iterator
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from gateway.errors import TlsFilesError
from gateway.faces.modbus.settings import TlsFiles, TlsSettings
from gateway.faces.modbus.tls_names import Names, wanted_names
from gateway.service.parsing import parse_listen

if TYPE_CHECKING:
    from gateway.faces.modbus.tls_files import Credentials
    from gateway.service.schema import Config

SOON_S = timedelta(days=30).total_seconds()


def tls_settings(config: Config) -> TlsSettings | None:
    """The settings of the TLS listeners; None where there is none."""
    tls = config.modbus.tls
    if tls is None or not (tls.listen or any(listener.tls for listener in config.modbus.listener)):
        return None
    return TlsSettings(
        listen=tuple((address.host, address.port) for address in map(parse_listen, tls.listen)),
        files=TlsFiles(
            Path(tls.certificate_file),
            Path(tls.key_file),
            Path(tls.client_ca_file),
            Path(tls.crl_file) if tls.crl_file else None,
        ),
        require_role=tls.require_role,
        client_names=wanted_names(tls.client_names) if tls.client_names else None,
        require_address=tls.require_address,
    )


def read_files(settings: TlsSettings, now: float) -> Credentials:
    """What is in the files at wall time `now`; TlsFilesError with every problem. Loads cryptography."""
    from gateway.faces.modbus.tls_files import load  # noqa: PLC0415 - only sites with TLS pay its 9 MiB

    return load(settings.files, now)


def tls_problems(config: Config, now: float) -> tuple[str, ...]:
    """What is wrong with the files at wall time `now`, each with its key path."""
    settings = tls_settings(config)
    if settings is None:
        return ()
    try:
        read_files(settings, now)
    except TlsFilesError as error:
        return tuple(f"modbus.tls.{key}: {text}" for key, text in error.problems)
    return ()


def tls_advice(config: Config, now: float) -> Iterator[str]:
    """What an experienced colleague would say."""
    settings = tls_settings(config)
    for index, rule in enumerate(config.modbus.write if settings is None else ()):
        if rule.role:
            yield f"modbus.write[{index}].role: holds for nobody, because [modbus.tls] does not listen"
    if settings is None:
        return
    if _exposed(settings.files):
        yield f"modbus.tls.key_file: {settings.files.key} can be read by every user of this machine"
    try:
        credentials = read_files(settings, now)
    except TlsFilesError as error:
        for key, text in error.problems:
            yield f"modbus.tls.{key}: {text}; the TLS port stays closed until that is mended"
        return
    left_s = credentials.not_after - now
    if left_s < SOON_S:
        yield f"modbus.tls.certificate_file: expires in {left_s / 86400:.0f} days"
    yield from _own_names(config, credentials.names)


def _own_names(config: Config, names: Names) -> Iterator[str]:
    """What a client that checks whom it talks to (RFC 9525) will not like about the server's certificate."""
    refused = "so clients that check whom they talk to refuse it"
    if not (names.dns or names.addresses):
        yield f"modbus.tls.certificate_file: names nobody, for it has no subjectAltName, {refused}"
        return
    tls = config.modbus.tls
    tables = [("modbus.tls", () if tls is None else tls.listen)]
    tables += [(f"modbus.listener[{at}]", each.listen) for at, each in enumerate(config.modbus.listener) if each.tls]
    for path, listen in tables:
        for at, text in enumerate(listen):
            if not names.lead_to(parse_listen(text).host):
                yield f"{path}.listen[{at}]: the server's certificate is for {names}, not for {text}, {refused}"


def _exposed(files: TlsFiles) -> bool:
    """Whether any user of the machine can read the key."""
    with suppress(OSError):
        return bool(files.key.stat().st_mode & stat.S_IROTH)
    return False
