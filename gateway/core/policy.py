"""Who may do what: the decision, and its trace in the log.

Rule 1: a request is allowed only when its function is one the device's map reads with, or 2B/0E;
        what is not named is refused, so a new function is refused until a rule here names it.
Rule 2: nothing may write. Every function that changes a device (05, 06, 0F, 10, 16, 17) is refused
        with exception 01, whatever its range, whether it is well formed or not.
Rule 3: every refusal has a reason, and is counted under it.
Rule 4: a refused write leaves one log line: peer, unit, function, address; never the value. Repeats are
        rationed by `core.log_budget`, so that nobody fills a disk.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum

from gateway.core.log_budget import LogBudget

READ_DEVICE_IDENTIFICATION = 0x2B
WRITE_FUNCTIONS = frozenset({0x05, 0x06, 0x0F, 0x10, 0x16, 0x17})
_READ_WRITE_MULTIPLE = 0x17


class Reason(StrEnum):
    """Why a request was allowed or refused; the label under which it is counted."""

    READ = "read"
    WRITES_DISABLED = "writes_disabled"
    UNKNOWN_FUNCTION = "unknown_function"


@dataclass(frozen=True, slots=True)
class Decision:
    """The answer of the policy to one request."""

    allowed: bool
    reason: Reason


_READ = Decision(allowed=True, reason=Reason.READ)
_WRITE_REFUSED = Decision(allowed=False, reason=Reason.WRITES_DISABLED)
_UNKNOWN = Decision(allowed=False, reason=Reason.UNKNOWN_FUNCTION)


def decide(function: int, readable: Collection[int]) -> Decision:
    """Whether a request with this function code may go on; `readable`: the functions the map reads with."""
    if function in WRITE_FUNCTIONS:
        return _WRITE_REFUSED
    if function in readable or function == READ_DEVICE_IDENTIFICATION:
        return _READ
    return _UNKNOWN


class Audit:
    """Refusals of one face: all counted in `refused` (reason → count), logged within bounds (rule 4)."""

    def __init__(self, refused: Counter[str]) -> None:
        self._refused = refused
        self._budget = LogBudget()

    def record(self, decision: Decision, peer: str, unit: int, pdu: bytes, now: float) -> str | None:
        """Count a refusal; returns the log line that it is worth, or None."""
        self._refused[decision.reason] += 1
        if decision.reason is not Reason.WRITES_DISABLED:
            return None
        at = 5 if pdu[0] == _READ_WRITE_MULTIPLE else 1  # function 17 names the range that it reads first
        address = f"0x{pdu[at]:02x}{pdu[at + 1]:02x}" if len(pdu) >= at + 2 else "none"
        left_out = self._budget.spend((peer, unit, pdu[0], address), now)
        if left_out is None:
            return None
        return (
            f"event=write_refused peer={peer} unit={unit} function=0x{pdu[0]:02x} address={address}"
            f" reason={decision.reason} left_out={left_out}"
        )
