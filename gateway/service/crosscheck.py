"""Checks that compare one key with another, or with a device map.

They read the raw file and skip whatever has the wrong type or is missing: the schema reports that. So one run
names every problem, whichever kind it is. What is compared is only what is unmistakable: two ports that are the
same by a symbolic link are a matter for the lock on the port, which the running gateway reports.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec

from gateway.devices.agreement import all_maps
from gateway.devices.model import DeviceMap
from gateway.devices.schema import load_map, models
from gateway.devices.unknown import AUTO
from gateway.service.emc1 import emc1_problems
from gateway.service.notify import notify_problems
from gateway.service.parsing import Address, parse_listen
from gateway.service.problems import Path, Problem, render_path, show
from gateway.service.schema_problems import table_at
from gateway.service.schema_tls import TlsTable
from gateway.service.snmp import snmp_problems
from gateway.service.writes import rule_problems

Raw = Mapping[str, object]

SERIAL_KEYS = ("baudrate", "bytesize", "parity", "stopbits", "quarantine_s", "gap_s")
UPSTREAM_KEYS = ("pipelining", "connections", "connect_timeout_s")


def cross_problems(raw: Raw) -> list[Problem]:
    """Every problem of the file that takes more than one key to see."""
    lines = list(_tables(raw, "line", ()))
    devices = [found for path, line in lines for found in _tables(line, "device", path)]
    problems = [
        *_repeated(((*path, "name"), line.get("name")) for path, line in lines),
        *_repeated(((*path, "port"), line.get("port")) for path, line in lines),
        *_repeated(((*path, "name"), device.get("name")) for path, device in devices),
        *_repeated(((*path, "unit_id"), device.get("unit_id")) for path, device in devices),
    ]
    for path, line in lines:
        problems += _repeated(((*at, "address"), device.get("address")) for at, device in _tables(line, "device", path))
        problems += _upstream(path, line)
    for path, device in devices:
        problems += _model(path, device)
    problems += _pair(raw, "http", "tls_certificate", "tls_private_key")
    snmp = _table(raw, "snmp")
    communities, users, views = (list(_tables(snmp, key, ("snmp",))) for key in ("community", "user", "view"))
    problems += _repeated((((*path, "name"), table.get("name")) for path, table in communities), secret=True)
    problems += _repeated(((*path, "name"), table.get("name")) for path, table in users)
    problems += _repeated(((*path, "name"), table.get("name")) for path, table in views)
    problems += snmp_problems(users, communities, views)
    problems += _encryption(raw, users)
    emc1 = list(_tables(snmp, "emc1", ("snmp",)))
    problems += _repeated(((*path, "unit_id"), table.get("unit_id")) for path, table in emc1)
    problems += emc1_problems(emc1, devices)
    problems += notify_problems(list(_tables(snmp, "notify", ("snmp",))), users)
    problems += _line_listeners(raw, [line.get("name") for _, line in lines])
    problems += _listen_clashes(raw, ("modbus", "http"))
    problems += _listen_clashes(raw, ("snmp",))
    rules = list(_tables(_table(raw, "modbus"), "write", ("modbus",)))
    return [*problems, *rule_problems(rules, [device for _, device in devices])]


def _table(raw: Raw, name: str) -> Raw:
    table = raw.get(name)
    return table if isinstance(table, Mapping) else {}


def _tables(raw: Raw, name: str, path: Path) -> Iterator[tuple[Path, Raw]]:
    """The tables of a list of tables, each with its key path."""
    tables = raw.get(name)
    if isinstance(tables, list):
        for index, table in enumerate(tables):
            if isinstance(table, Mapping):
                yield (*path, name, index), table


def _repeated(values: Iterator[tuple[Path, object]], *, secret: bool = False) -> Iterator[Problem]:
    seen: dict[object, Path] = {}
    for path, value in values:
        if not isinstance(value, str | int) or isinstance(value, bool):
            continue
        if value in seen:
            shown = "the same value" if secret else show(value)
            yield Problem(path, f"{shown} is already used by {render_path(seen[value])}; allowed: a value of its own")
        else:
            seen[value] = path


def _encryption(raw: Raw, users: Sequence[tuple[Path, Raw]]) -> Iterator[Problem]:
    """What only the library can do that may not be there; it is looked for, and not loaded."""
    wanted: list[Path] = [path for path, _ in users[:1]]
    if isinstance(_table(raw, "modbus").get("tls"), Mapping):
        wanted.append(("modbus", "tls"))
    if wanted and find_spec("cryptography") is None:
        for path in wanted:
            text = "needs the Python package cryptography, which is not installed; allowed: install it, or leave this"
            yield Problem(path, text)


def _upstream(path: Path, line: Raw) -> Iterator[Problem]:
    """Keys that a line of its kind has no use for."""
    port = line.get("port")
    if not isinstance(port, str):
        return
    upstream = port.startswith("tcp://")
    for key in SERIAL_KEYS if upstream else UPSTREAM_KEYS:
        if key in line:
            what = "a Modbus TCP upstream" if upstream else "a serial port"
            yield Problem((*path, key), f"has no meaning for {what}; allowed: leave it out")


def _model(path: Path, device: Raw) -> Iterator[Problem]:
    model = device.get("model")
    if not isinstance(model, str):
        return
    if model != AUTO and model not in models():
        known = ", ".join(f'"{name}"' for name in (*models(), AUTO))
        yield Problem((*path, "model"), f"{show(model)} has no map; allowed: {known}")
        return
    maps = all_maps() if model == AUTO else (load_map(model),)
    yield from _identity(path, device, model, maps)
    decode = device.get("decode")
    if not isinstance(decode, Mapping):
        return
    readings: dict[str, dict[str, None]] = {}
    for point in (point for device_map in maps for point in device_map.points if len(point.readings) > 1):
        readings.setdefault(point.name, {}).update(dict.fromkeys(reading.name for reading in point.readings))
    for name, reading in decode.items():
        if name not in readings:
            text = f"no point of {model} with another reading has this name; allowed: {', '.join(readings) or 'none'}"
            yield Problem((*path, "decode", name), text)
        elif isinstance(reading, str) and reading not in readings[name]:
            allowed = ", ".join(f'"{known}"' for known in readings[name])
            yield Problem((*path, "decode", name), f"{show(reading)} is no reading of this point; allowed: {allowed}")


def _identity(path: Path, device: Raw, model: str, maps: Sequence[DeviceMap]) -> Iterator[Problem]:
    """What no unit of the model can say of itself."""
    product = device.get("product")
    if isinstance(product, str) and not any(device_map.identity.names(product) for device_map in maps):
        allowed = [code for device_map in maps for code in device_map.identity.product_codes]
        allowed += [f"{prefix}…" for device_map in maps for prefix in device_map.identity.product_prefixes]
        what = "known model" if model == AUTO else model
        yield Problem((*path, "product"), f"no {what} calls itself {show(product)}; allowed: {', '.join(allowed)}")
    if isinstance(device.get("serial_number"), str) and all(each.identity.serial_first is None for each in maps):
        text = f"a {model} tells no serial number; allowed: leave it out"
        yield Problem((*path, "serial_number"), text)


def _line_listeners(raw: Raw, lines: list[object]) -> list[Problem]:
    """A listener stands for a line that there is, a line has one listener, and TLS needs files."""
    listeners = list(_tables(_table(raw, "modbus"), "listener", ("modbus",)))
    problems = list(_repeated(((*path, "line"), listener.get("line")) for path, listener in listeners))
    for path, listener in listeners:
        line = listener.get("line")
        if isinstance(line, str) and line not in lines:
            known = ", ".join(show(name) for name in lines if isinstance(name, str))
            problems.append(Problem((*path, "line"), f"no line is called {show(line)}; allowed: {known}"))
        if listener.get("tls") is True and not isinstance(_table(raw, "modbus").get("tls"), Mapping):
            text = "there is no [modbus.tls] with the files for it; allowed: that table, or false"
            problems.append(Problem((*path, "tls"), text))
    return problems


def _listens(raw: Raw, face: str) -> Iterator[tuple[Path, object]]:
    """Every listen address of a face, the default ones too."""
    table = table_at((face,))
    assert table is not None
    own = _table(raw, face)
    tables: list[tuple[Path, object]] = [((face,), own.get("listen", list(table.model_fields["listen"].default)))]
    tables += [(path, each.get("listen")) for key in ("listener", "emc1") for path, each in _tables(own, key, (face,))]
    tls = own.get("tls")
    if isinstance(tls, Mapping):
        tables.append(((face, "tls"), tls.get("listen", list(TlsTable.model_fields["listen"].default))))
    for path, listens in tables:
        for index, text in enumerate(listens if isinstance(listens, list) else []):
            yield (*path, "listen", index), text


def _listen_clashes(raw: Raw, faces: tuple[str, ...]) -> Iterator[Problem]:
    """Addresses of one transport that cannot be opened together: the same, or one that covers the other."""
    seen: list[tuple[Address, Path]] = []
    for path, text in (listen for face in faces for listen in _listens(raw, face)):
        address = _address(text)
        if address is None or address.port == 0:
            continue
        other = next((at for known, at in seen if _covers(known, address)), None)
        if other is None:
            seen.append((address, path))
        else:
            yield Problem(path, f"{show(text)} clashes with {render_path(other)}; allowed: another address or port")


def _pair(raw: Raw, table: str, one: str, other: str) -> Iterator[Problem]:
    """Two keys of which neither is of use alone."""
    for key, missing in ((one, other), (other, one)):
        if _table(raw, table).get(key, "") != "" and _table(raw, table).get(missing, "") == "":
            yield Problem((table, missing), f"is missing, and {table}.{key} is there; allowed: both or neither")


def _address(text: object) -> Address | None:
    try:
        return parse_listen(text) if isinstance(text, str) else None
    except ValueError:
        return None


def _covers(one: Address, other: Address) -> bool:
    if one.port != other.port:
        return False
    first, second = ipaddress.ip_address(one.host), ipaddress.ip_address(other.host)
    if first.version != second.version:
        return False
    return first == second or first.is_unspecified or second.is_unspecified
