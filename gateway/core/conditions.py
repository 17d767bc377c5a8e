"""Conditions: everything that can be wrong with a controller, a line or the gateway, each with its state at any moment.

Rule 1: the list is fixed by the configuration and the maps, so that a row about each of them is always there. Codes
        are for ever and mean one thing on all models: 100, 200, 300, 500, 600 + the number of a bit (as its map says),
        401 to 449 of a device, 451 to 499 of the gateway, 1000 + the index of a line.
Rule 2: a condition is raised, clear or unknown. Of a device that is not online nobody knows its faults and alarms.
Rule 3: it is counted when it is raised after it was clear or never known: not when a device that was away comes back
        with it.
Rule 4: what passes by itself is no condition: a line must be down for DOWN_S, a device stale for STALE_S on a line that
        is open, a listener closed for DOWN_S. A device that is stale because its line is down is not blamed for it.
Rule 5: whoever wants to tell about changes takes them by `take`; they are kept once a condition, so they are bounded.

Times are monotonic. `look` is cheap when nothing changed and may be called at any moment.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

from gateway.core.site import Device, LinePort, LineState, Site
from gateway.core.snapshot import IDENTITY_MISMATCH, NOT_REWRITTEN, UNKNOWN_MODEL, DeviceState, Snapshot
from gateway.devices.model import DeviceMap, Value

STALE_S = 30.0
DOWN_S = 5.0

GATEWAY_UNIT = 0
"""Stands for a unit id in the rows about the gateway itself and its lines."""

LINE_CODES = 1000
"""A line's condition has this and its index as code."""


class Severity(IntEnum):
    """How bad a condition is; the numbers are those of the MIB."""

    INFO = 1
    WARNING = 2
    CRITICAL = 3


class ConditionState(IntEnum):
    """Whether a condition holds; the numbers are those of the MIB."""

    CLEAR = 1
    RAISED = 2
    UNKNOWN = 3


@dataclass(frozen=True, slots=True)
class Condition:
    """Something that can be wrong."""

    code: int
    name: str  # snake_case: array_fault_battery_hvd
    text: str
    severity: Severity


OFFLINE = Condition(401, "offline", "controller does not answer, or not usably", Severity.CRITICAL)
MISMATCH = Condition(402, IDENTITY_MISMATCH, "another controller is in its place", Severity.CRITICAL)
REWRITE = Condition(403, NOT_REWRITTEN, "slave voltage is about to expire: not rewritten in time", Severity.CRITICAL)
LOAD_OFF = Condition(404, "load_disconnected", "load is disconnected by the controller", Severity.CRITICAL)

MODEL = Condition(405, UNKNOWN_MODEL, "no map knows the controller: Modbus alone serves it", Severity.WARNING)

HISTORY_DOWN = Condition(451, "history_store_down", "daily logs cannot be stored", Severity.WARNING)
STATE_DIR = Condition(452, "state_dir_unusable", "state_dir is read-only or full", Severity.WARNING)
NOT_READY = Condition(453, "not_ready", "a listener is closed, or its files cannot be used", Severity.CRITICAL)

LINE_DOWN = "line_down"


def line_condition(index: int) -> Condition:
    """The condition that the port of a line is not open; `index` is its place in the site, from 1."""
    return Condition(LINE_CODES + index, LINE_DOWN, "port of the line is not open", Severity.CRITICAL)


def bit_conditions(device_map: DeviceMap) -> Iterator[tuple[str, int, Condition]]:
    """The conditions that are bits of a model: point, bit number, condition; by code."""
    for point in sorted(
        (each for each in device_map.points if each.conditions is not None),
        key=lambda each: each.conditions.first if each.conditions is not None else 0,
    ):
        assert point.conditions is not None
        assert point.bits is not None
        for bit in sorted(device_map.bit_tables[point.bits], key=lambda each: each.number):
            name = f"{point.conditions.name}_{bit.name}"
            severity = Severity[bit.severity.upper()]
            yield point.name, bit.number, Condition(point.conditions.first + bit.number, name, bit.text, severity)


@dataclass(frozen=True, slots=True)
class _OfModel:
    """What all devices of a model can have, in the order of their codes but for the gateway's own."""

    map: DeviceMap
    conditions: tuple[Condition, ...]
    places: Mapping[int, int]  # of the conditions, by code
    bits: tuple[tuple[str, tuple[tuple[int, int], ...]], ...]  # point and, for each bit, its mask and its condition


_MODELS_KEPT = 32
_models: dict[tuple[int, bool], _OfModel] = {}


def _of_model(device_map: DeviceMap, *, auto: bool) -> _OfModel:
    """Made once for all devices of a map, since it is dozens of texts."""
    key = (id(device_map), auto)
    known = _models.get(key)
    if known is None or known.map is not device_map:
        if len(_models) >= _MODELS_KEPT:
            _models.clear()
        known = _models[key] = _look_up(device_map, auto=auto)
    return known


def _look_up(device_map: DeviceMap, *, auto: bool) -> _OfModel:
    conditions: list[Condition] = []
    bits: dict[str, list[tuple[int, int]]] = {}
    for point, number, condition in bit_conditions(device_map):
        conditions.append(condition)
        bits.setdefault(point, []).append((1 << number, condition.code))
    conditions += [OFFLINE, MISMATCH, REWRITE]
    conditions += [LOAD_OFF] if device_map.load is not None else []
    conditions += [MODEL] if auto else []
    return _OfModel(
        device_map,
        tuple(conditions),
        {condition.code: place for place, condition in enumerate(conditions)},
        tuple((point, tuple(pairs)) for point, pairs in bits.items()),
    )


class Watch:
    """One condition of one subject: `device` or `line`, or the gateway where both are None."""

    __slots__ = ("changed_at", "condition", "device", "from_start", "known", "line", "state", "times")

    def __init__(self, condition: Condition, now: float, device: Device | None, line: LinePort | None) -> None:
        self.condition = condition
        self.device = device
        self.line = line
        self.state = ConditionState.UNKNOWN
        self.known = ConditionState.UNKNOWN  # the last state that was not unknown
        self.changed_at = now
        self.times = 0  # raised since the start
        self.from_start = False  # it holds since before the gateway first looked

    @property
    def unit_id(self) -> int:
        """Unit id of the device, or GATEWAY_UNIT."""
        return GATEWAY_UNIT if self.device is None else self.device.unit_id

    def __repr__(self) -> str:
        return f"Watch({self.unit_id}, {self.condition.name}, {self.state.name})"


class _Set:
    """The watches of one subject."""

    def __init__(self, changed: dict[Watch, None], watches: Iterable[Watch], places: Mapping[int, int]) -> None:
        """`places` are those of the watches, by code."""
        self._changed = changed
        self._active = dict.fromkeys(Severity, 0)
        self._watches = list(watches)
        self._places = places

    @property
    def active(self) -> Mapping[Severity, int]:
        """How many conditions of each severity are raised."""
        return self._active

    @property
    def worst(self) -> Severity | None:
        """The worst severity of a raised condition, None when none is raised."""
        return max((severity for severity, count in self.active.items() if count), default=None)

    def __iter__(self) -> Iterator[Watch]:
        """Every watch, by code."""
        return iter(self._watches)

    def __contains__(self, code: int) -> bool:
        return code in self._places

    def __getitem__(self, code: int) -> Watch:
        return self._watches[self._places[code]]

    def _become(self, code: int, state: ConditionState, now: float) -> None:
        watch = self[code]
        if state is watch.state:
            return
        severity = watch.condition.severity
        if watch.state is ConditionState.RAISED:
            self._active[severity] -= 1
        if state is ConditionState.RAISED:
            self._active[severity] += 1
            watch.times += watch.known is not ConditionState.RAISED
        if state is not ConditionState.UNKNOWN:
            watch.from_start = state is ConditionState.RAISED and (
                watch.from_start or watch.known is ConditionState.UNKNOWN
            )
            watch.known = state
        watch.state = state
        watch.changed_at = now
        self._changed[watch] = None


class DeviceConditions(_Set):
    """The conditions of one device."""

    def __init__(self, device: Device, now: float, changed: dict[Watch, None]) -> None:
        self.map = device.map  # a model that is found later has conditions of its own
        of_model = _of_model(self.map, auto=device.auto)
        watches = (Watch(condition, now, device, None) for condition in of_model.conditions)
        super().__init__(changed, watches, of_model.places)
        self.device = device
        self._bits = of_model.bits
        self._values: list[Value | None] = [None] * len(self._bits)
        self._seen: Snapshot | None = None
        self._line_open_since: float | None = None  # None: it is down
        self._again_at: float | None = None  # when the state can change without a new snapshot

    def fits(self, device: Device) -> bool:
        """Whether these are the conditions of that device as it is now."""
        return self.device is device and self.map is device.map

    def line_is(self, open_since: float | None) -> None:
        """Learn since when the line is open; None: it is down."""
        if open_since != self._line_open_since:
            self._line_open_since = open_since
            self._seen = None

    def look(self, now: float) -> None:
        """Take in the device's snapshot as it is now."""
        snapshot = self.device.snapshot
        if snapshot is self._seen and (self._again_at is None or now < self._again_at):
            return
        self._seen = snapshot
        shown = snapshot.shown()
        for position, (point, pairs) in enumerate(self._bits):
            value = shown.get(point)
            before = self._values[position]
            if value == before:
                continue
            self._values[position] = value
            if value is None:
                for _, code in pairs:
                    self._become(code, ConditionState.UNKNOWN, now)
                continue
            bits = int(value)
            changed = -1 if before is None else bits ^ int(before)
            for mask, code in pairs:
                if changed & mask:
                    self._become(code, ConditionState.RAISED if bits & mask else ConditionState.CLEAR, now)
        self._become(OFFLINE.code, self._offline(snapshot, now), now)
        heard = snapshot.last_reply_at is not None
        for condition in (MISMATCH, REWRITE, *((MODEL,) if self.device.auto else ())):
            raised = condition.name in snapshot.warnings
            self._become(condition.code, _state(raised if heard or raised else None), now)
        if self.map.load is not None:
            self._become(LOAD_OFF.code, self._load(shown), now)

    def _offline(self, snapshot: Snapshot, now: float) -> ConditionState:
        """Rule 4."""
        self._again_at = None
        if snapshot.state is DeviceState.ONLINE:
            return ConditionState.CLEAR
        if snapshot.state is DeviceState.OFFLINE:
            return ConditionState.RAISED
        if snapshot.state is DeviceState.UNKNOWN or self._line_open_since is None:
            return ConditionState.UNKNOWN
        stale_until = max(snapshot.state_since, self._line_open_since) + STALE_S
        if now >= stale_until:
            return ConditionState.RAISED
        self._again_at = stale_until
        return self[OFFLINE.code].state

    def _load(self, shown: Mapping[str, Value]) -> ConditionState:
        rule = self.map.load
        value = None if rule is None else shown.get(rule.point)
        if rule is None or value is None:
            return ConditionState.UNKNOWN
        if value in rule.disconnected:
            return ConditionState.RAISED
        return ConditionState.CLEAR if value in rule.connected else ConditionState.UNKNOWN


class GatewayConditions(_Set):
    """The conditions of the gateway and its lines."""

    def __init__(
        self, lines: Sequence[LinePort], own: Sequence[Condition], now: float, changed: dict[Watch, None]
    ) -> None:
        watches = [Watch(condition, now, None, None) for condition in own]
        watches += [Watch(line_condition(index), now, None, line) for index, line in enumerate(lines, 1)]
        super().__init__(changed, watches, {watch.condition.code: place for place, watch in enumerate(watches)})
        self._raised_since: dict[int, float] = {}

    def go_on(self, before: GatewayConditions) -> None:
        """Take over what is known of the same conditions: of the gateway itself, and of lines that stayed."""
        self._raised_since = before._raised_since
        for watch in before:
            place = self._places.get(watch.condition.code)
            if place is not None and self._watches[place].line is watch.line:
                self._watches[place] = watch

    @property
    def active(self) -> Mapping[Severity, int]:
        """How many conditions of each severity are raised; those before, whose watches are shared, may still change."""
        raised = [watch.condition.severity for watch in self if watch.state is ConditionState.RAISED]
        return {severity: raised.count(severity) for severity in Severity}

    def line_is(self, index: int, state: LineState, since: float, now: float) -> None:
        """Learn the state of a line, and since when it has it."""
        down_long = state is LineState.DOWN and now - since >= DOWN_S
        code = LINE_CODES + index
        if down_long:
            self._become(code, ConditionState.RAISED, now)
        elif state is LineState.OPEN:
            self._become(code, ConditionState.CLEAR, now)

    def tell(self, condition: Condition, *, raised: bool | None, now: float, after_s: float = 0.0) -> None:
        """Learn whether a condition of the gateway holds (None: not known); it is raised once it held for `after_s`.

        Nothing is done where the gateway has no such condition.
        """
        if condition.code not in self:
            return
        if not raised:
            self._raised_since.pop(condition.code, None)
            self._become(condition.code, _state(raised), now)
        elif now - self._raised_since.setdefault(condition.code, now) >= after_s:
            self._become(condition.code, ConditionState.RAISED, now)


class Conditions:
    """All conditions of a site; `own` are those of the gateway itself, which are told by `gateway.tell`."""

    def __init__(self, site: Site, own: Sequence[Condition], now: float, before: Conditions | None = None) -> None:
        """With those of `before`, as far as their devices and lines are still there."""
        self._changed: dict[Watch, None] = {} if before is None else before._changed  # noqa: SLF001 - its own kind
        self._lines = site.lines
        self.gateway = GatewayConditions(site.lines, own, now, self._changed)
        known = {} if before is None else before.devices
        if before is not None:
            self.gateway.go_on(before.gateway)
        self.devices: Mapping[int, DeviceConditions] = {
            device.unit_id: known[device.unit_id]
            if device.unit_id in known and known[device.unit_id].fits(device)
            else DeviceConditions(device, now, self._changed)
            for device in site.devices
        }

    def look(self, now: float) -> None:
        """Take in the state of every line and device as it is now."""
        open_since: dict[str, float | None] = {}
        for index, line in enumerate(self._lines, 1):
            status = line.status(now)
            open_since[line.name] = status.since if status.state is LineState.OPEN else None
            self.gateway.line_is(index, status.state, status.since, now)
        for conditions in self.devices.values():
            conditions.line_is(open_since[conditions.device.line.name])
            conditions.look(now)

    def take(self) -> tuple[Watch, ...]:
        """The watches whose state changed since this was last called, each once, in the order of their changes."""
        changed = tuple(self._changed)
        self._changed.clear()
        return changed

    def at(self, unit_id: int, code: int) -> Watch | None:
        """The watch of this unit id (GATEWAY_UNIT: of the gateway and its lines) and code, where there is one."""
        of: _Set | None = self.gateway if unit_id == GATEWAY_UNIT else self.devices.get(unit_id)
        return of[code] if of is not None and code in of else None

    def __iter__(self) -> Iterator[Watch]:
        """Every watch: those of the gateway, then by unit id; by code."""
        yield from self.gateway
        for conditions in self.devices.values():
            yield from conditions

    def active(self) -> Iterator[Watch]:
        """Every watch that is raised, in the order of all."""
        return (watch for watch in self if watch.state is ConditionState.RAISED)


def _state(raised: bool | None) -> ConditionState:  # noqa: FBT001 - what is turned into a state
    if raised is None:
        return ConditionState.UNKNOWN
    return ConditionState.RAISED if raised else ConditionState.CLEAR
