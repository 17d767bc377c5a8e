"""A cable to another machine, which is a network namespace; the fixture `cable` (conftest.py) plugs one in."""

from __future__ import annotations

import os
import subprocess
from ipaddress import ip_network

NETWORK = ip_network("198.18.0.0/15")  # for measurements between devices (RFC 2544)


class Cable:
    """A network namespace at the other end of a pair of interfaces of ours."""

    def __init__(self, ip: str) -> None:
        self._ip = ip
        self.name = f"pgw{os.getpid()}"
        self.near, self.far = f"{self.name}a", f"{self.name}b"
        first = NETWORK[4 * (os.getpid() % (NETWORK.num_addresses // 4))]  # tests run side by side, each in its /30
        self.here, self.there = str(first + 1), str(first + 2)

    def run(self, *arguments: str) -> None:
        subprocess.run([self._ip, *arguments], check=True, capture_output=True, text=True)

    def plug_in(self) -> None:
        self.run("netns", "add", self.name)
        self.run("link", "add", self.near, "type", "veth", "peer", "name", self.far, "netns", self.name)
        self.run("addr", "add", f"{self.here}/30", "dev", self.near)
        self.run("link", "set", self.near, "up")
        self.run("-n", self.name, "addr", "add", f"{self.there}/30", "dev", self.far)
        self.run("-n", self.name, "link", "set", self.far, "up")

    def cut(self) -> None:
        """Nothing goes through any more, and neither end is told."""
        self.run("-n", self.name, "link", "set", self.far, "down")

    def mend(self) -> None:
        """It goes through again."""
        self.run("-n", self.name, "link", "set", self.far, "up")

    def remove(self) -> None:
        for command in (("link", "del", self.near), ("netns", "del", self.name)):
            subprocess.run([self._ip, *command], check=False, capture_output=True)
