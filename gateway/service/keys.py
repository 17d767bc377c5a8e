"""What the classes of the configuration file are made of: keys, and the types and texts of their values.

A type refuses by ValueError; the text that says what is allowed stands with the key.
"""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from gateway.service.parsing import parse_listen, parse_range


@dataclass(frozen=True, slots=True)
class Key:
    """What a reader is told about a key: what is allowed, and what the key does."""

    allowed: str
    does: str
    secret: bool = False  # its value never appears in a problem text


def _listen(text: str) -> str:
    return str(parse_listen(text))


def _network(text: str) -> str:
    return str(ipaddress.ip_network(text))


def _range(text: str) -> str:
    parse_range(text)
    return text


Name = Annotated[str, Field(pattern=r"^[^\s\x00-\x1f\x7f]([^\x00-\x1f\x7f]{0,62}[^\s\x00-\x1f\x7f])?$")]
Text = Annotated[str, Field(pattern=r"^[ -~]{0,255}$")]
Listen = Annotated[str, AfterValidator(_listen)]
Network = Annotated[str, AfterValidator(_network)]
Seconds = Annotated[float, Field(allow_inf_nan=False)]
Hours = Annotated[float, Field(allow_inf_nan=False)]
Rate = Annotated[float, Field(allow_inf_nan=False)]
Listens = Annotated[tuple[Listen, ...], Field(strict=False)]
AbsolutePath = Annotated[str, Field(pattern=r"^(/[^\x00-\x1f]*)?$")]
Networks = Annotated[tuple[Network, ...], Field(strict=False)]
Ranges = Annotated[tuple[Annotated[str, AfterValidator(_range)], ...], Field(strict=False)]

A_NAME = "1 to 64 printable characters, no blank at either end"
A_TEXT = "up to 255 printable ASCII characters"
LISTENS = 'a list of "IPv4:port" or "[IPv6]:port" such as "127.0.0.1:1502"; [] turns the face off'
NETWORKS = 'a list of addresses or networks such as "127.0.0.0/8", "10.1.2.3" or "::1/128"'
A_FILE = 'the absolute path of a file, or "" for none'
RANGES = 'a list of PDU addresses or ranges of them such as "0xE000-0xE005" or "0x0001"'
LOOPBACK = ("127.0.0.0/8", "::1/128")


class Table(BaseModel):
    """A table of the file: unknown keys are refused, nothing is converted, nothing can be changed."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)
