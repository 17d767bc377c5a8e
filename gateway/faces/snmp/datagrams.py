"""Sockets that answer from the address that was asked.

A UDP socket that listens on every address of the machine sends from the one that the kernel prefers for the way back.
Who asked another one has asked somebody else then: a connected socket and every firewall drop such an answer. So the
kernel is told to say of each datagram where it went (ip(7) IP_PKTINFO, RFC 3542 §6.2), and of each answer where from.
A socket that is bound to one address needs none of this.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from ipaddress import ip_address
from typing import Any, Protocol

_IP_PKTINFO = 8
"""Linux's; not every Python's socket module names it."""

_ROOM = socket.CMSG_SPACE(20)
"""For an in6_pktinfo; an in_pktinfo is shorter."""

_LINK_LOCAL = b"\xfe\x80"
_MULTICAST = b"\xff"

Ancillary = list[tuple[int, int, bytes]]


class Datagrams(Protocol):
    """What the agent needs of a socket; an address is whatever `recvfrom` gives, the host first."""

    def recvfrom(self, bufsize: int, /) -> tuple[bytes, Any]:
        """The next datagram, and where it came from."""
        ...

    def sendto(self, data: bytes, address: Any, /) -> object:
        """Send a datagram to where one came from."""
        ...


class Everywhere:
    """A socket that is bound to no address in particular; its addresses know where they asked."""

    def __init__(self, sock: socket.socket) -> None:
        self._receive = sock.recvmsg
        self._send = sock.sendmsg
        if sock.family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_RECVPKTINFO, 1)
        else:
            sock.setsockopt(socket.IPPROTO_IP, _IP_PKTINFO, 1)

    def recvfrom(self, bufsize: int, /) -> tuple[bytes, tuple[str, Any, Ancillary]]:
        """See Datagrams."""
        data, ancillary, _, address = self._receive(bufsize, _ROOM)
        return data, (address[0], address, ancillary)

    def sendto(self, data: bytes, address: tuple[str, Any, Ancillary], /) -> object:
        """See Datagrams."""
        _, to, asked = address
        return self._send((data,), answering(asked), 0, to)


def datagrams(sock: socket.socket) -> Datagrams:
    """The bound socket itself where it has an address, otherwise what answers from the one that was asked."""
    host = sock.getsockname()[0]
    return Everywhere(sock) if ip_address(host.partition("%")[0]).is_unspecified else sock


def answering(asked: Sequence[tuple[int, int, bytes]]) -> Ancillary:
    """What sends from where a datagram went, of what came with it; nothing for what went to no single machine.

    The interface is left to the routes, but for a link-local address, which says nothing without it.
    """
    for level, kind, where in asked:
        if (level, kind) == (socket.IPPROTO_IP, _IP_PKTINFO):
            # in_pktinfo: interface, the local address, the destination; the latter two differ for a broadcast.
            return [(level, kind, bytes(4) + where[4:8] + bytes(4))]
        if (level, kind) == (socket.IPPROTO_IPV6, socket.IPV6_PKTINFO) and not where.startswith(_MULTICAST):
            # in6_pktinfo: the destination, interface
            return [(level, kind, where if where.startswith(_LINK_LOCAL) else where[:16] + bytes(4))]
    return []
