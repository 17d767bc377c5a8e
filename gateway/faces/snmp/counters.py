"""What the SNMP agent saw and did since start; the SNMPv2-MIB snmp group and /metrics read it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class SnmpCounters:
    """Counts of datagrams. `in_packets` = every other `…` that drops one + `responses`."""

    in_packets: int = 0
    responses: int = 0
    refused_sources: int = 0  # from an address that no community lists; not even decoded
    oversized: int = 0  # longer than one Ethernet frame carries; not even decoded
    parse_errors: int = 0  # snmpInASNParseErrs
    bad_versions: int = 0  # snmpInBadVersions
    bad_community_names: int = 0  # unknown name, or a known one from the wrong network
    bad_community_uses: int = 0  # SET: a known community that asks for what no community may
    silent_drops: int = 0  # a PDU that an agent has no business with (response, trap, report …)
    internal_errors: int = 0  # a defect of ours: logged with its traceback, answered genErr

    @property
    def dropped(self) -> int:
        """Datagrams that got no response."""
        return (
            self.refused_sources
            + self.oversized
            + self.parse_errors
            + self.bad_versions
            + self.bad_community_names
            + self.silent_drops
        )
