"""What the SNMP agent saw and did since start; the SNMPv2-MIB snmp group and /metrics read it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class SnmpCounters:
    """Counts of datagrams. `in_packets` = `responses` + `dropped`; a report is among the dropped, by its cause."""

    in_packets: int = 0
    responses: int = 0
    refused_sources: int = 0  # from an address that no credential lists; not even decoded
    rate_limited: int = 0  # from a source that asks too much; not even decoded
    oversized: int = 0  # longer than one Ethernet frame carries; not even decoded
    parse_errors: int = 0  # snmpInASNParseErrs
    bad_versions: int = 0  # snmpInBadVersions
    bad_community_names: int = 0  # unknown name, or a known one from the wrong network
    silent_drops: int = 0  # a PDU that an agent has no business with (response, trap, report …)
    unknown_security_models: int = 0  # snmpUnknownSecurityModels
    invalid_messages: int = 0  # snmpInvalidMsgs: flags that contradict each other
    unknown_engine_ids: int = 0  # usmStatsUnknownEngineIDs; discovery counts here
    unknown_user_names: int = 0  # usmStatsUnknownUserNames, or a known one from the wrong network
    unsupported_security_levels: int = 0  # usmStatsUnsupportedSecLevels: less than authPriv
    wrong_digests: int = 0  # usmStatsWrongDigests: wrong authentication key, or changed on the way
    not_in_time_windows: int = 0  # usmStatsNotInTimeWindows: replayed, or the first message of an asker
    decryption_errors: int = 0  # usmStatsDecryptionErrors: wrong privacy key
    unknown_contexts: int = 0  # snmpUnknownContexts
    unknown_pdu_handlers: int = 0  # snmpUnknownPDUHandlers: a context engine that is not here
    reports: int = 0  # sent; each is counted above by its cause as well
    bad_community_uses: int = 0  # SET: a known credential that asks for what none may
    internal_errors: int = 0  # a defect of ours: logged with its traceback, answered genErr
    send_failures: int = 0  # replies that the system did not take

    @property
    def dropped(self) -> int:
        """Datagrams that got no response."""
        return (
            self.refused_sources
            + self.rate_limited
            + self.oversized
            + self.parse_errors
            + self.bad_versions
            + self.bad_community_names
            + self.silent_drops
            + self.unknown_security_models
            + self.invalid_messages
            + self.unknown_engine_ids
            + self.unknown_user_names
            + self.unsupported_security_levels
            + self.wrong_digests
            + self.not_in_time_windows
            + self.decryption_errors
            + self.unknown_contexts
            + self.unknown_pdu_handlers
        )
