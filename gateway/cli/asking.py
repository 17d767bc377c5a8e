"""Asks the HTTP face of a gateway on this machine, with the standard library alone."""

from __future__ import annotations

import ssl
from collections.abc import Mapping
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from typing import NamedTuple

from gateway.cli.printable import printable
from gateway.service.parsing import Address

TIMEOUT_S = 5.0


class Answer(NamedTuple):
    """What it said."""

    status: int
    reason: str
    body: bytes


def ask(address: Address, path: str, tls: ssl.SSLContext | None, headers: Mapping[str, str]) -> Answer:
    """GET a path, by HTTPS with `tls`; OSError or HTTPException when there is no answer.

    Whatever listens there may have answered: its words, in `reason` and in an HTTPException, can be shown.
    """
    connection = (
        HTTPConnection(address.reached_at, address.port, timeout=TIMEOUT_S)
        if tls is None
        else HTTPSConnection(address.reached_at, address.port, timeout=TIMEOUT_S, context=tls)
    )
    try:
        connection.request("GET", path, headers={"Connection": "close", **headers})
        reply = connection.getresponse()
        return Answer(reply.status, printable(reply.reason), reply.read())
    except HTTPException as error:
        raise HTTPException(printable(str(error).strip())) from None
    finally:
        connection.close()
