"""The files of `[http]`: which of them cannot be read, and which hold what cannot be used.

They do not keep the gateway from starting: the HTTP face stays closed until they are mended, and a reload is refused.
`check-config` calls them problems, as it does those of `[modbus.tls]` (tls.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from gateway.errors import ListenError
from gateway.faces.http.access import read_passwords, read_token, tls_context
from gateway.service.settings import http_settings

if TYPE_CHECKING:  # what it is at run time, plain.py says
    from gateway.service.schema import Config

KEYS = ("basic_auth_file", "bearer_token_file", "tls_certificate", "tls_private_key")


def http_problems(config: Config) -> Iterator[str]:
    """What is wrong with those that can be read, each with its key path."""
    http, away = config.http, dict(_unreadable(config))
    readers: tuple[tuple[tuple[str, ...], Callable[[], object]], ...] = (
        (("basic_auth_file",), lambda: read_passwords(http.basic_auth_file)),
        (("bearer_token_file",), lambda: read_token(http.bearer_token_file)),
        (("tls_certificate", "tls_private_key"), lambda: tls_context(http_settings(config))),
    )
    for keys, read in readers:
        if all(getattr(http, key) and key not in away for key in keys):
            try:
                read()
            except ListenError as error:
                yield f"http.{keys[0]}: {error}"


def unreadable_http(config: Config) -> Iterator[str]:
    """Those that cannot be read here and now, each with its key path: another user may be allowed to."""
    for key, why in _unreadable(config):
        yield f"http.{key}: {getattr(config.http, key)} cannot be read: {why}"


def _unreadable(config: Config) -> Iterator[tuple[str, str]]:
    for key in KEYS:
        if name := getattr(config.http, key):
            try:
                Path(name).read_bytes()
            except OSError as error:
                yield key, error.strerror or str(error)
