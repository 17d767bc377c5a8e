"""The TLS part of the configuration file; see service/schema.py for the rules."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from gateway.faces.modbus.tls_names import wanted_names
from gateway.modbus.role import is_role
from gateway.service.keys import LISTENS, Key, Listens, Table

_PEM = "the absolute path of a PEM file"
ROLES = 'a list of roles such as "operator": 1 to 64 printable characters without quotes; at least one'


def _role(text: str) -> str:
    if not is_role(text):
        raise ValueError("no role")
    return text


def _client_name(text: str) -> str:
    wanted_names([text])
    return text


Roles = Annotated[tuple[Annotated[str, AfterValidator(_role)], ...], Field(strict=False)]
ClientNames = Annotated[tuple[Annotated[str, AfterValidator(_client_name)], ...], Field(strict=False)]
File = Annotated[str, Field(pattern=r"^/[^\x00-\x1f]*$")]


class TlsTable(Table):
    """`[modbus.tls]`: Modbus/TCP Security (docs/tls.md)."""

    listen: Annotated[Listens, Key(LISTENS, "Where Modbus clients connect with TLS.")] = ("127.0.0.1:802",)
    certificate_file: Annotated[File, Key(_PEM, "The server's certificate, then its issuers down to the root.")]
    key_file: Annotated[File, Key(_PEM, "The private key of the certificate, without a passphrase.")]
    client_ca_file: Annotated[File, Key(_PEM, "Who is trusted to issue the clients' certificates.")]
    crl_file: Annotated[
        Annotated[str, Field(pattern=r"^(/[^\x00-\x1f]*)?$")],
        Key(_PEM + ', or "" for none', "What these issuers have revoked; a list of each of them is needed then."),
    ] = ""
    require_role: Annotated[
        bool, Key("true or false", "Answer 01 to clients whose certificate has no role; false: they may read.")
    ] = True
    client_names: Annotated[
        ClientNames,
        Key(
            'a list of names such as "scada.example.net", "*.example.net", "10.1.2.3" or "10.1.2.0/28", at least one',
            "Of these the subjectAltName of a client's certificate must have one; left out: whoever has a certificate.",
        ),
    ] = Field(default=(), min_length=1)
    require_address: Annotated[
        bool,
        Key("true or false", "Refuse a client that connects from an address which its certificate does not name."),
    ] = False
