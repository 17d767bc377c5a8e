"""What is about TCP and addresses and knows nothing of Modbus."""

from __future__ import annotations

import socket
from asyncio import BaseTransport
from collections.abc import Sequence
from contextlib import suppress
from ipaddress import IPv6Address, ip_address

from gateway.faces.modbus.settings import Network

KEEPALIVE_IDLE_S = 30
KEEPALIVE_INTERVAL_S = 10
KEEPALIVE_PROBES = 3
USER_TIMEOUT_MS = 20_000


def client_name(peername: tuple[str, int] | tuple[str, int, int, int] | None) -> str:
    """The address of a socket's other end without its port; "" when it has gone already.

    One client has one name, whichever way it came: an IPv4 address mapped into IPv6 is written as the IPv4 one.
    """
    if not peername:
        return ""
    host = peername[0]
    return host.removeprefix("::ffff:") if "." in host else host


def allowed(peer: str, networks: Sequence[Network]) -> bool:
    """Whether an address lies in one of the networks; an IPv4 address mapped into IPv6 counts as the IPv4 one."""
    try:
        address = ip_address(peer.partition("%")[0])
    except ValueError:
        return False
    if isinstance(address, IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    return any(address in network for network in networks)


def keep_alive(transport: BaseTransport) -> None:
    """Have the kernel end the connection of a peer that is gone: after 60 s idle, after 20 s of unacknowledged data.

    Replies leave at once, not when the peer has acknowledged the last one.
    """
    sock = transport.get_extra_info("socket")
    if sock is None:
        return
    with suppress(OSError):  # a peer that is gone already; its end is reported in the ordinary way
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in (
            ("TCP_KEEPIDLE", KEEPALIVE_IDLE_S),
            ("TCP_KEEPINTVL", KEEPALIVE_INTERVAL_S),
            ("TCP_KEEPCNT", KEEPALIVE_PROBES),
            ("TCP_USER_TIMEOUT", USER_TIMEOUT_MS),
        ):
            if hasattr(socket, option):  # not every system has them
                sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
