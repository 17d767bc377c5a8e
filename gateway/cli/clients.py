"""`prostar-gateway clients`: who asks the running gateway by Modbus TCP, from its `/api/v1/clients`.

The gateway is asked where the configuration says that its HTTP face is, with the credentials of the files named
there; over HTTPS it must show the configured certificate.
"""

from __future__ import annotations

import base64
import json
import ssl
import sys
from collections.abc import Mapping, Sequence
from http.client import HTTPException
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from gateway.cli.asking import ask
from gateway.cli.config_file import ConfigOption, part_or_exit
from gateway.errors import ListenError
from gateway.faces.http.access import read_passwords, read_token
from gateway.faces.http.clients import PATH
from gateway.service.parsing import parse_listen
from gateway.service.schema import HttpTable


class _Unreachable(Exception):
    """The message says whom we asked and why there is no answer."""


def command(
    config: ConfigOption,
    as_json: Annotated[bool, typer.Option("--json", help="Print what the gateway says as it is.")] = False,
) -> None:
    """Show who asks the running gateway by Modbus TCP, how often, and what was answered from memory."""
    http = part_or_exit(config, "http").http
    if not http.listen:
        print(f"{config}: http.listen is empty, so the gateway cannot be asked", file=sys.stderr)
        raise typer.Exit(1)
    try:
        document = _ask(http)
    except _Unreachable as error:
        print(error, file=sys.stderr)
        raise typer.Exit(1) from None
    if as_json:
        print(json.dumps(document, indent=2))
        return
    Console().print(_table(document["clients"]))


def _ask(http: HttpTable) -> Mapping[str, Any]:
    address = parse_listen(http.listen[0])
    where = f"http{'s' if http.tls_certificate else ''}://{address}{PATH}"
    try:
        answer = ask(address, PATH, _tls(http), _credentials(http))
        if answer.status != 200:
            raise _Unreachable(f"{where}: {answer.status} {answer.reason}")
        document: Any = json.loads(answer.body)
    except (OSError, HTTPException, ValueError) as error:
        raise _Unreachable(f"{where}: {getattr(error, 'strerror', None) or error}; is the gateway running?") from None
    except ListenError as error:
        raise _Unreachable(str(error)) from None
    if not isinstance(document, dict) or not isinstance(document.get("clients"), list):
        raise _Unreachable(f"{where}: what answers there is no gateway")
    return document


def _tls(http: HttpTable) -> ssl.SSLContext | None:
    """What takes this very certificate, whatever name is in it."""
    if not http.tls_certificate:
        return None
    context = ssl.create_default_context(cafile=http.tls_certificate)
    context.check_hostname = False
    # … and whoever issued it: the file has no root when a public authority did.
    context.verify_flags = ssl.VERIFY_X509_PARTIAL_CHAIN
    return context


def _credentials(http: HttpTable) -> dict[str, str]:
    if http.bearer_token_file:
        return {"Authorization": f"Bearer {read_token(http.bearer_token_file).decode()}"}
    if http.basic_auth_file:
        shown = base64.b64encode(read_passwords(http.basic_auth_file)[0]).decode()
        return {"Authorization": f"Basic {shown}"}
    return {}


def _table(clients: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    table.add_column("client", overflow="fold", min_width=len("255.255.255.255"))
    for heading in ("open", "last\nseen", "requests", "from\nmemory", "line", "limited"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("exceptions", justify="right", overflow="fold", min_width=len("01:1,000"))
    for client in clients:
        requests = client["requests"]
        share = f"{client['cache_hits'] / requests:.1%}" if requests else ""
        table.add_row(
            escape(client["client"]),
            str(client["connections"]),
            _ago(client["last_seen_s_ago"]),
            f"{requests:,}",
            share,
            f"{client['forwarded']:,}",
            f"{client['rate_limited']:,}",
            " ".join(f"{code}:{count:,}" for code, count in client["exceptions"].items()),
        )
    if not clients:
        table.add_row("nobody so far", *[""] * 7)
    return table


def _ago(seconds: float) -> str:
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= size:
            return f"{seconds / size:.1f} {unit} ago"
    return f"{seconds:.0f} s ago"
