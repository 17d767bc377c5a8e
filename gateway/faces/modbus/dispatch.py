"""From a request to its reply or to the question for the line: the table of design §6, without sockets.

Order of the checks: unit id, function (policy), then `core.serving`. Every request that comes in here
is counted once as a request, and once as a cache hit, as forwarded or as an exception; an exception
that ends a forwarded request is counted under its code as well.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

from gateway.clock import Clock
from gateway.core.policy import Audit, decide
from gateway.core.serving import Ask, FromMemory, Serving
from gateway.core.site import Device, Outcome, Site
from gateway.core.stats import ModbusServerStats
from gateway.errors import IllegalFunction, RequestError, UnitNotRouted
from gateway.faces.modbus.hot import HotReplies
from gateway.faces.modbus.settings import ModbusSettings
from gateway.modbus import mbap
from gateway.modbus.pdu import exception_reply, is_exception

logger = logging.getLogger(__name__)

BROADCAST = 0
RESERVED = range(248, 255)
"""Unit ids that no device may have (Modbus over serial line 2.2)."""


@dataclass(frozen=True, slots=True)
class Forward:
    """A request that the line has to answer."""

    unit: int
    serving: Serving
    ask: Ask

    @property
    def device(self) -> Device:
        """Whom to ask."""
        return self.serving.device


class Routes:
    """Which device a unit id stands for. What is remembered of a device is shared by every way to it."""

    def __init__(self, settings: ModbusSettings, site: Site) -> None:
        self._serving = [
            Serving(device, max_age_s=settings.max_age_s, strict_map=settings.strict_map) for device in site.devices
        ]

    def by_unit(self) -> Mapping[int, Serving]:
        """The configured unit ids."""
        return _usable({serving.device.unit_id: serving for serving in self._serving})

    def of_line(self, name: str) -> Mapping[int, Serving]:
        """The devices of one line by their addresses there: what a port that stands for this line serves."""
        return _usable({s.device.address: s for s in self._serving if s.device.line.name == name})


class Dispatcher:
    """The requests of one way in. Replies are ADUs without their transaction id."""

    def __init__(self, routes: Mapping[int, Serving], clock: Clock, stats: ModbusServerStats, audit: Audit) -> None:
        self.hot = HotReplies()  # its keys hold the unit id, which means another device on another way in
        self.stats = stats
        self.now = clock.monotonic
        self._audit = audit
        self._routes = routes

    def answer(self, unit: int, pdu: bytes, peer: str, now: float) -> bytes | Forward:
        """The reply to a request, or whom to ask for it."""
        self.stats.requests += 1
        request = mbap.encode(0, unit, pdu)[2:]
        entry = self.hot.find(request)
        if entry is not None and now < entry[0] and entry[1].snapshot is entry[2]:
            self.stats.cache_hits += 1
            return entry[3]
        try:
            serving = self._routes.get(unit)
            if serving is None:
                raise UnitNotRouted
            decision = decide(pdu[0], serving.functions)
            if not decision.allowed:
                line = self._audit.record(decision, peer, unit, pdu, now)
                if line is not None:
                    logger.warning("%s", line)
                raise IllegalFunction
            answer = serving.answer(pdu, now)
        except RequestError as error:
            return self._exception(unit, pdu, error)
        if isinstance(answer, FromMemory):
            self.stats.cache_hits += 1
            reply = mbap.encode(0, unit, answer.reply)[2:]
            self.hot.keep(request, serving.device, answer, reply)
            return reply
        self.stats.forwarded += 1
        return Forward(unit, serving, answer)

    def conclude(self, forward: Forward, outcome: Outcome) -> bytes:
        """The reply to a forwarded request, from what the line said."""
        if isinstance(outcome, RequestError):
            return self._exception(forward.unit, forward.ask.pdu, outcome)
        forward.serving.learn(forward.ask, outcome)
        if is_exception(outcome):
            self.stats.exceptions[outcome[1]] += 1
        return mbap.encode(0, forward.unit, outcome)[2:]

    def _exception(self, unit: int, pdu: bytes, error: RequestError) -> bytes:
        self.stats.exceptions[error.exception_code] += 1
        return mbap.encode(0, unit, exception_reply(pdu[0], error.exception_code))[2:]


def _usable(routes: Mapping[int, Serving]) -> Mapping[int, Serving]:
    return {unit: serving for unit, serving in routes.items() if unit != BROADCAST and unit not in RESERVED}
