"""Who may read. There is no way to grant anything else.

The decision is ours and explicit, made before a message is decoded: pysnmp's own access control answers "in view"
when a view has no entries. Here the rule is one look-up that ends in "no" unless an entry says otherwise:

1. An address that no community lists is refused; its datagram is not looked at.
2. A community is accepted only from its own networks; an unknown name, and a known name from elsewhere, are the
   same refusal.
3. An accepted community reads the one tree of the gateway. Nobody writes.
"""

from __future__ import annotations

from collections.abc import Iterable
from ipaddress import IPv4Address, IPv6Address, ip_address

from gateway.faces.snmp.settings import Community, Network

Address = IPv4Address | IPv6Address


def source_address(host: str) -> Address:
    """The peer's address; an IPv4 address in IPv6 clothes is taken as IPv4, a zone is left out."""
    address = ip_address(host.partition("%")[0])
    if isinstance(address, IPv6Address) and address.ipv4_mapped is not None:
        return address.ipv4_mapped
    return address


class Access:
    """The communities with their networks."""

    def __init__(self, communities: Iterable[Community]) -> None:
        self._networks: dict[bytes, tuple[Network, ...]] = {}
        for community in communities:
            name = community.name.encode()
            self._networks[name] = self._networks.get(name, ()) + community.sources

    def listed(self, source: Address) -> bool:
        """Whether any community may be used from `source`."""
        return any(_inside(source, networks) for networks in self._networks.values())

    def may_read(self, community: bytes, source: Address) -> bool:
        """Whether this community may read from this address."""
        return _inside(source, self._networks.get(community, ()))


def _inside(source: Address, networks: tuple[Network, ...]) -> bool:
    return any(source in network for network in networks)
