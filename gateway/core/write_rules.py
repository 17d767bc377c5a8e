"""Who may write what.

Rule 1: what no rule allows is refused. A rule holds for a requester when its conditions, the networks and the roles
        that it names, are all met; one without any condition holds for nobody.
Rule 2: a rule names points, or ranges of registers and coils. Of a range it allows what the map lets be written, but
        not what the map calls `named_only` (resets, addresses, clearing of counters): that takes its very name.
Rule 3: what the map says is read only is never allowed, whatever a rule says.
Rule 4: several rules add up. A request is allowed when each of its single writes is, else refused whole.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gateway.core.site import Device
from gateway.core.write_request import SingleWrite
from gateway.devices.model import Access, DeviceMap, Point, Space

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
Place = tuple[Space, int]


@dataclass(frozen=True, slots=True)
class Requester:
    """Who asks: the peer's address, and the role of its certificate where it has one."""

    address: str
    role: str | None = None

    def __str__(self) -> str:
        return self.address if self.role is None else f"{self.address} ({self.role})"


@dataclass(frozen=True, slots=True)
class Range:
    """Addresses `first` to `last`, both included."""

    first: int
    last: int


@dataclass(frozen=True, slots=True)
class WriteRule:
    """Who (`sources`, `roles`; None: no condition) may write what on which devices (`unit_ids`; None: on all)."""

    sources: tuple[Network, ...] | None = None
    roles: frozenset[str] | None = None
    unit_ids: frozenset[int] | None = None
    points: frozenset[str] = frozenset()
    registers: tuple[Range, ...] = ()
    coils: tuple[Range, ...] = ()

    def holds_for(self, requester: Requester) -> bool:
        """Rule 1."""
        if self.sources is None and self.roles is None:
            return False
        if self.sources is not None and not _within(requester.address, self.sources):
            return False
        return self.roles is None or requester.role in self.roles

    def allowed(self, device_map: DeviceMap) -> Mapping[Place, Point]:
        """What it allows of a model (rules 2 and 3)."""
        return {
            (point.space, point.address): point
            for point in device_map.points
            if point.access is not Access.READ
            and point.words == 1
            and point.space in device_map.write_functions.values()
            and (point.name in self.points or (not point.named_only and self._in_a_range(point)))
        }

    def _in_a_range(self, point: Point) -> bool:
        ranges = self.coils if point.space is Space.COILS else self.registers
        return any(range_.first <= point.address <= range_.last for range_ in ranges)


class WriteRules:
    """All rules, for one device."""

    def __init__(self, rules: Sequence[WriteRule], device: Device) -> None:
        self.device = device
        found = [
            (rule, rule.allowed(device.map))
            for rule in rules
            if rule.unit_ids is None or device.unit_id in rule.unit_ids
        ]
        self._rules = [(rule, allowed) for rule, allowed in found if allowed]

    def __bool__(self) -> bool:
        """Whether anything of the device may be written by anybody."""
        return bool(self._rules)

    def any_for(self, requester: Requester) -> bool:
        """Whether the requester may write anything at all."""
        return any(rule.holds_for(requester) for rule, _ in self._rules)

    def points(self, requester: Requester, writes: Sequence[SingleWrite]) -> tuple[Point, ...] | None:
        """The points that these single writes change, or None when one of them is not allowed (rule 4)."""
        tables = [allowed for rule, allowed in self._rules if rule.holds_for(requester)]
        found = []
        for write in writes:
            point = next(
                (allowed[place] for allowed in tables if (place := (write.space, write.address)) in allowed), None
            )
            if point is None:
                return None
            found.append(point)
        return tuple(found)


def _within(address: str, networks: Sequence[Network]) -> bool:
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return False
    if isinstance(ip, ipaddress.IPv6Address) and ip.ipv4_mapped is not None:
        ip = ip.ipv4_mapped
    return any(ip in network for network in networks)
