"""How a TCP face comes to listen on an address, and why it cannot, in the same words on every face."""

from __future__ import annotations

import asyncio
import errno
import os
import socket

BACKLOG = 128

_REASONS = {
    errno.EADDRINUSE: "another program listens there",
    errno.EACCES: "not permitted: a port below 1024 needs CAP_NET_BIND_SERVICE (deploy/systemd/low-ports.conf)",
    errno.EADDRNOTAVAIL: "this machine has no such address",
    errno.EAFNOSUPPORT: "this machine does not speak that address family",
}


def bind_problem(error: OSError) -> str:
    """The reason in words, without number or address: asyncio's own text has both, and our label names the address."""
    if isinstance(error, socket.gaierror):
        return "the name does not resolve to an address"
    number = error.errno or 0
    return _REASONS.get(number) or (os.strerror(number) if number > 0 else error.strerror or str(error))


async def listening_socket(host: str, port: int, *, send_buffer: int) -> socket.socket:
    """A socket that listens on one address of one family; OSError when it cannot be had.

    Of what is sent to a client that it accepts, the kernel keeps about `send_buffer` octets until the client takes
    them. By itself it would keep megabytes, out of the memory that all connections of the machine share.
    """
    loop = asyncio.get_running_loop()
    (family, kind, protocol, _, address), *_ = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    sock = socket.socket(family, kind, protocol)
    try:
        sock.settimeout(0.0)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, send_buffer)  # which accepted ones inherit
        sock.bind(address)
        sock.listen(BACKLOG)
    except BaseException:
        sock.close()
        raise
    return sock
