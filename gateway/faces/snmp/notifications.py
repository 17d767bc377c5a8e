"""The notifications: how the MIB describes them, and how one is written.

All notifications about conditions carry the same objects in the same order, so that a receiver needs one rule. A device
that is away or a load that is cut off has a notification of its own kind, because that is what people are woken for.
coldStart and authenticationFailure are those of SNMPv2-MIB, with our sequence number and the site behind them.

Numbers are append-only (mibs/oids.lock), and the list of objects is for ever (RFC 2578 §10.3).
"""

from __future__ import annotations

from dataclasses import dataclass

from gateway.core.announcing import Announcement
from gateway.core.conditions import LINE_DOWN, LOAD_OFF, OFFLINE, Condition, ConditionState
from gateway.faces.snmp.objects import CellValue, Changes, Convention, ObjectType, Syntax, text
from gateway.faces.snmp.settings import Oid

COLD_START: Oid = (1, 3, 6, 1, 6, 3, 1, 1, 5, 1)
AUTHENTICATION_FAILURE: Oid = (1, 3, 6, 1, 6, 3, 1, 1, 5, 5)

NO_VOLTAGE = -(2**31)
"""Battery voltage of what has none, or whose was never read."""

CAUSE = Convention(
    "PgwNotifyCauseCode",
    Syntax.ENUMERATION,
    ((1, "event"), (2, "summary")),
    "Why a notification is sent. event(1): it happened now. summary(2): it was so already when the gateway first "
    "looked after its start.",
)


def _never(_row: object, _now: float) -> CellValue:
    """Nothing is served of what only notifications carry."""
    return None


def _only_notified(
    number: int, name: str, syntax: Syntax, description: str, *, units: str = "", convention: Convention | None = None
) -> ObjectType:
    return ObjectType(
        number, name, syntax, description, _never, units=units, convention=convention, changes=Changes.NEVER
    )


SEQUENCE = _only_notified(
    1,
    "pgwNotifySequence",
    Syntax.UNSIGNED32,
    "Counts the notifications to one receiver, from 1 after each start: a gap is one that was lost on the way.",
)
CAUSED = _only_notified(2, "pgwNotifyCause", Syntax.ENUMERATION, "Why this notification is sent.", convention=CAUSE)
SUBJECT = _only_notified(
    3,
    "pgwNotifySubject",
    Syntax.TEXT,
    "Name of the device or line that the notification is about; empty when it is about the gateway itself.",
)
BATTERY = _only_notified(
    4,
    "pgwNotifyBatteryVoltage",
    Syntax.INTEGER32,
    "Battery voltage of the device as it was last read; -2147483648 when there is none.",
    units="millivolts",
)
NOTIFY: tuple[ObjectType, ...] = (SEQUENCE, CAUSED, SUBJECT, BATTERY)
"""Objects that only notifications carry."""

OBJECTS = (
    "pgwNotifySequence",
    "pgwNotifyCause",
    "pgwSiteName",
    "pgwNotifySubject",
    "pgwConditionName",
    "pgwConditionText",
    "pgwConditionSeverity",
    "pgwConditionState",
    "pgwNotifyBatteryVoltage",
)
"""What every notification of ours carries, in this order."""


@dataclass(frozen=True, slots=True)
class NotificationType:
    """A notification of the MIB."""

    number: int
    name: str
    description: str


RAISED = NotificationType(1, "pgwConditionRaised", "A condition is raised that has no notification of its own.")
CLEARED = NotificationType(2, "pgwConditionCleared", "A condition is clear again after pgwConditionRaised.")
DEVICE_OFFLINE = NotificationType(3, "pgwDeviceOffline", "A device does not answer any more, or not usably.")
DEVICE_ONLINE = NotificationType(4, "pgwDeviceOnline", "A device answers again after pgwDeviceOffline.")
LOAD_DISCONNECT = NotificationType(5, "pgwLoadDisconnect", "A device has disconnected its load.")
LOAD_RECONNECT = NotificationType(6, "pgwLoadReconnect", "A device has connected its load again.")
LINE_IS_DOWN = NotificationType(7, "pgwLineDown", "The port of a line cannot be opened, or was lost.")
LINE_IS_UP = NotificationType(8, "pgwLineUp", "The port of a line is open again after pgwLineDown.")

TYPES: tuple[NotificationType, ...] = (
    RAISED, CLEARED, DEVICE_OFFLINE, DEVICE_ONLINE, LOAD_DISCONNECT, LOAD_RECONNECT, LINE_IS_DOWN, LINE_IS_UP,
)  # fmt: skip

_OWN_KIND = {
    OFFLINE.name: (DEVICE_OFFLINE, DEVICE_ONLINE),
    LOAD_OFF.name: (LOAD_DISCONNECT, LOAD_RECONNECT),
    LINE_DOWN: (LINE_IS_DOWN, LINE_IS_UP),
}


def kind_of(condition: Condition, *, raised: bool) -> NotificationType:
    """Which notification tells that a condition is raised or clear."""
    return _OWN_KIND.get(condition.name, (RAISED, CLEARED))[0 if raised else 1]


def values_of(announcement: Announcement, sequence: int, site: str) -> dict[str, CellValue]:
    """What the objects of a notification hold, by name."""
    watch = announcement.watch
    condition = watch.condition
    subject = watch.device or watch.line
    voltage = None if watch.device is None else watch.device.snapshot.values.get("battery_voltage")
    return {
        "pgwNotifySequence": sequence,
        "pgwNotifyCause": 2 if announcement.summary else 1,
        "pgwSiteName": text(site),
        "pgwNotifySubject": b"" if subject is None else text(subject.name),
        "pgwConditionName": text(condition.name),
        "pgwConditionText": text(condition.text),
        "pgwConditionSeverity": int(condition.severity),
        "pgwConditionState": int(ConditionState.RAISED if announcement.raised else ConditionState.CLEAR),
        "pgwNotifyBatteryVoltage": NO_VOLTAGE if voltage is None else round(voltage * 1000),
    }
