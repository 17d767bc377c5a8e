"""The asyncio shell of the history: makes the reads that harvest.py wants, in idle line time, and stores the days.

Rule 1: reads go out in the background lane, one at a time on a line; clients and polls come first, always. A read that
        found no idle time for CROWDED_S is made shorter (harvest.py); one of a single block waits, however long that
        takes, and is told about once an hour.
Rule 2: only an online device is asked: its identity is proved and its hourmeter is known.
Rule 3: what cannot be stored disturbs nobody (async_store.py); no line is asked for it meanwhile.
Rule 4: when the gateway's clock is set, the dates that were made by the wrong one are moved along. (Time in which the
        machine slept is no step of the clock.)
Rule 5: a day that must have been written and was not found, or an odd block behind the newest day, is looked for in
        the whole ring, at most once in an interval.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

from gateway.clock import Clock
from gateway.core.log_budget import LogBudget
from gateway.core.site import Device, Outcome, Site
from gateway.core.stats import DeviceHistoryStats, HistoryStats
from gateway.devices.log import HOURMETER
from gateway.devices.model import LogLayout
from gateway.errors import DeviceOffline, HistoryError, PathUnavailable, RequestError, ShuttingDown
from gateway.history.async_store import AsyncStore, one_thread
from gateway.history.dates import Look
from gateway.history.harvest import Harvest
from gateway.history.harvest import Outcome as Ending
from gateway.history.identity import Place, Seen
from gateway.history.schedule import DAY_HOURS, Schedule, Who
from gateway.history.session import Session, ahead_s
from gateway.history.settings import HistorySettings
from gateway.history.store import Kept, Plan, Store

CLIENT = "history"
CHECK_S = 2.0
CLOCK_STEP_S = 60.0
CROWDED_S = 60.0
LONG_S = 600.0
"""A read that has waited so long for idle time is worth a line of the log."""

_AWAY = (DeviceOffline, PathUnavailable, ShuttingDown)
_log = logging.getLogger(__name__)


class _Interrupted(Exception):
    """The device, its line or the store went away."""


@dataclass(slots=True, eq=False)
class _Watch:
    """One device."""

    device: Device
    layout: LogLayout
    schedule: Schedule
    stats: DeviceHistoryStats
    controller: int | None = None  # the key of the controller that is there
    most: int | None = None  # blocks a read, as far as known
    whole_at: float | None = None  # when the whole ring was last read
    opened: int = 0  # which opening of the store it knows


@dataclass(frozen=True, slots=True)
class _Result:
    """What a harvest came to; `whole` is False while blocks are left that could not be read."""

    kept: Kept
    seen: Seen
    ending: Ending
    whole: bool


class HistoryKeeper:
    """Harvests the daily logs of a site; `run` goes on until it is cancelled."""

    name = "history"

    def __init__(
        self,
        settings: HistorySettings,
        site: Site,
        clock: Clock,
        stats: HistoryStats,
        *,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
        executor: Callable[[], Executor] = one_thread,
        session: Session | None = None,
    ) -> None:
        """`session` is that of the keeper before; left out: this one is the first."""
        self._settings = settings
        self._clock = clock
        self._stats = stats
        self._sleep = sleep
        self._session = Session.begin(clock) if session is None else session
        self._store = AsyncStore(settings.directory, clock, stats, executor, session=self._session.number)
        self._budget = LogBudget(window_s=3600.0)
        self._lines: list[list[_Watch]] = []
        for line in site.lines:
            watches = [self._watch(device) for device in site.devices if device.line is line]
            self._lines.append([watch for watch in watches if watch is not None])

    def _watch(self, device: Device) -> _Watch | None:
        if device.map.log is None:
            return None
        stats = self._stats.devices.setdefault(device.unit_id, DeviceHistoryStats())
        return _Watch(device, device.map.log, Schedule(self._settings.interval_s), stats)

    async def run(self) -> None:
        """Harvest until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                for watches in self._lines:
                    group.create_task(self._tend(watches))
        finally:
            await self._store.close()

    async def _tend(self, watches: Sequence[_Watch]) -> None:
        """One line: its devices in turn."""
        while True:
            for watch in watches:
                if not await self._store.ready():
                    break
                try:
                    await self._refresh(watch)
                    await self._mind_the_clock()
                except HistoryError:
                    break  # counted and told by the store
                seen = self._look(watch.device)
                if seen is not None and watch.schedule.due(self._clock.monotonic(), seen.look.hours, _who(seen)):
                    await self._harvest(watch, seen)
            await self._sleep(CHECK_S)

    async def _refresh(self, watch: _Watch) -> None:
        """Learn what a store that was opened anew has of a device."""
        if watch.opened == self._store.opened:
            return
        opened = self._store.opened
        device = watch.device
        days, apart, looked = await self._store.call(Store.counts, device.line.name, device.name)
        watch.stats.days, watch.stats.apart = days, apart
        age_s = None if looked is None else max(0.0, self._clock.wall() - looked)
        watch.stats.harvested_at = None if age_s is None else self._clock.monotonic() - age_s
        watch.controller = None
        watch.schedule = Schedule(self._settings.interval_s)
        watch.opened = opened

    async def _harvest(self, watch: _Watch, seen: Seen) -> None:
        try:
            plan = await self._store.call(Store.plan, seen, self._taken(watch))
            result = await self._read(watch, seen, plan)
            if result is not None and self._misses_a_day(watch, result):
                result = await self._read(watch, result.seen, Plan(None, None, {}))
        except _Interrupted as reason:
            watch.schedule.interrupted(self._clock.monotonic())
            self._failed(watch, str(reason))
        except HistoryError as error:
            watch.schedule.interrupted(self._clock.monotonic())
            self._failed(watch, f"store_{error.kind}")
        else:
            if result is None or not result.whole:
                watch.schedule.failed(self._clock.monotonic())
                self._failed(watch, "refused" if result is None else "unread_blocks")

    async def _read(self, watch: _Watch, seen: Seen, plan: Plan) -> _Result | None:
        """One harvest from the plan on; None when nothing could be read."""
        began = self._clock.monotonic()
        harvest = Harvest(watch.layout, seen.look.hours, plan.position, plan.staged, watch.most)
        while (read := harvest.next_read()) is not None:
            await self._mind_the_clock()  # what other harvests dated must not wait for the end of this one
            await self._sleep_until(harvest.ready_at)
            outcome = await self._ask(watch, read.pdu(watch.device.map, watch.layout), patient=read.count == 1)
            if outcome is None:
                harvest.crowded()
                continue
            if isinstance(outcome, _AWAY):
                raise _Interrupted(outcome.label)
            if isinstance(outcome, RequestError):
                harvest.failed(self._clock.monotonic())
                continue
            blocks = harvest.replied(read, outcome, self._clock.monotonic())
            watch.most = harvest.most
            if blocks:
                await self._store.call(Store.stage, seen, blocks, first=harvest.stage_anew)
                harvest.stage_anew = False
        ending = harvest.outcome
        if ending is None or ending is Ending.FAILED:
            return None
        await self._mind_the_clock()
        # The hourmeter went on while the ring was read, and a day may have ended.
        if watch.opened != self._store.opened:  # the plan is of another file, in which keys are others'
            raise _Interrupted("store_replaced")
        later = self._look(watch.device)
        if later is None or _who(later) != _who(seen) or later.look.hours < seen.look.hours:
            raise _Interrupted("another_controller" if later else "offline")
        if ending is Ending.NEWER:
            assert plan.controller is not None
            kept = await self._store.call(Store.keep_newer, later, watch.layout, plan.controller, harvest.blocks)
        else:
            watch.whole_at = self._clock.monotonic()
            kept = await self._store.call(
                Store.keep_ring, later, watch.layout, harvest.blocks, self._taken(watch),
                whole=not harvest.unread,
            )  # fmt: skip
        result = _Result(kept, later, ending, whole=not harvest.unread)
        self._harvested(watch, result, began)
        return result

    async def _sleep_until(self, at: float) -> None:
        wait_s = at - self._clock.monotonic()
        if wait_s > 0:
            await self._sleep(wait_s)

    async def _ask(self, watch: _Watch, pdu: bytes, *, patient: bool) -> Outcome | None:
        """One background read, however long it waits for idle time; None after CROWDED_S, unless `patient`.

        Its ticket is given back when nobody waits any more.
        """
        answer: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()

        def done(outcome: Outcome) -> None:
            if not answer.done():
                answer.set_result(outcome)

        stats = watch.stats
        asked_at = self._clock.monotonic()
        if stats.waiting_since is None:
            stats.waiting_since = asked_at
        ticket = watch.device.line.read(watch.device, pdu, done, client=CLIENT, background=True)
        try:
            while not answer.done():
                crowded = asyncio.ensure_future(self._sleep(CROWDED_S))
                try:
                    await asyncio.wait((answer, crowded), return_when=asyncio.FIRST_COMPLETED)
                finally:
                    crowded.cancel()
                now = self._clock.monotonic()
                if answer.done() or now - asked_at < CROWDED_S:
                    continue
                self._waits(watch, now - stats.waiting_since)
                if not patient:
                    return None
            stats.waiting_since = None
            return answer.result()
        except asyncio.CancelledError:
            stats.waiting_since = None
            raise
        finally:
            ticket.cancel()

    def _waits(self, watch: _Watch, waited_s: float) -> None:
        if waited_s < LONG_S:
            return
        line, device = watch.device.line.name, watch.device.name
        left_out = self._budget.spend((device, "waits"), self._clock.monotonic())
        if left_out is not None:
            _log.warning(
                'event=history_waits_for_line line="%s" device="%s" waited_s=%.0f left_out=%d',
                line, device, waited_s, left_out,
            )  # fmt: skip

    def _misses_a_day(self, watch: _Watch, result: _Result) -> bool:
        """Rule 5."""
        position = result.kept.controller.position
        if result.ending is not Ending.NEWER or position is None:
            return False
        if watch.whole_at is not None and self._clock.monotonic() - watch.whole_at < self._settings.interval_s:
            return False
        return result.seen.look.hours > position.hourmeter + 2 * DAY_HOURS

    def _look(self, device: Device) -> Seen | None:
        """The controller at a device now, or None when it cannot be asked (rule 2)."""
        snapshot = device.snapshot
        hours = snapshot.shown().get(HOURMETER)
        if hours is None:
            return None
        says = snapshot.identification
        return Seen(
            Place(device.line.name, device.name, device.unit_id),
            device.map.model,
            "" if says is None else says.product,
            "" if says is None else says.revision,
            snapshot.serial_number or "",
            Look(int(hours), self._clock.wall() - (snapshot.age_s(HOURMETER, self._clock.monotonic()) or 0.0)),
        )

    def _taken(self, watch: _Watch) -> frozenset[int]:
        """The controllers that other devices have."""
        others = (other for watches in self._lines for other in watches if other is not watch)
        return frozenset(
            other.controller
            for other in others
            if other.controller is not None and other.opened == self._store.opened  # a key of the file in use
        )

    def _harvested(self, watch: _Watch, result: _Result, began: float) -> None:
        now = self._clock.monotonic()
        kept, controller = result.kept, result.kept.controller
        watch.controller = controller.key
        self._session.controllers.add(controller.key)
        watch.stats.days, watch.stats.apart = kept.days, kept.apart
        if result.whole:
            watch.stats.harvests += 1
            watch.stats.harvested_at = now
            newest = None if controller.position is None else controller.position.hourmeter
            watch.schedule.done(now, controller.look.hours, _who(result.seen), newest)
        name = watch.device.name
        _log.info(
            'event=history_harvested device="%s" controller="%s" read=%s new_days=%d days=%d took_s=%.1f',
            name, controller.identity, result.ending.value, kept.new_days, kept.days, now - began,
        )  # fmt: skip
        if kept.replaced is not None:
            _log.warning(
                'event=history_controller_replaced device="%s" before="%s" controller="%s" known=%s',
                name, kept.replaced, controller.identity, str(not kept.is_new).lower(),
            )  # fmt: skip
        for block in kept.new_apart:
            _log.warning(
                'event=history_block_apart device="%s" controller="%s" slot=%d hourmeter=%d why=%s',
                name, controller.identity, block.slot, block.hourmeter, block.why.value,
            )  # fmt: skip

    def _failed(self, watch: _Watch, reason: str) -> None:
        watch.stats.failures[reason] += 1
        left_out = self._budget.spend((watch.device.name, reason), self._clock.monotonic())
        if left_out is not None:
            _log.log(
                logging.INFO if reason == ShuttingDown.label else logging.WARNING,
                'event=history_harvest_failed device="%s" reason=%s next=retry left_out=%d',
                watch.device.name, reason, left_out,
            )  # fmt: skip

    async def _mind_the_clock(self) -> None:
        """Rule 4; of several lines that see the same step the first one moves the dates."""
        session = self._session
        async with session.minding:
            offset, before = ahead_s(self._clock), session.clock_offset
            step_s = offset - before
            if abs(step_s) < CLOCK_STEP_S:
                return
            session.clock_offset = offset  # a keeper that ends now leaves no dates half moved: its store goes on
            try:
                moved = await self._store.call(Store.shift, tuple(session.controllers), step_s)
            except HistoryError:
                session.clock_offset = before
                raise
            self._stats.moved += 1
            _log.warning("event=history_clock_set step_s=%.0f days_moved=%d", step_s, moved)


def _who(seen: Seen) -> Who:
    return seen.product, seen.serial
