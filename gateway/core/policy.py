"""Who may do what: the decision, and its trace in the log.

Rule 1: a request is allowed only when its function is one the device's map reads with, 2B/0E, or a write that a rule
        allows; what is not named is refused, so a new function is refused until a rule here names it.
Rule 2: without rules nothing may write: every function that changes a device (05, 06, 0F, 10, 16, 17) is refused
        with exception 01, whatever its range, whether it is well formed or not. So it is for a requester for whom no
        rule holds, and 16 and 17 are refused to everybody (write_request.py).
Rule 3: of those who may write something, a request that is not well formed is told so (03, 02); one of which any part
        is not allowed is refused whole with 01; one with a value outside its limits is refused whole with 03.
Rule 4: every refusal has a reason, and is counted under it.
Rule 5: every write leaves one log line for each register or coil: who, unit, point, address, old and new value,
        outcome. A refused one leaves one with function and address, never the value. What a peer can cause as often
        as it likes (refusals, writes that change nothing, slave control) is rationed by `core.log_budget`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum

from gateway.core.log_budget import LogBudget
from gateway.core.write_ledger import Fate
from gateway.core.write_request import parse_write
from gateway.core.write_rules import Requester, WriteRules
from gateway.core.write_values import check_value
from gateway.core.writing import Job, Part, PartResult
from gateway.errors import IllegalDataValue, IllegalFunction, RequestError

READ_DEVICE_IDENTIFICATION = 0x2B
WRITE_FUNCTIONS = frozenset({0x05, 0x06, 0x0F, 0x10, 0x16, 0x17})
_MASK_WRITE = 0x16
_READ_WRITE_MULTIPLE = 0x17


class Reason(StrEnum):
    """Why a request was allowed or refused; the label under which it is counted."""

    READ = "read"
    WRITE = "write"
    WRITES_DISABLED = "writes_disabled"
    NO_WRITE_RULE = "no_write_rule"
    WRITE_FUNCTION = "write_function"
    WRITE_NOT_ALLOWED = "write_not_allowed"
    WRITE_VALUE = "write_value"
    UNKNOWN_FUNCTION = "unknown_function"
    ROLE_REQUIRED = "role_required"


@dataclass(frozen=True, slots=True)
class Decision:
    """The answer of the policy to one request."""

    allowed: bool
    reason: Reason


_READ = Decision(allowed=True, reason=Reason.READ)
_WRITE = Decision(allowed=True, reason=Reason.WRITE)
_WRITES_DISABLED = Decision(allowed=False, reason=Reason.WRITES_DISABLED)
_NO_WRITE_RULE = Decision(allowed=False, reason=Reason.NO_WRITE_RULE)
_WRITE_FUNCTION = Decision(allowed=False, reason=Reason.WRITE_FUNCTION)
_WRITE_NOT_ALLOWED = Decision(allowed=False, reason=Reason.WRITE_NOT_ALLOWED)
_WRITE_VALUE = Decision(allowed=False, reason=Reason.WRITE_VALUE)
_UNKNOWN = Decision(allowed=False, reason=Reason.UNKNOWN_FUNCTION)
ROLE_REQUIRED = Decision(allowed=False, reason=Reason.ROLE_REQUIRED)


def decide(
    function: int, readable: Collection[int], rules: WriteRules | None = None, requester: Requester | None = None
) -> Decision:
    """Whether a request with this function code may go on; `readable`: the functions the map reads with.

    `rules` are those of the device that is asked for, None where writes are off. A write that may go on is looked
    at as a whole by `plan`.
    """
    if function in WRITE_FUNCTIONS:
        if rules is None:
            return _WRITES_DISABLED
        if requester is None or not rules.any_for(requester):
            return _NO_WRITE_RULE
        return _WRITE_FUNCTION if function in {_MASK_WRITE, _READ_WRITE_MULTIPLE} else _WRITE
    if function in readable or function == READ_DEVICE_IDENTIFICATION:
        return _READ
    return _UNKNOWN


@dataclass(frozen=True, slots=True)
class Refusal:
    """A write that is not done: why, and what the client is told."""

    decision: Decision
    error: RequestError


def plan(pdu: bytes, rules: WriteRules, requester: Requester, id_: str) -> Job | Refusal:
    """The job of a write request that `decide` let go on, or why it is refused (rule 3).

    Raises IllegalDataValue or IllegalDataAddress for a request that is not well formed, IllegalFunction for one that
    the model cannot do. `id_` is unique in the ledger.
    """
    device = rules.device
    writes = parse_write(pdu, device.map)
    points = rules.points(requester, writes)
    if points is None:
        return Refusal(_WRITE_NOT_ALLOWED, IllegalFunction("not allowed"))
    try:
        for write, point in zip(writes, points, strict=True):
            reading = device.decode.get(point.name)
            check_value(point, write.value, device.map, reading, device.snapshot.values)
    except IllegalDataValue as error:
        return Refusal(_WRITE_VALUE, error)
    parts = tuple(Part(write, point, device.map.wears(point)) for write, point in zip(writes, points, strict=True))
    return Job(id_, requester, device, pdu, parts)


class Audit:
    """Refusals of one face: all counted in `refused` (reason → count), logged within bounds (rule 5)."""

    def __init__(self, refused: Counter[str]) -> None:
        self._refused = refused
        self._budget = LogBudget()
        self._often = LogBudget()

    def record(
        self, decision: Decision, peer: str, unit: int, pdu: bytes, now: float, *, role: str | None = None
    ) -> str | None:
        """Count a refusal; returns the log line that it is worth, or None."""
        self._refused[decision.reason] += 1
        if decision.reason is Reason.UNKNOWN_FUNCTION:
            return None
        at = 5 if pdu[0] == _READ_WRITE_MULTIPLE else 1  # function 17 names the range that it reads first
        address = f"0x{pdu[at]:02x}{pdu[at + 1]:02x}" if len(pdu) >= at + 2 else "none"
        left_out = self._budget.spend((peer, role, unit, pdu[0], address, decision.reason), now)
        if left_out is None:
            return None
        event = "request_refused" if decision.reason is Reason.ROLE_REQUIRED else "write_refused"
        who = peer if role is None else f'{peer} role="{role}"'
        return (
            f"event={event} peer={who} unit={unit} function=0x{pdu[0]:02x} address={address}"
            f" reason={decision.reason} left_out={left_out}"
        )

    def written(self, job: Job, result: PartResult, now: float) -> str | None:
        """The log line of a single write that was allowed, or None when the log has heard enough of it."""
        part = result.part
        left_out: int | None = 0
        if result.fate in {Fate.UNCHANGED, Fate.NOT_SENT} or part.point.rewrite_s is not None:
            key = (job.requester, job.device.unit_id, part.write.space, part.write.address, result.fate, result.error)
            left_out = self._often.spend(key, now)
        if left_out is None:
            return None
        old = "unknown" if result.old is None else f"0x{result.old:04X}"
        role = "" if job.requester.role is None else f' role="{job.requester.role}"'
        error = f" error={result.error}" if result.error else ""
        return (
            f"event=write peer={job.requester.address}{role} unit={job.device.unit_id} point={part.point.name}"
            f" {part.write.space}=0x{part.write.address:04X} old={old} new=0x{part.write.value:04X}"
            f" outcome={result.fate}{error} left_out={left_out}"
        )
