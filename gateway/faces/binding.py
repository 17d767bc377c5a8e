"""Why an address cannot be listened on, in the same words on every face."""

from __future__ import annotations

import errno
import os
import socket

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
