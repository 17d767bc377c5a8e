"""Whose a certificate is by its subjectAltName, and what its names are compared with.

Rule 1: the names of a certificate are the dNSName and iPAddress entries of its subjectAltName (RFC 5280 4.2.1.6). The
        common name of its subject is none of them (RFC 9525 2), nor is an entry of another kind.
Rule 2: DNS names are compared as they stand, without regard to case. Nobody is asked what a name leads to.
Rule 3: `*.` at the front of a configured name stands for one label. A client's certificate with such a name names
        nobody: the name fits nothing.
Rule 4: an address is an address, however it is written; an entry that is no name, or no address, is left out.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cryptography import x509

Address = IPv4Address | IPv6Address
Network = IPv4Network | IPv6Network

SHOWN = 4
_LABEL = r"[a-z0-9_](?:[a-z0-9_-]{0,61}[a-z0-9_])?"
_DNS_NAME = re.compile(rf"(?:\*\.)?(?:{_LABEL}\.)*(?=[a-z0-9_-]*[a-z_]){_LABEL}")
_LONGEST = 253
_THIS_MACHINE = "localhost"


@dataclass(frozen=True, slots=True)
class Names:
    """The names of one certificate, in its order, DNS names in lower case."""

    dns: tuple[str, ...] = ()
    addresses: tuple[Address, ...] = ()

    def __str__(self) -> str:
        """Them, or the first of them, as OpenSSL writes them; "none" for none."""
        texts = [*(f"DNS:{name}" for name in self.dns), *(f"IP:{address}" for address in self.addresses)]
        left_out = [f"and {len(texts) - SHOWN} more"] if len(texts) > SHOWN else []
        return ", ".join([*texts[:SHOWN], *left_out]) or "none"

    def hold(self, peer: str) -> bool:
        """Whether one is the address of `peer`."""
        address = _address(peer)
        return address is not None and address in self.addresses

    def lead_to(self, host: str) -> bool:
        """Whether a client may find one of them at a server that listens on `host`, as far as names alone tell.

        Where a DNS name leads is not known; that `localhost` leads to a loopback address, and no other name does, is.
        """
        here = ip_address(host)
        if here in self.addresses:
            return True
        if here.is_loopback:
            return _THIS_MACHINE in self.dns
        if any(name != _THIS_MACHINE for name in self.dns):
            return True
        return here.is_unspecified and any(
            not address.is_loopback and address.version == here.version for address in self.addresses
        )


@dataclass(frozen=True, slots=True)
class WantedNames:
    """Names of which a client's certificate must have one."""

    dns: frozenset[str] = frozenset()  # in lower case; "*." at the front stands for one label
    networks: tuple[Network, ...] = ()

    def fit(self, names: Names) -> bool:
        """Whether one of `names` is wanted (rules 2 to 4)."""
        return any(self._fits(name) for name in names.dns) or any(
            address in network for address in names.addresses for network in self.networks
        )

    def _fits(self, name: str) -> bool:
        first, _, rest = name.partition(".")
        return first != "*" and (name in self.dns or f"*.{rest}" in self.dns)


def names_of(certificate: x509.Certificate) -> Names:
    """The names of a certificate whose extensions can be read."""
    from cryptography import x509  # noqa: PLC0415 - for who has a certificate; the settings import this file

    try:
        entries = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return Names()
    dns = (name for text in entries.get_values_for_type(x509.DNSName) if (name := _dns_name(text)) is not None)
    addresses = (value for value in entries.get_values_for_type(x509.IPAddress) if isinstance(value, Address))
    return Names(tuple(dict.fromkeys(dns)), tuple(dict.fromkeys(addresses)))


def wanted_names(texts: Iterable[str]) -> WantedNames:
    """What a list of DNS names, addresses and networks asks for; ValueError for anything else in it."""
    dns: set[str] = set()
    networks: list[Network] = []
    for text in texts:
        name = _dns_name(text)
        if name is None:
            networks.append(ip_network(text))
        else:
            dns.add(name)
    return WantedNames(frozenset(dns), tuple(networks))


def _dns_name(text: str) -> str | None:
    """A DNS name in lower case; None for what is none, such as an address: the last label is not a number."""
    name = text.lower()
    return name if len(name) <= _LONGEST and name.isascii() and _DNS_NAME.fullmatch(name) else None


def _address(peer: str) -> Address | None:
    try:
        return ip_address(peer.partition("%")[0])
    except ValueError:
        return None
