"""From a request to its reply or to the question for the line: the table of design §6, without sockets.

Order of the checks: unit id, function (policy), then `core.serving`, or for a write the rest of the policy.
The rate limits come first for the client, and for device and line when it is certain that the line is needed.
Every request that comes in here is counted once as a request, and once as a cache hit, as forwarded or as an
exception; an exception that ends a forwarded request is counted under its code as well.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from gateway.clock import Clock
from gateway.core.clients import Client
from gateway.core.policy import ROLE_REQUIRED, Audit, Reason, Refusal, decide
from gateway.core.ratelimit import CLIENT, CLIENT_LINE, LineLimiter
from gateway.core.serving import Ask, FromMemory, Serving
from gateway.core.site import Device, Outcome, Site, Ticket
from gateway.core.stats import ModbusServerStats
from gateway.core.status_registers import FUNCTIONS, StatusRegisters
from gateway.core.status_registers import UNIT as STATUS_UNIT
from gateway.core.write_rules import Requester
from gateway.core.writing import Job
from gateway.errors import IllegalFunction, RateLimited, RequestError, ShuttingDown, UnitNotRouted
from gateway.faces.modbus.hot import HotReplies
from gateway.faces.modbus.settings import ModbusSettings
from gateway.faces.modbus.writer import Writer
from gateway.modbus import mbap
from gateway.modbus.pdu import exception_reply, is_exception

logger = logging.getLogger(__name__)

_OWN_LIMITS = (CLIENT, CLIENT_LINE)

_KEY = struct.Struct(">HHB")
_UNIT_AT = 4  # of an ADU without its transaction id
BROADCAST = 0
RESERVED = range(248, 255)
"""Unit ids that no device may have (Modbus over serial line 2.2)."""


class Forward(NamedTuple):
    """A read that the line has to answer."""

    unit: int
    serving: Serving
    ask: Ask

    @property
    def pdu(self) -> bytes:
        """The request."""
        return self.ask.pdu

    def begin(self, client: str, done: Callable[[Outcome], None]) -> Ticket:
        """Ask the line; `done` as for `LinePort.read`."""
        device = self.serving.device
        return device.line.read(device, self.ask.pdu, done, client=client)

    @staticmethod
    def given_up(ticket: Ticket | None) -> RequestError:
        """What its client is told when nobody can wait for the answer any longer."""
        del ticket  # whether it was sent makes no difference
        return ShuttingDown()

    def concluded(self, outcome: Outcome) -> None:
        """The line has answered, perhaps after its client left."""
        self.serving.learn(self.ask, outcome)


@dataclass(frozen=True, slots=True)
class WriteOrder:
    """A write that is allowed."""

    unit: int
    serving: Serving
    job: Job
    writer: Writer

    @property
    def pdu(self) -> bytes:
        """The request."""
        return self.job.pdu

    def begin(self, client: str, done: Callable[[Outcome], None]) -> Ticket:
        """Have it done; `done` as for `LinePort.write`."""
        del client  # the job knows who asked
        return self.writer.submit(self.job, done, self.serving.forget)

    def given_up(self, ticket: Ticket | None) -> RequestError:
        """See `Forward.given_up`."""
        return self.writer.given_up(ticket)

    def concluded(self, outcome: Outcome) -> None:
        """A write teaches nothing: what it wrote is read again."""


Waiting = Forward | WriteOrder
"""A request whose answer comes later."""


class Routes:
    """Which device a unit id stands for. What is remembered of a device is shared by every way to it.

    It outlives a change of the configuration as long as the device is the same, of the same model.
    """

    def __init__(self, settings: ModbusSettings, site: Site, before: Routes | None = None) -> None:
        known = {} if before is None else {serving.device: serving for serving in before.all}
        self.all: Sequence[Serving] = [_serving(settings, device, known.get(device)) for device in site.devices]

    def by_unit(self) -> Mapping[int, Serving]:
        """The configured unit ids."""
        return _usable({serving.device.unit_id: serving for serving in self.all})

    def of_line(self, name: str) -> Mapping[int, Serving]:
        """The devices of one line by their addresses there: what a port that stands for this line serves."""
        return _usable({s.device.address: s for s in self.all if s.device.line.name == name})


@dataclass(frozen=True, slots=True)
class Shared:
    """What all ways in have in common."""

    stats: ModbusServerStats
    audit: Audit
    limiter: LineLimiter
    writer: Writer | None  # None: nobody may write


class Dispatcher:
    """The requests of one way in. Replies are ADUs without their transaction id.

    `barred`: it is the way of those who have no right at all (R-23); each request is refused with 01.
    """

    def __init__(self, routes: Mapping[int, Serving], clock: Clock, shared: Shared, *, barred: bool = False) -> None:
        self.hot = HotReplies()  # its keys hold the unit id, which means another device on another way in
        self.stats = shared.stats
        self.now = clock.monotonic
        self._audit = shared.audit
        self._routes = routes
        self._own: StatusRegisters | None = None
        self._barred = barred
        self._limiter = shared.limiter
        self._writer = shared.writer

    def reroute(self, routes: Mapping[int, Serving], shared: Shared, own: StatusRegisters | None = None) -> None:
        """Serve these from now on, and `own` as unit 255; what is under way ends as it began."""
        self._routes = routes
        self._own = own
        self._limiter = shared.limiter
        self._writer = shared.writer
        self.hot.clear()

    def answer(self, unit: int, pdu: bytes, client: Client, now: float, role: str | None = None) -> bytes | Waiting:
        """The reply to a request, or what its answer has to come from; `role`: that of the client's certificate.

        A client that asks more than it may has its `pause_s` set.
        """
        self.stats.requests += 1
        if not client.lease(now):
            client.unpaid += 1
            return self.refuse(unit, pdu, client, self._limited(client, CLIENT, now))
        client.left -= 1
        client.slow += 1
        request = _KEY.pack(0, len(pdu) + 1, unit) + pdu
        entry = self.hot.find(request)
        if entry is not None and now < entry[0] and entry[1].snapshot.mark is entry[2]:
            self.stats.cache_hits += 1
            return entry[3]
        try:
            return self._look_at(request, pdu, client, _requester(client.name, role), now)
        except RequestError as error:
            return self.refuse(unit, pdu, client, error)

    def _look_at(self, request: bytes, pdu: bytes, client: Client, requester: Requester, now: float) -> bytes | Waiting:
        """What comes of a request that was paid for; raises the RequestError that refuses it."""
        unit = request[_UNIT_AT]
        if unit == STATUS_UNIT and self._own is not None and not self._barred:
            return self._answer_myself(self._own, pdu, requester, now)
        serving = self._route(unit, pdu, requester, now)
        writer = self._writer
        rules = None if writer is None else writer.rules(serving.device)
        decision = decide(pdu[0], serving.functions, rules, requester)
        if not decision.allowed:
            raise self._refused(Refusal(decision, IllegalFunction()), requester, unit, pdu, now)
        if decision.reason is Reason.WRITE and writer is not None:
            planned = writer.plan(serving.device, requester, pdu)
            if isinstance(planned, Refusal):
                raise self._refused(planned, requester, unit, pdu, now)
            if not planned.slave_control:  # which nobody's flood of the line may hold back
                self._check_rate(client, serving.device, now)
            self._forwarded(client)
            return WriteOrder(unit, serving, planned, writer)
        answer = serving.answer(pdu, now)
        if isinstance(answer, FromMemory):
            self.stats.cache_hits += 1
            reply = mbap.encode(0, unit, answer.reply)[2:]
            self.hot.keep(request, serving.device, answer, reply)
            return reply
        self._check_rate(client, serving.device, now)
        self._forwarded(client)
        return Forward(unit, serving, answer)

    def refuse(self, unit: int, pdu: bytes, client: Client, error: RequestError) -> bytes:
        """The reply to a request that goes no further."""
        client.refused += 1
        return self._exception(unit, pdu, client, error)

    def conclude(self, waiting: Waiting, client: Client, outcome: Outcome) -> bytes:
        """The reply to a request that had to wait, from what came of it."""
        if isinstance(outcome, RequestError):
            return self._exception(waiting.unit, waiting.pdu, client, outcome)
        waiting.concluded(outcome)
        if is_exception(outcome):
            self.stats.exceptions[outcome[1]] += 1
            client.exceptions[outcome[1]] += 1
        return _KEY.pack(0, len(outcome) + 1, waiting.unit) + outcome

    def _answer_myself(self, own: StatusRegisters, pdu: bytes, requester: Requester, now: float) -> bytes:
        decision = decide(pdu[0], FUNCTIONS)
        if not decision.allowed:
            raise self._refused(Refusal(decision, IllegalFunction()), requester, STATUS_UNIT, pdu, now)
        reply = own.answer(pdu, now)
        self.stats.cache_hits += 1
        return mbap.encode(0, STATUS_UNIT, reply)[2:]

    def _route(self, unit: int, pdu: bytes, requester: Requester, now: float) -> Serving:
        if self._barred:
            raise self._refused(Refusal(ROLE_REQUIRED, IllegalFunction()), requester, unit, pdu, now)
        serving = self._routes.get(unit)
        if serving is None:
            raise UnitNotRouted
        return serving

    def _refused(self, refusal: Refusal, requester: Requester, unit: int, pdu: bytes, now: float) -> RequestError:
        line = self._audit.record(refusal.decision, requester.address, unit, pdu, now, role=requester.role)
        if line is not None:
            logger.warning("%s", line)
        return refusal.error

    def _check_rate(self, client: Client, device: Device, now: float) -> None:
        limit = self._limiter.take(client.line_bucket, device, now)
        if limit is not None:
            raise self._limited(client, limit, now)

    def _limited(self, client: Client, limit: str, now: float) -> RequestError:
        self.stats.limited[limit] += 1
        client.limited += 1
        if limit in _OWN_LIMITS:
            client.pause_s = (client.bucket if limit == CLIENT else client.line_bucket).pause_s(now)
        return RateLimited(limit)

    def _forwarded(self, client: Client) -> None:
        self.stats.forwarded += 1
        client.forwarded += 1

    def _exception(self, unit: int, pdu: bytes, client: Client, error: RequestError) -> bytes:
        self.stats.exceptions[error.exception_code] += 1
        client.exceptions[error.exception_code] += 1
        return mbap.encode(0, unit, exception_reply(pdu[0], error.exception_code))[2:]


_requester = lru_cache(maxsize=256)(Requester)


def _serving(settings: ModbusSettings, device: Device, before: Serving | None) -> Serving:
    if before is None or before.map is not device.map:
        return Serving(device, max_age_s=settings.max_age_s, strict_map=settings.strict_map)
    before.adjust(max_age_s=settings.max_age_s, strict_map=settings.strict_map)
    return before


def _usable(routes: Mapping[int, Serving]) -> Mapping[int, Serving]:
    return {unit: serving for unit, serving in routes.items() if unit != BROADCAST and unit not in RESERVED}
