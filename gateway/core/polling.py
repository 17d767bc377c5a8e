"""What is polled of a device, and what the replies say about its state.

Rule 1: live blocks as often as asked (at night more seldom, where configured), settings seldom, but again soon where
        they did not come; who the device is once after each start. The line decides what is possible (scheduler.py).
Rule 2: a block refused with exception 02 or 03 is split in two, and the split is remembered. What cannot be split is
        asked again every ten minutes; when it is there after all, everything is planned anew.
Rule 3: a device is online once each of its live blocks was read since the line was opened or the device came back
        and it proved to be the unit that is expected there (identity.py), and while no live block was missed
        three times in a row. It is stale when one was, when it refuses all of them, when it still has to prove who it
        is, or when the line is down; offline from the moment its breaker opens until it is online again.
Rule 4: a unit that is not the expected one, or says that it is of another model than the configured one, is not shown
        and not asked for anybody; it is looked at again every minute, as if it had just come: nothing is kept of what
        was read of it before.
Rule 5: blocks that the unit's product does not have, by its map, are not asked for once it told its product.
Rule 6: a value that must be written again and again is warned about after three quarters of its time.
        It is never written by the gateway itself.
Rule 7: a device whose model is to be found is asked who it is until it says that it is of one; from then on it is
        as any other of that model, and never becomes one of another. While it does not, or says something that no map
        knows, that question is what shows that it is there.
Rule 8: what is expected of a unit (it was configured, or told before) is asked for until it is told, or the unit says
        that it has no such thing: a lost reply is no proof. What is not expected is tried and never insisted on.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable

from gateway.core.device_record import DeviceRecord
from gateway.core.health import MISSES_TO_OPEN
from gateway.core.requests import PollItem, Purpose
from gateway.core.settings import LineSettings
from gateway.core.site import Device
from gateway.core.snapshot import IDENTITY_MISMATCH, NOT_REWRITTEN, UNKNOWN_MODEL, Block, DeviceState
from gateway.devices.agreement import map_of_product
from gateway.devices.model import Identification, PollClass, Space
from gateway.devices.plan import PlannedBlock, poll_plan, split
from gateway.devices.texts import decode_text
from gateway.devices.unknown import UNKNOWN
from gateway.modbus.pdu import Function, ReadRequest, parse_identification, read_identification_request
from gateway.modbus.transactions import Replied

log = logging.getLogger(__name__)

LOOK_AGAIN_S = 60.0
REFUSED_AGAIN_S = 600.0
ASK_AGAIN_S = 5.0
"""How often a device of no known model is asked who it is."""
SOON_S = 5.0
"""Settings that did not come are asked for after twice that, then after twice as long each time."""

REWRITE_WARNING_SHARE = 0.75
_LATER = (0x05, 0x06)  # acknowledged, busy: no answer yet
_HAS_NONE = (0x01, 0x02, 0x03)
_REFUSALS_TO_SPLIT = (0x02, 0x03)
_SMOOTHING = 0.3


class Polling:
    """The polls of one line's devices."""

    def __init__(self, settings: LineSettings) -> None:
        self._settings = settings

    def adjust(self, settings: LineSettings, records: Iterable[DeviceRecord], now: float) -> None:
        """Poll by other settings from now on; what is wanted more often is not waited for longer than that."""
        self._settings = settings
        period_s = {PollClass.LIVE: settings.poll.live_s, PollClass.SETTINGS: settings.poll.settings_s}
        for item in (item for record in records for item in record.polls.items):
            if item.block is not None:
                item.period_s = period_s[item.block.poll]
                item.due = min(item.due, now + item.period_s)

    def first(self, device: Device, now: float) -> list[PollItem]:
        """The plan, and what is asked once."""
        poll = self._settings.poll
        period_s = {PollClass.LIVE: poll.live_s, PollClass.SETTINGS: poll.settings_s}
        blocks = [_poll_item(device, block, period_s[block.poll], now) for block in poll_plan(device.map)]
        return sorted(blocks + self._once(device, now), key=_rank)

    def restart(self, record: DeviceRecord, now: float) -> None:
        """Everything is read anew; blocks that were split stay split, unless it was another unit that refused them."""
        strange = IDENTITY_MISMATCH in record.device.snapshot.warnings
        record.restart()
        if strange:
            record.polls.most.clear()
            record.polls.items = self.first(record.device, now)
            return
        items = [item for item in record.polls.items if item.block is not None]
        for item in items:
            item.restart(now)
        record.polls.items = sorted(items + self._once(record.device, now), key=_rank)

    def _look_again(self, record: DeviceRecord, item: PollItem, now: float) -> None:
        """Rule 4; `item` is under way."""
        record.restart()
        item.restart(now)
        record.polls.most.clear()
        plan = self.first(record.device, now)
        record.polls.items = [item if each.pdu == item.pdu else each for each in plan]

    def settling(self, record: DeviceRecord, now: float) -> PollItem:
        """The small question that settles a device's missed replies (doubt.py)."""
        device = record.device
        polled = [device.map.read_function(space) for space in Space if space in device.map.functions.values()]
        functions = list(dict.fromkeys((*polled, *device.map.functions, Function.READ_IDENTIFICATION)))
        function = record.doubt.choose(functions)
        if function == Function.READ_IDENTIFICATION:
            pdu = read_identification_request()
        else:
            space = device.map.functions[function]
            first = next((extent.first for extent in device.map.extents if extent.space is space), 0)
            pdu = ReadRequest(function, first, 1).encode()
        return PollItem(device, Purpose.SETTLE, pdu, None, None, now)

    def started(self, item: PollItem, record: DeviceRecord, now: float) -> None:
        """A poll goes out: set when it is due again."""
        if item.period_s is None:
            return
        period_s = item.period_s
        if item.block is not None and item.block.poll is PollClass.LIVE:
            if record.night and self._settings.poll.night_s is not None:
                period_s = max(period_s, self._settings.poll.night_s)
            if record.live_started_at is not None and item is _first_live(record):
                stats = record.device.stats
                took_s = now - record.live_started_at
                stats.refresh_s = (
                    took_s if stats.refresh_s is None else (stats.refresh_s + _SMOOTHING * (took_s - stats.refresh_s))
                )
            if item is _first_live(record):
                record.live_started_at = now
        if IDENTITY_MISMATCH in record.device.snapshot.warnings:
            period_s = max(period_s, LOOK_AGAIN_S)
            if item is _first_live(record):
                self._look_again(record, item, now)
        if item.refused:
            period_s = max(period_s, _refused_again_s(item, record))
        item.due = now + period_s

    def replied(self, item: PollItem, record: DeviceRecord, event: Replied, now: float) -> None:
        """A poll brought data."""
        item.misses = 0
        if item.block is not None and item not in record.polls.items:
            return  # of a plan that is gone, and perhaps of another unit
        if item.block is not None:
            block = item.block
            item.fresh = True
            record.store(Block(block.space, block.first, block.count, event.pdu[2:], event.sent_at), now)
            if item.refused:
                self._plan_anew(record, now)
        elif item.purpose is Purpose.IDENTIFY:
            objects = parse_identification(event.pdu).objects
            texts = (objects.get(number, b"").decode("ascii", "replace").strip("\0 ") for number in range(3))
            identification = Identification(*texts)
            record.identified(identification, now)
            if record.device.map is UNKNOWN:
                self._find(item, record, identification.product, now)
                return
            record.polls.drop(item)
            self._keep_what_it_has(record, identification.product)
        else:
            record.polls.drop(item)
            record.numbered(decode_text("ascii", event.pdu[2:], item.device.map.identity.serial_order), now)

    def refused(self, item: PollItem, record: DeviceRecord, code: int, now: float) -> None:
        """The device answered a poll with an exception (rule 2)."""
        record.heard(now)
        block = item.block
        if block is None and record.device.map is UNKNOWN:
            if code not in _LATER:
                self._find(item, record, "", now)
            return
        if block is None:
            if code in _HAS_NONE or not _is_expected(item, record):
                record.polls.drop(item)  # asked once, no failure
            else:
                self.failed(item, record, now)
            return
        item.misses += 1
        item.device.stats.failures += 1
        if code not in _REFUSALS_TO_SPLIT:
            _soon(item, now)
            return
        if item.period_s is None or item.refused or item not in record.polls.items:
            return
        record.polls.refused(block.space, block.count)
        record.forget(block.space, block.first, block.last + 1)
        halves = split(block, item.device.map)
        log.info(
            "event=block_refused device=%s space=%s first=0x%04X count=%d exception=%02X action=%s",
            item.device.name,
            block.space,
            block.first,
            block.count,
            code,
            "dropped" if halves is None else "split",
        )
        if halves is None:
            item.refused = True
            item.due = now + REFUSED_AGAIN_S
            first = _first_live(record)
            if first is not None and first.refused:
                first.due = min(first.due, now + LOOK_AGAIN_S)
        else:
            record.polls.items.remove(item)
            record.polls.items += [_poll_item(item.device, half, item.period_s, now) for half in halves]

    def failed(self, item: PollItem, record: DeviceRecord, now: float) -> None:
        """A poll brought nothing."""
        item.misses += 1
        if item.period_s is not None:
            _soon(item, now)
            return
        item.due = now + self._settings.poll.live_s
        if _is_expected(item, record):
            self._insist(item, record, now)
        elif item.misses >= MISSES_TO_OPEN or item.optional:
            record.polls.drop(item)

    def wanted_again(self, record: DeviceRecord, space: Space, address: int, now: float) -> None:
        """An address was written: its old value is forgotten and its block is read next."""
        for item in record.polls.items:
            block = item.block
            if block is not None and block.space is space and block.first <= address <= block.last:
                record.forget(space, block.first, block.last + 1)
                item.due = now

    def judge(self, record: DeviceRecord, now: float) -> DeviceState:
        """The state that follows (rule 3); the caller publishes it."""
        live = [item for item in record.polls.items if _shows_life(item)]
        if record.breaker.is_open:
            return DeviceState.OFFLINE
        complete = bool(live) and all(item.fresh and item.misses == 0 for item in live)
        if record.state is DeviceState.ONLINE:
            if not record.verified or not live or any(item.misses >= MISSES_TO_OPEN for item in live):
                return DeviceState.STALE
            if complete:
                record.known = record.known.learned(record.seen())
            return DeviceState.ONLINE
        asking = any(item.block is None and item not in live for item in record.polls.items)
        if asking or (not complete and not self._stranger(record)) or not self._verify(record, now):
            return record.state
        return DeviceState.ONLINE

    def watch_rewrites(self, record: DeviceRecord, now: float) -> None:
        """Raise or clear the warning of rule 6."""
        late = False
        for name, written_at in record.rewrites.items():
            rewrite_s = record.device.map.point(name).rewrite_s
            late = late or (rewrite_s is not None and now - written_at >= REWRITE_WARNING_SHARE * rewrite_s)
        if record.warn(NOT_REWRITTEN, on=late):
            log.warning("event=%s device=%s on=%s", NOT_REWRITTEN, record.device.name, str(late).lower())

    def next_warning(self, record: DeviceRecord) -> float | None:
        """When `watch_rewrites` has something to raise."""
        if not record.rewrites or NOT_REWRITTEN in record.device.snapshot.warnings:
            return None
        points = {name: record.device.map.point(name) for name in record.rewrites}
        return min(at + REWRITE_WARNING_SHARE * (points[name].rewrite_s or 0.0) for name, at in record.rewrites.items())

    def _stranger(self, record: DeviceRecord) -> bool:
        """Whether what it said by now tells that it is another unit; one of another model may never answer the plan."""
        return _complaint(record) is not None

    def _verify(self, record: DeviceRecord, now: float) -> bool:
        """Rule 4."""
        complaint = _complaint(record)
        if record.warn(IDENTITY_MISMATCH, on=complaint is not None):
            if complaint is not None:
                record.device.stats.identity_mismatches += 1
                log.error('event=identity_mismatch device=%s reason="%s"', record.device.name, complaint)
            else:
                log.info("event=identity_restored device=%s", record.device.name)
                self._as_usual(record, now)
        record.verified = complaint is None
        if complaint is None:
            record.known = record.known.learned(record.seen())
        return record.verified

    def _as_usual(self, record: DeviceRecord, now: float) -> None:
        """What was to be looked at in a minute is read in its own time again."""
        for item in record.polls.items:
            if item.period_s is not None and not item.refused:
                item.due = min(item.due, now + item.period_s)

    def _insist(self, item: PollItem, record: DeviceRecord, now: float) -> None:
        """Rule 8."""
        if item.misses >= MISSES_TO_OPEN:
            item.due = now + LOOK_AGAIN_S
        if item.misses == MISSES_TO_OPEN:
            what = "serial number" if item.purpose is Purpose.SERIAL_NUMBER else "product"
            log.warning('event=identity_untold device=%s what="%s"', record.device.name, what)

    def _plan_anew(self, record: DeviceRecord, now: float) -> None:
        """Rule 2: what was learnt of the device's limits holds no more."""
        asked = [item for item in record.polls.items if item.block is None]
        blocks = [item for item in self.first(record.device, now) if item.block is not None]
        record.polls.most.clear()
        record.polls.items = sorted(blocks + asked, key=_rank)
        identification = record.device.snapshot.identification
        if identification is not None:
            self._keep_what_it_has(record, identification.product)

    def _find(self, item: PollItem, record: DeviceRecord, product: str, now: float) -> None:
        """Rule 7."""
        item.fresh = True
        item.misses = 0
        device_map = map_of_product(product)
        is_another = (record.known.product or product) != product
        if is_another and product:  # a refusal is no other name
            record.verified = False
        if device_map is None or is_another:
            if record.warn(UNKNOWN_MODEL, on=True):
                log.warning('event=model_unknown device=%s product="%s"', record.device.name, product.replace('"', "'"))
            return
        record.warn(UNKNOWN_MODEL, on=False)
        record.is_of(device_map)
        log.info("event=model_found device=%s model=%s product=%s", record.device.name, device_map.model, product)
        identify = Purpose.IDENTIFY
        record.polls.items = [each for each in self.first(record.device, now) if each.purpose is not identify]
        self._keep_what_it_has(record, product)

    def _keep_what_it_has(self, record: DeviceRecord, product: str) -> None:
        """Rule 5."""
        device_map = record.device.map
        lacking = [extent for extent in device_map.extents if not device_map.on_product(extent, product)]
        for item in [item for item in record.polls.items if item.block is not None]:
            block = item.block
            assert block is not None
            if any(e.space is block.space and e.first <= block.first <= e.last for e in lacking):
                record.polls.items.remove(item)
                record.forget(block.space, block.first, block.last + 1)

    def _once(self, device: Device, now: float) -> list[PollItem]:
        """What is asked once after each start: who are you."""
        again_s = max(self._settings.poll.live_s, ASK_AGAIN_S) if device.map is UNKNOWN else None
        items = [PollItem(device, Purpose.IDENTIFY, read_identification_request(), None, again_s, now)]
        if device.map.identity.serial_first is not None:
            function = device.map.read_function(Space.REGISTERS)
            request = ReadRequest(function, device.map.identity.serial_first, device.map.identity.serial_words)
            items.append(PollItem(device, Purpose.SERIAL_NUMBER, request.encode(), None, None, now))
        return items


def _complaint(record: DeviceRecord) -> str | None:
    """Why it is another unit than the one that is expected, or of another model than the one whose map is used."""
    seen, device_map = record.seen(), record.device.map
    found = None if seen.product is None else map_of_product(seen.product)
    if found is not None and found.model != device_map.model and device_map is not UNKNOWN:
        return f"product is {seen.product}, which is no {device_map.model}"
    return record.known.complaint(seen, device_map.identity.growing)


def _shows_life(item: PollItem) -> bool:
    """Whether its replies say that the device is there: live blocks, or who it is where nothing else is known."""
    if item.block is None:
        return item.purpose is Purpose.IDENTIFY and item.period_s is not None
    return item.block.poll is PollClass.LIVE and not item.refused


def _soon(item: PollItem, now: float) -> None:
    """Settings did not come (rule 1): one lost reply at the start must not hide them for their whole period."""
    if item.block is not None and item.block.poll is PollClass.SETTINGS and not item.refused:
        item.due = min(item.due, now + SOON_S * 2 ** min(item.misses, 10))


def _is_expected(item: PollItem, record: DeviceRecord) -> bool:
    """Whether what is asked here has to be told (rule 8)."""
    return bool(record.known.serial_number if item.purpose is Purpose.SERIAL_NUMBER else record.known.product)


def _first_live(record: DeviceRecord) -> PollItem | None:
    """The first live block, of those that are not refused if there are any."""
    live = [i for i in record.polls.items if i.block is not None and i.block.poll is PollClass.LIVE]
    return min(live, key=lambda item: item.refused, default=None)


def _refused_again_s(item: PollItem, record: DeviceRecord) -> float:
    """When it is asked again; of a device that refuses everything one thing is enough to know it by."""
    first = _first_live(record)
    return LOOK_AGAIN_S if item is first and item.refused else REFUSED_AGAIN_S


def _poll_item(device: Device, block: PlannedBlock, period_s: float, due: float) -> PollItem:
    request = ReadRequest(device.map.read_function(block.space), block.first, block.count)
    return PollItem(device, Purpose.POLL, request.encode(), block, period_s, due)


def _rank(item: PollItem) -> int:
    """Order of the first round: what is shown first, then what proves whose values they are, then the rest."""
    if item.block is None:
        return 1
    return 0 if item.block.poll is PollClass.LIVE else 2
