"""Connects, asks once and leaves, again and again: `connector.py PORT COUNT WAYS…`; prints how many replies came.

Each connection ends in another way: closed, reset, cut off in the middle of a request, or left to the other side.
"""

from __future__ import annotations

import socket
import struct
import sys

REQUEST = struct.pack(">HHHBBHH", 1, 0, 6, 99, 3, 0x10, 2)  # of nobody: answered 0A at once, and under no rate
RESET = struct.pack("ii", 1, 0)


def main() -> None:
    """Run through the ways in turn."""
    port, count = int(sys.argv[1]), int(sys.argv[2])
    replies = 0
    for number in range(count):
        with socket.create_connection(("127.0.0.1", port), timeout=30) as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)  # no TIME_WAIT: ports would run out
            way = number % 8
            if way == 0:
                client.sendall(REQUEST[:5])
            elif way == 1:
                client.sendall(REQUEST * 3)  # and gone before the replies
            else:
                client.sendall(REQUEST)
                replies += len(client.recv(300)) >= 9
                if way == 2:
                    client.shutdown(socket.SHUT_WR)
                    client.recv(1)
    sys.stdout.write(f"{replies}\n")


if __name__ == "__main__":
    main()
