"""Who may read what. There is no way to grant anything else.

The decision is ours and explicit, made before a message is decoded: pysnmp's own access control answers "in view"
when a view has no entries. Here the rule is one look-up that ends in "no" unless an entry says otherwise:

1. An address that no credential lists is refused; its datagram is not looked at.
2. A community or user is accepted only from its own networks; an unknown name, and a known name from elsewhere, are the
   same refusal.
3. What a credential may read is a mapping from contexts to windows: lists of cells from which everything
   outside of its view is missing. There is nothing else that it could be led to. Nobody writes.
4. What is kept of an address is bounded: SOURCES_KEPT of them, the longest known forgotten first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from ipaddress import IPv4Address, IPv6Address, ip_address

from gateway.faces.snmp.settings import Community, Network, User, View
from gateway.faces.snmp.tree import Window

Address = IPv4Address | IPv6Address
Windows = Mapping[bytes, Window]
"""What a credential may read, by context; "" is the default context."""

SOURCES_KEPT = 1024
BURST_S = 10.0
"""A source may use this much of its allowance at once."""


def source_address(host: str) -> Address:
    """The peer's address; an IPv4 address in IPv6 clothes is taken as IPv4, a zone is left out."""
    address = ip_address(host.partition("%")[0])
    if isinstance(address, IPv6Address) and address.ipv4_mapped is not None:
        return address.ipv4_mapped
    return address


class Source:
    """An address that may ask, and what it may use."""

    __slots__ = ("_at", "_most", "_rate", "communities", "host", "left", "users")

    def __init__(
        self, host: str, communities: Mapping[bytes, Windows], users: Mapping[bytes, Windows], rate: float
    ) -> None:
        self.host = host
        self.communities = communities
        self.users = users
        self._rate = rate
        self._most = self.left = max(1.0, rate * BURST_S)  # requests that it may still make
        self._at = -math.inf

    def take(self, now: float) -> bool:
        """Use up one request of the allowance; False when there is none left."""
        if self.left < 1.0:
            # What has come back meanwhile is looked at only now.
            self.left = min(self._most, self.left + (now - self._at) * self._rate)
            self._at = now
            if self.left < 1.0:
                return False
        elif self._at == -math.inf:
            self._at = now
        self.left -= 1.0
        return True


class Access:
    """The credentials with their networks and windows."""

    def __init__(
        self,
        communities: Iterable[Community],
        users: Iterable[User],
        windows: Callable[[View], Windows],
        requests_per_s: float,
    ) -> None:
        """`windows` gives what a view shows."""
        self._communities = [(each.name.encode(), each.sources, windows(each.view)) for each in communities]
        self._users = [(each.credentials.name, each.sources, windows(each.view)) for each in users]
        self._requests_per_s = requests_per_s
        self._combinations: dict[tuple[tuple[bytes, int], ...], dict[bytes, Windows]] = {}
        self.known: dict[str, Source | None] = {}

    def source(self, host: str) -> Source | None:
        """What may be used from `host`, None when nothing."""
        try:
            return self.known[host]
        except KeyError:
            return self._learn(host)

    def _learn(self, host: str) -> Source | None:
        address = source_address(host)
        communities = self._usable(self._communities, address)
        users = self._usable(self._users, address)
        source = Source(host, communities, users, self._requests_per_s) if communities or users else None
        if len(self.known) >= SOURCES_KEPT:
            del self.known[next(iter(self.known))]
        self.known[host] = source
        return source

    def _usable(
        self, credentials: Iterable[tuple[bytes, tuple[Network, ...], Windows]], address: Address
    ) -> dict[bytes, Windows]:
        """The credentials that list the address; the same object for all addresses that may use the same ones."""
        usable: dict[bytes, Windows] = {}
        for name, networks, windows in credentials:
            if any(address in network for network in networks):
                usable.setdefault(name, windows)  # of a name that is given twice, the first counts
        same = tuple((name, id(windows)) for name, windows in usable.items())
        return self._combinations.setdefault(same, usable)
