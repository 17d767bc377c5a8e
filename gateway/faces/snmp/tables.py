"""The tables and scalars that do not come from a device map: gateway, lines, devices, Modbus server.

Numbers are append-only (mibs/oids.lock); a new object takes the next free one.
"""

from __future__ import annotations

from collections.abc import Callable

from gateway.core.site import LineState
from gateway.core.snapshot import DeviceState
from gateway.devices.model import DeviceMap, Group
from gateway.faces.snmp.objects import (
    CellValue,
    Changes,
    Convention,
    DeviceRow,
    Gateway,
    LineRow,
    ObjectType,
    Syntax,
    text,
)

LINE_STATE = Convention(
    "PgwLineStateCode",
    Syntax.ENUMERATION,
    ((1, "down"), (2, "open")),
    "Whether the serial port of a line is open.",
)
DEVICE_STATE = Convention(
    "PgwDeviceStateCode",
    Syntax.ENUMERATION,
    ((1, "unknown"), (2, "online"), (3, "stale"), (4, "offline")),
    "Quality of everything a device shows. unknown(1): not one reply since the gateway started. "
    "online(2): answers. stale(3): missed three polls in a row. offline(4): probed only now and then. "
    "Values of a device that is not online(2) are not instantiated.",
)

_LINE_NUMBERS = {LineState.DOWN: 1, LineState.OPEN: 2}
_DEVICE_NUMBERS = {
    DeviceState.UNKNOWN: 1,
    DeviceState.ONLINE: 2,
    DeviceState.STALE: 3,
    DeviceState.OFFLINE: 4,
}


def _counter(number: int, name: str, description: str, get: Callable[..., int]) -> ObjectType:
    return ObjectType(number, name, Syntax.COUNTER32, description, lambda row, _now: get(row))


def _fixed(number: int, name: str, syntax: Syntax, description: str, get: Callable[..., CellValue]) -> ObjectType:
    return ObjectType(number, name, syntax, description, lambda row, _now: get(row), changes=Changes.NEVER)


def _of_snapshot(
    number: int,
    name: str,
    syntax: Syntax,
    description: str,
    get: Callable[[DeviceRow], CellValue],
    *,
    convention: Convention | None = None,
) -> ObjectType:
    return ObjectType(
        number,
        name,
        syntax,
        description,
        lambda row, _now: get(row),
        convention=convention,
        changes=Changes.WITH_SNAPSHOT,
    )


def _lines_open(gateway: Gateway, now: float) -> int:
    return sum(line.status(now).state is LineState.OPEN for line in gateway.site.lines)


def _devices_online(gateway: Gateway, _now: float) -> int:
    return sum(device.snapshot.state is DeviceState.ONLINE for device in gateway.site.devices)


GATEWAY: tuple[ObjectType, ...] = (
    _fixed(1, "pgwSiteName", Syntax.TEXT, "Name of the site, as configured.", lambda gw: text(gw.site.name)),
    _fixed(2, "pgwVersion", Syntax.TEXT, "Version of the gateway program.", lambda gw: text(gw.version)),
    ObjectType(
        3,
        "pgwUptime",
        Syntax.TIME_TICKS,
        "Time since the gateway's SNMP agent started; never steps with the wall clock.",
        lambda gw, now: gw.ticks(now),
    ),
    _fixed(4, "pgwLineCount", Syntax.UNSIGNED32, "Number of configured lines.", lambda gw: len(gw.site.lines)),
    ObjectType(5, "pgwLinesOpen", Syntax.GAUGE32, "Number of lines whose port is open.", _lines_open),
    _fixed(6, "pgwDeviceCount", Syntax.UNSIGNED32, "Number of configured devices.", lambda gw: len(gw.site.devices)),
    ObjectType(7, "pgwDevicesOnline", Syntax.GAUGE32, "Number of devices that are online.", _devices_online),
)

MODBUS: tuple[ObjectType, ...] = (
    _counter(1, "pgwModbusConnections", "Modbus TCP connections accepted.", lambda gw: gw.modbus.connections),
    ObjectType(
        2,
        "pgwModbusOpenConnections",
        Syntax.GAUGE32,
        "Modbus TCP connections open now.",
        lambda gw, _now: gw.modbus.open_connections,
    ),
    _counter(
        3,
        "pgwModbusRefusedConnections",
        "Modbus TCP connections closed before a byte was read: source not allowed, or too many.",
        lambda gw: gw.modbus.refused_connections,
    ),
    _counter(4, "pgwModbusRequests", "Modbus TCP requests received.", lambda gw: gw.modbus.requests),
    _counter(5, "pgwModbusCacheHits", "Requests answered from memory.", lambda gw: gw.modbus.cache_hits),
    _counter(6, "pgwModbusForwarded", "Requests handed to a line.", lambda gw: gw.modbus.forwarded),
    _counter(
        7,
        "pgwModbusExceptions",
        "Requests answered with an exception, of any code.",
        lambda gw: gw.modbus.exceptions.total(),
    ),
    _counter(
        8,
        "pgwModbusMalformed",
        "Frames that were no Modbus TCP, of any reason.",
        lambda gw: gw.modbus.malformed.total(),
    ),
)


LINE_ECHO = Convention(
    "PgwLineEchoCode",
    Syntax.ENUMERATION,
    ((1, "unknown"), (2, "absent"), (3, "present")),
    "Whether a line gives back what is sent on it, as two-wire EIA-485 adapters may. unknown(1): nothing was read yet.",
)
_ECHO_NUMBERS = {"unknown": 1, "absent": 2, "present": 3}


def _milliseconds(number: int, name: str, description: str, get: Callable[..., float]) -> ObjectType:
    return ObjectType(
        number, name, Syntax.COUNTER32, description, lambda row, _now: int(get(row) * 1000), units="milliseconds"
    )


def _line_time(number: int, name: str, description: str, *purposes: str) -> ObjectType:
    return _milliseconds(
        number,
        name,
        description,
        lambda row: sum(row.line.stats.seconds_by_purpose.get(purpose, 0.0) for purpose in purposes),
    )


def _top_client(row: LineRow) -> tuple[str, float]:
    clients = row.line.stats.seconds_by_client
    client = max(clients, key=clients.__getitem__, default="")
    return client, clients.get(client, 0.0)


def _line_change(row: LineRow, now: float) -> int:
    return row.gateway.ticks(row.line.status(now).since)


def _line_devices(row: LineRow) -> int:
    return sum(device.line is row.line for device in row.gateway.site.devices)


LINE: tuple[ObjectType, ...] = (
    _fixed(2, "pgwLineName", Syntax.TEXT, "Name of the line, as configured.", lambda row: text(row.line.name)),
    _fixed(3, "pgwLinePort", Syntax.TEXT, "Port of the line, as configured.", lambda row: text(row.line.port)),
    ObjectType(
        4,
        "pgwLineState",
        Syntax.ENUMERATION,
        "Whether the port is open.",
        lambda row, now: _LINE_NUMBERS[row.line.status(now).state],
        convention=LINE_STATE,
    ),
    ObjectType(5, "pgwLineLastChange", Syntax.TIME_STAMP, "sysUpTime when pgwLineState last changed.", _line_change),
    ObjectType(
        6,
        "pgwLineError",
        Syntax.TEXT,
        "Why the port is not open; empty while it is.",
        lambda row, now: text(row.line.status(now).error),
    ),
    _fixed(7, "pgwLineDevices", Syntax.UNSIGNED32, "Number of devices configured on the line.", _line_devices),
    ObjectType(
        8,
        "pgwLineQueue",
        Syntax.GAUGE32,
        "Client reads that wait for the line now.",
        lambda row, now: row.line.status(now).queue_depth,
    ),
    ObjectType(
        9,
        "pgwLineUse",
        Syntax.GAUGE32,
        "Share of the last minute in which a transaction was on the wire.",
        lambda row, now: round(row.line.status(now).use_ratio * 1000),
        units="0.1 percent",
    ),
    _counter(10, "pgwLineRequests", "Requests sent on the wire.", lambda row: row.line.stats.sent),
    _counter(11, "pgwLineReplies", "Requests that ended with a usable reply.", lambda row: row.line.stats.ok),
    _counter(
        12,
        "pgwLineFailures",
        "Requests that ended in any other way, exceptions of the device included.",
        lambda row: row.line.stats.failed.total(),
    ),
    _counter(13, "pgwLineRetries", "Requests that were repetitions.", lambda row: row.line.stats.retries),
    _counter(14, "pgwLinePolls", "Requests sent by the gateway's own poll plan.", lambda row: row.line.stats.polls),
    _counter(15, "pgwLineClientReads", "Requests sent for a client.", lambda row: row.line.stats.client_reads),
    _counter(16, "pgwLineOpens", "Times the port was opened.", lambda row: row.line.stats.opens),
    _counter(17, "pgwLineTimeouts", "Requests without a reply.", lambda row: row.line.stats.failed["timeout"]),
    _counter(
        18,
        "pgwLineExceptions",
        "Requests that a device answered with an exception.",
        lambda row: row.line.stats.failed["exception"],
    ),
    _counter(19, "pgwLineCrcErrors", "Replies with a wrong CRC.", lambda row: row.line.stats.wire.crc_errors),
    _counter(
        20,
        "pgwLineMismatches",
        "Replies with a right CRC but the wrong function, byte count or shape.",
        lambda row: row.line.stats.wire.mismatch,
    ),
    _counter(
        21,
        "pgwLineWrongUnit",
        "Frames from another address than the one asked.",
        lambda row: row.line.stats.wire.wrong_unit,
    ),
    _counter(22, "pgwLineNoise", "Bytes that belonged to no frame.", lambda row: row.line.stats.wire.noise_bytes),
    _counter(23, "pgwLineLate", "Bytes that came while no reply was due.", lambda row: row.line.stats.wire.late_bytes),
    _counter(24, "pgwLineEchoes", "Requests that came back as an echo.", lambda row: row.line.stats.wire.echoes),
    ObjectType(
        25,
        "pgwLineStretch",
        Syntax.GAUGE32,
        "How long live values take between two reads, as a share of what is asked for: 1000 while the line keeps up.",
        lambda row, now: round(row.line.status(now).stretch * 1000),
        units="0.1 percent",
    ),
    ObjectType(
        26,
        "pgwLineEcho",
        Syntax.ENUMERATION,
        "Whether the line gives the gateway's own requests back.",
        lambda row, now: _ECHO_NUMBERS[row.line.status(now).echo],
        convention=LINE_ECHO,
    ),
    _counter(
        27, "pgwLineJoinedReads", "Client reads that shared another's request.", lambda row: row.line.stats.joined
    ),
    _counter(28, "pgwLineWrites", "Writes sent for a client.", lambda row: row.line.stats.writes),
    _line_time(29, "pgwLinePollTime", "Line time spent on polls.", "poll", "identify", "serial_number", "settle"),
    _line_time(30, "pgwLineClientTime", "Line time spent on reads for clients.", "client"),
    _line_time(31, "pgwLineWriteTime", "Line time spent on writes, slave control left out.", "write"),
    _line_time(32, "pgwLineSlaveControlTime", "Line time spent on slave-control writes.", "slave_control"),
    _line_time(33, "pgwLineBackgroundTime", "Line time spent on the daily log.", "background"),
    _counter(
        34, "pgwLineQueueWaits", "Requests of clients that had their turn.", lambda row: row.line.stats.queue_wait.count
    ),
    _milliseconds(
        35,
        "pgwLineQueueWaitTime",
        "Time that the requests counted by pgwLineQueueWaits waited for their turn, in all.",
        lambda row: row.line.stats.queue_wait.sum_s,
    ),
    _milliseconds(
        36,
        "pgwLineReplyTime",
        "Time that the requests counted by pgwLineReplies took, in all.",
        lambda row: row.line.stats.reply_time.sum_s,
    ),
    ObjectType(
        37,
        "pgwLineTopClient",
        Syntax.TEXT,
        "The client that used most of the line's time since the start; empty when none did.",
        lambda row, _now: text(_top_client(row)[0]),
    ),
    _milliseconds(38, "pgwLineTopClientTime", "Line time that pgwLineTopClient used.", lambda row: _top_client(row)[1]),
    _fixed(
        39,
        "pgwLineSite",
        Syntax.TEXT,
        "Name of the site that the line belongs to: pgwSiteName, or where another gateway's site is behind it.",
        lambda row: text(row.gateway.site.of_line(row.line.name)),
    ),
)


def _identity(row: DeviceRow, part: str) -> bytes:
    identification = row.device.snapshot.identification
    return b"" if identification is None else text(getattr(identification, part))


def _since_reply(row: DeviceRow, now: float) -> int | None:
    return _ticks_since(row.device.snapshot.last_reply_at, now)


_names_of: dict[tuple[int, Group], tuple[DeviceMap, tuple[str, ...]]] = {}


def _names(device_map: DeviceMap, group: Group) -> tuple[str, ...]:
    """The points of a group; found once a map, since a walk asks for the age of every device."""
    key = (id(device_map), group)
    known = _names_of.get(key)
    if known is None or known[0] is not device_map:
        known = _names_of[key] = device_map, tuple(point.name for point in device_map.points if point.group is group)
    return known[1]


def _oldest(row: DeviceRow, now: float, group: Group) -> int | None:
    read_at = row.device.snapshot.read_at
    times = [read_at[name] for name in _names(row.device.map, group) if name in read_at]
    return _ticks_since(min(times), now) if times else None


def _ticks_since(at: float | None, now: float) -> int | None:
    # An age must not wrap to look young: it stops at the greatest TimeTicks, after 497 days.
    return None if at is None else min(2**32 - 1, max(0, int((now - at) * 100)))


DEVICE: tuple[ObjectType, ...] = (
    _fixed(2, "pgwDeviceName", Syntax.TEXT, "Name of the device, as configured.", lambda row: text(row.device.name)),
    _fixed(
        3,
        "pgwDeviceLine",
        Syntax.UNSIGNED32,
        "pgwLineIndex of the line that the device is on.",
        lambda row: row.device.line.index,
    ),
    _fixed(
        4,
        "pgwDeviceAddress",
        Syntax.UNSIGNED32,
        "Modbus address of the device on its line.",
        lambda row: row.device.address,
    ),
    _fixed(
        5,
        "pgwDeviceModel",
        Syntax.TEXT,
        "Model of the device: the map by which its registers are read.",
        lambda row: text(row.device.map.model),
    ),
    _of_snapshot(
        6,
        "pgwDeviceVendor",
        Syntax.TEXT,
        "Vendor that the device told by Read Device Identification; empty when not known.",
        lambda row: _identity(row, "vendor"),
    ),
    _of_snapshot(
        7,
        "pgwDeviceProduct",
        Syntax.TEXT,
        "Product code that the device told; empty when not known.",
        lambda row: _identity(row, "product"),
    ),
    _of_snapshot(
        8,
        "pgwDeviceRevision",
        Syntax.TEXT,
        "Hardware and software revision that the device told; empty when not known.",
        lambda row: _identity(row, "revision"),
    ),
    _of_snapshot(
        9,
        "pgwDeviceSerialNumber",
        Syntax.TEXT,
        "Serial number of the device; empty when not known.",
        lambda row: text(row.device.snapshot.serial_number or ""),
    ),
    _of_snapshot(
        10,
        "pgwDeviceState",
        Syntax.ENUMERATION,
        "Whether the device answers. This column always answers.",
        lambda row: _DEVICE_NUMBERS[row.device.snapshot.state],
        convention=DEVICE_STATE,
    ),
    _of_snapshot(
        11,
        "pgwDeviceLastChange",
        Syntax.TIME_STAMP,
        "sysUpTime when pgwDeviceState last changed.",
        lambda row: row.gateway.ticks(row.device.snapshot.state_since),
    ),
    ObjectType(
        12,
        "pgwDeviceReplyAge",
        Syntax.TIME_TICKS,
        "Time since the device last answered. Not instantiated before its first answer.",
        _since_reply,
    ),
    ObjectType(
        13,
        "pgwDeviceDataAge",
        Syntax.TIME_TICKS,
        "Age of the oldest live value. Not instantiated before live values were first read.",
        lambda row, now: _oldest(row, now, Group.LIVE),
    ),
    ObjectType(
        14,
        "pgwDeviceSettingsAge",
        Syntax.TIME_TICKS,
        "Age of the oldest setting. Not instantiated before settings were first read.",
        lambda row, now: _oldest(row, now, Group.SETTINGS),
    ),
    _counter(15, "pgwDevicePolls", "Polls of the device.", lambda row: row.device.stats.polls),
    _counter(16, "pgwDeviceFailures", "Requests to the device that failed.", lambda row: row.device.stats.failures),
    _counter(
        17,
        "pgwDeviceExceptions",
        "Requests that the device answered with an exception.",
        lambda row: row.device.stats.exceptions,
    ),
    _counter(
        18,
        "pgwDeviceWentOffline",
        "Times the device became offline.",
        lambda row: row.device.stats.went_offline,
    ),
    _counter(
        19,
        "pgwDeviceImplausible",
        "Values withheld because they were outside of what the map allows.",
        lambda row: row.device.stats.implausible,
    ),
    _milliseconds(20, "pgwDeviceLineTime", "Line time spent on the device.", lambda row: row.device.stats.line_s),
    ObjectType(
        21,
        "pgwDeviceRefresh",
        Syntax.GAUGE32,
        "Time between two reads of the live values, as of late; 0 before the second read.",
        lambda row, _now: round((row.device.stats.refresh_s or 0.0) * 1000),
        units="milliseconds",
    ),
    _counter(
        22,
        "pgwDeviceTimeouts",
        "Requests to the device without a reply.",
        lambda row: row.device.stats.errors["timeout"],
    ),
    _counter(
        23,
        "pgwDeviceCrcErrors",
        "Requests to the device that ended with a reply of a wrong CRC.",
        lambda row: row.device.stats.errors["crc"],
    ),
    _counter(
        24,
        "pgwDeviceMismatches",
        "Requests to the device that ended with a reply to something else.",
        lambda row: row.device.stats.errors["mismatch"],
    ),
    _counter(
        25,
        "pgwDeviceIdentityMismatches",
        "Times that another controller than the expected one was found in the device's place.",
        lambda row: row.device.stats.identity_mismatches,
    ),
)


DEVICE_SITE: tuple[ObjectType, ...] = (
    _fixed(
        28,
        "pgwDeviceSite",
        Syntax.TEXT,
        "Name of the site that the device belongs to: pgwSiteName, or where another gateway's site is behind its line.",
        lambda row: text(row.gateway.site.of_line(row.device.line.name)),
    ),
)
"""What came after the columns of the conditions."""
