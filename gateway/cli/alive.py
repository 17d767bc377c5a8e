"""`prostar-gateway health`: whether the running gateway answers, for whatever looks after a container or a process.

Rule 1: it is started every half minute for years, so nothing is loaded for it but the standard library.
Rule 2: of the configuration it reads where the HTTP face is and nothing else: what the gateway runs by may be the file
        of before, and whether the one on disk is right is `check-config`'s to say.
Rule 3: `/healthz` is open to everybody and nothing is shown to it, so over HTTPS no certificate is checked: one that
        was renewed on the disk, or has expired, says nothing about whether the gateway lives.
"""

from __future__ import annotations

import ssl
import sys
from collections.abc import Sequence
from http.client import HTTPException
from pathlib import Path

from gateway.cli.asking import ask
from gateway.errors import ConfigError
from gateway.service.parsing import HTTP_LISTEN, parse_listen
from gateway.service.toml_file import read_toml


def plain_arguments(words: Sequence[str]) -> Path | None:
    """The configuration file of `-c FILE`; None for anything else, which is Typer's."""
    match words:
        case ("-c" | "--config", str(name)) if name:
            return Path(name)
    return None


def health(path: Path) -> int:
    """Ask the gateway that runs by the configuration in the file: 0 when it answers, otherwise 1, and one line why."""
    try:
        http = read_toml(path).get("http", {})
        listen = http.get("listen", [HTTP_LISTEN])
        address = parse_listen(listen[0]) if listen else None
    except ConfigError as error:
        return _ill("\n".join(error.problems))
    except (ValueError, AttributeError, TypeError, LookupError):
        return _ill(f"{path}: does not say where the HTTP face is: see check-config")
    if address is None:
        return _ill(f"{path}: http.listen is empty, so the gateway cannot be asked")
    where = f"http{'s' if http.get('tls_certificate') else ''}://{address}/healthz"
    try:
        status = ask(address, "/healthz", _anybody() if http.get("tls_certificate") else None, {}).status
    except (OSError, HTTPException) as error:
        return _ill(f"{where}: {getattr(error, 'strerror', None) or error}")
    if status != 200:
        return _ill(f"{where}: {status}")
    print(f"{where}: ok")
    return 0


def _anybody() -> ssl.SSLContext:
    """Rule 3."""
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context


def _ill(why: str) -> int:
    print(why, file=sys.stderr)
    return 1
