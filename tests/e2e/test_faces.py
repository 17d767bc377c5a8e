"""The three faces say the same, to clients that are nobody's mock: net-snmp, Prometheus, pymodbus.

The registers read over Modbus are decoded here by the words of the document, not by the gateway's code.
"""

from __future__ import annotations

import json
import math
import re
import struct
import subprocess
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families
from pymodbus.client import ModbusTcpClient

from gateway.devices.model import DeviceMap, Emc1Form, Group, Kind, Point, PollClass, Space, WordOrder
from gateway.devices.schema import load_map
from gateway.faces.snmp.entity import sensors
from tests.e2e.programs import (
    ALL_DEVICES,
    GATEWAY,
    MODELS,
    REPOSITORY,
    Launch,
    Running,
    Start,
    environment,
    wait_until,
)
from tests.netsnmp import without_new_folders

STILL = ("--speed", "0.001", "--start-hour", "11")
"""A simulated noon that does not move while it is looked at."""

ROOT = "1.3.6.1.4.1.32473.1"
TABLES = {Group.LIVE: 4, Group.ENERGY: 5, Group.TODAY: 6, Group.SETTINGS: 7}
PROSTAR, TRISTAR = load_map("prostar-mppt"), load_map("tristar-mppt")
MAPS = {unit: TRISTAR if name in MODELS else PROSTAR for _, name, _, unit in ALL_DEVICES}

SCALING = {"voltage_scaling": 0x0000, "current_scaling": 0x0002}
"""Where a TriStar tells its own: V_PU and I_PU, whole term and fraction. Only its points have such factors."""

NO_MORE: Mapping[tuple[int, str], float] = {}

Value = float | str | frozenset[int]
Values = Mapping[tuple[int, str], Value]
"""By unit id and point: a number in the point's unit, a text, or the numbers of the bits that are set."""


@pytest.fixture
def site(launch: Launch, start: Start, free_tcp_port: Callable[[], int]) -> Running:
    """A gateway over the demo's controllers and a TriStar on a network, all of whose points have been read."""
    port = free_tcp_port()
    network = ("--tcp", str(port), "--close-after-reply", "--line", "hilltop=1:tristar-mppt", "--seed", "1")
    start(*GATEWAY, "simulate", *network, *STILL)
    emc1 = "".join(f"[[snmp.emc1]]\nunit_id = {unit}\n" for unit in MAPS)
    running = launch(simulate=STILL, devices=ALL_DEVICES, rest=emc1, upstreams={"hilltop": port})
    running.wait_online()
    # Settings are read last of all at start.
    wait_until(
        lambda: running.get("/metrics")[1].count("morningstar_time_since_equalize_seconds{") == 5, "the settings"
    )
    return running


def snmp(peer: Callable[[str], str], site: Running, program: str, *arguments: str) -> str:
    """What a program of net-snmp prints; it must have nothing to complain about."""
    options = ["-v2c", "-c", "public", "-M", "mibs:mibs/base", "-m", "ALL"]
    command = [peer(program), *options, *arguments[:-1], f"127.0.0.1:{site.snmp}", arguments[-1]]
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY, env=environment(), check=False)
    assert done.returncode == 0, done.stderr
    assert without_new_folders(done.stderr) == ""
    return done.stdout


def by_modbus(site: Running) -> Values:
    """Every point as an unrelated Modbus client reads it."""
    found: dict[tuple[int, str], Value] = {}
    with ModbusTcpClient("127.0.0.1", port=site.modbus, timeout=60, retries=0) as client:
        for unit, device_map in MAPS.items():
            cells = cells_of(client, unit, device_map)
            scaling = {
                name: (cells[Space.REGISTERS, at] << 16 | cells[Space.REGISTERS, at + 1]) / 65536
                for name, at in SCALING.items()
            }
            for point in device_map.points:
                if point.metric is None and point.mib is None:
                    continue
                own = [cells[point.space, point.address + k] for k in range(point.words)]
                value = decoded(point, own, scaling)
                if value is not None:
                    found[unit, point.name] = value
    return found


def cells_of(client: ModbusTcpClient, unit: int, device_map: DeviceMap) -> dict[tuple[Space, int], int]:
    """Registers and coils in which shown points lie, by address."""
    found: dict[tuple[Space, int], int] = {}
    for extent in device_map.extents:
        if extent.poll is PollClass.BACKGROUND:
            continue
        for first in range(extent.first, extent.last + 1, 120):
            count = min(120, extent.last + 1 - first)
            values: Sequence[int]
            if extent.space is Space.COILS:
                values = [int(bit) for bit in client.read_coils(first, count=count, device_id=unit).bits[:count]]
            else:
                values = client.read_holding_registers(first, count=count, device_id=unit).registers
            found |= {(extent.space, first + k): value for k, value in enumerate(values)}
    return found


def decoded(point: Point, words: list[int], scaling: Mapping[str, float]) -> Value | None:
    """What the words say by the document; None where the document says that they say nothing."""
    reading = point.readings[0]
    if point.kind is Kind.TEXT:
        return decoded_text(point, words)
    if reading.codec == "f16" or (reading.codec == "multiplier" and words[0] > 2):  # 1 and 2 are understood too
        (number,) = struct.unpack(">e", words[0].to_bytes(2))
        return float(number) * reading.scale if number - number == 0 else None
    ordered = words if reading.order is WordOrder.HI_LO else words[::-1]
    raw = int("".join(f"{word:04x}" for word in ordered), 16)
    if raw in reading.absent:
        return None
    if point.bits is not None:
        return frozenset(bit for bit in range(32) if raw >> bit & 1)
    if reading.codec == "bcd":
        return float(int(f"{raw:x}"))
    if reading.codec.startswith("s"):
        raw -= (raw >> 15) << 16
    return raw * reading.scale * math.prod(scaling[name] for name in reading.factors)


def decoded_text(point: Point, words: list[int]) -> str:
    """The same of a text."""
    reading = point.readings[0]
    octets = b"".join(word.to_bytes(2, "big" if reading.order is WordOrder.HI_LO else "little") for word in words)
    if reading.codec == "ascii":
        return octets.rstrip(b"\0").decode()
    return octets.hex(":") if reading.codec == "mac" else ".".join(map(str, octets))


def by_http(site: Running) -> Values:
    """Every point as Prometheus reads it."""
    samples = [
        sample
        for family in text_string_to_metric_families(site.get("/metrics")[1])
        for sample in family.samples
        if sample.name.startswith("morningstar_")
    ]
    found: dict[tuple[int, str], Value] = {}
    for unit, device_map in MAPS.items():
        for point in device_map.points:
            own = [s for s in samples if s.name == point.metric and s.labels["unit_id"] == str(unit)]
            if not own:
                continue
            if point.enumeration is not None:
                numbers = {entry.name: entry.number for entry in device_map.enumerations[point.enumeration]}
                (state,) = (sample.labels["state"] for sample in own if sample.value == 1)
                found[unit, point.name] = float(numbers[state])
            elif point.bits is not None:
                numbers = {bit.name: bit.number for bit in device_map.bit_tables[point.bits]}
                found[unit, point.name] = frozenset(numbers[s.labels["bit"]] for s in own if s.value == 1)
            elif point.kind is Kind.TEXT:
                (sample,) = own
                found[unit, point.name] = sample.labels[point.name]
            else:
                (sample,) = own
                found[unit, point.name] = sample.value / point.metric_scale
    return found


def by_snmp(peer: Callable[[str], str], site: Running) -> Values:
    """Every point as net-snmp reads it."""
    shown = snmp(peer, site, "snmpbulkwalk", "-Onqe", "-OU", "-Ox", ROOT)
    cells = dict(re.findall(r"^\.([\d.]+) (.*?) ?$", shown, re.MULTILINE))
    found: dict[tuple[int, str], Value] = {}
    for unit, device_map in MAPS.items():
        for point in device_map.points:
            if point.mib is None:
                continue
            cell = cells.get(f"{ROOT}.1.2.1.{TABLES[point.group]}.1.{point.mib.column}.{unit}")
            if cell is None:
                continue
            if point.bits is not None:
                octets = bytes.fromhex(cell.strip('" '))
                found[unit, point.name] = frozenset(
                    bit for bit in range(8 * len(octets)) if octets[bit // 8] & 0x80 >> bit % 8
                )
            elif point.kind is Kind.TEXT:
                found[unit, point.name] = cell.strip('"')
            else:
                found[unit, point.name] = int(cell) / point.mib.scale
    return found


def by_entity_sensor(peer: Callable[[str], str], site: Running) -> Values:
    """What ENTITY-SENSOR-MIB says, by scale and precision."""
    shown = snmp(peer, site, "snmpbulkwalk", "-OnqeU", "1.3.6.1.2.1.99")
    cells = {
        (int(column), int(index)): value
        for column, index, value in re.findall(r"^\.[\d.]+\.99\.1\.1\.1\.(\d)\.(\d+) (.*)$", shown, re.MULTILINE)
    }
    points = {**{each.name: each for each in PROSTAR.points}, **{each.name: each for each in TRISTAR.points}}
    live = [each for each in points.values() if each.group is Group.LIVE and each.unit]
    names = {each.mib.column: each.name for each in live if each.mib is not None}
    thousandths = {"8": 1000, "9": 1}
    return {
        (index // 1000, names[index % 1000]): int(value) / thousandths[cells[2, index]] / 10 ** int(cells[3, index])
        for (column, index), value in cells.items()
        if column == 4 and cells[5, index] == "1"
    }


def by_emc1(peer: Callable[[str], str], site: Running) -> Values:
    """What an EMC-1's client reads of each controller, by community and unit id."""
    found: dict[tuple[int, str], Value] = {}
    for unit, device_map in MAPS.items():
        assert device_map.emc1_root is not None
        root = re.escape("." + ".".join(map(str, device_map.emc1_root)))
        points = {point.emc1.number: point for point in device_map.points if point.emc1 is not None}
        options = ("-v2c", "-c", f"public@{unit}", "-m", "", "-OnqeUx", f"127.0.0.1:{site.snmp}", "1.3.6.1.4.1.33333")
        command = [peer("snmpwalk"), *options]
        shown = subprocess.run(command, capture_output=True, text=True, env=environment(), check=True).stdout
        for number, text in re.findall(rf"^{root}\.(\d+)\.0 (.*?) ?$", shown, re.MULTILINE):
            point = points.get(int(number))
            if "No more" in text:
                continue  # it is the last object of all
            if point is not None and (value := emc1_value(point, text.strip('" '))) is not None:
                found[unit, point.name] = value
    return found


def emc1_value(point: Point, text: str) -> Value | None:
    """A value in one of the forms of an EMC-1; octet strings are shown in hexadecimal."""
    assert point.emc1 is not None
    if point.emc1.form is Emc1Form.BITS:
        octets = bytes.fromhex(text)
        return frozenset(bit for bit in range(32) if octets[bit // 8] & 0x80 >> bit % 8)
    if point.emc1.form is Emc1Form.FLOAT:
        written = bytes.fromhex(text).decode()
        return None if written == "nan" else float(written)
    if point.bits is not None:
        return frozenset(bit for bit in range(16) if int(text) >> bit & 1)
    if point.emc1.form is Emc1Form.WORD:  # binary coded decimal, where the point is
        return int(f"{int(text):X}") if point.readings[0].codec == "bcd" else int(text)
    if point.emc1.step is not None:
        return int(text) * point.emc1.step
    return int(text) / (point.mib.scale if point.mib is not None else 1)


def half_steps(values: Values) -> Mapping[tuple[int, str], float]:
    """How far off whole steps of an EMC-1 may be, where it has such."""
    points = {key: MAPS[key[0]].point(key[1]).emc1 for key in values}
    return {key: found.step / 2 for key, found in points.items() if found is not None and found.step is not None}


def differences(one: Values, other: Values, rounding: Mapping[tuple[int, str], float] = NO_MORE) -> list[str]:
    """Where the second says something else than the first, or nothing; half a thousandth is rounding, at least."""
    wrong = []
    for key, value in one.items():
        there = other.get(key)
        if not isinstance(value, float | int) or not isinstance(there, float | int):
            same = value == there
        else:
            same = abs(value - there) <= 0.00051 + rounding.get(key, 0.0)
        if not same:
            wrong.append(f"{key}: {value} is {there}")
    return wrong


@pytest.mark.peer
def test_the_three_faces_agree_on_every_point(site: Running, peer: Callable[[str], str]) -> None:
    expected = by_modbus(site)
    http, walked = by_http(site), by_snmp(peer, site)
    assert differences(expected, by_modbus(site)) == []  # nothing moved meanwhile

    def where(wanted: Callable[[Point], object]) -> Values:
        return {(unit, name): expected[unit, name] for unit, name in expected if wanted(MAPS[unit].point(name))}

    in_metrics, in_mib = where(lambda point: point.metric), where(lambda point: point.mib)
    assert len(in_metrics) > 3 * 80 + 2 * 90
    assert len(in_mib) > 3 * 80 + 2 * 100
    for values, shown in ((in_metrics, http), (in_mib, walked)):
        assert differences(values, shown) == []
        assert differences(shown, values) == []
    in_sensors = {key: value for key, value in expected.items() if MAPS[key[0]].point(key[1]) in sensors(MAPS[key[0]])}
    in_emc1 = where(lambda point: point.emc1)
    assert len(in_emc1) > 3 * 30 + 2 * 30
    for values, shown in ((in_sensors, by_entity_sensor(peer, site)), (in_emc1, by_emc1(peer, site))):
        assert len(values) > 3 * 20
        rounding = half_steps(in_emc1) if values is in_emc1 else NO_MORE
        assert differences(values, shown, rounding) == []
        assert differences(shown, values, rounding) == []


@pytest.mark.peer
def test_net_snmp_shows_every_table(site: Running, peer: Callable[[str], str]) -> None:
    mib = (REPOSITORY / "mibs" / "PROSTAR-GATEWAY-MIB.txt").read_text()
    names = re.findall(r"^(pgw\w+Table) OBJECT-TYPE", mib, re.MULTILINE)
    assert len(names) >= 6
    for name in names:
        shown = snmp(peer, site, "snmptable", "-Ci", name).splitlines()
        if name == "pgwConditionTable":  # a row for each condition of each controller
            assert len(shown) > 3 * 40
            continue
        if name in {"pgwClientTable", "pgwLogTable"} and "No entries" in shown[0]:
            continue  # nobody has asked yet, and no history is kept
        rows = {"pgwLineTable": 3}.get(name, 5)
        assert shown[0] == f"SNMP table: PROSTAR-GATEWAY-MIB::{name}"
        assert len([row for row in shown[3:] if row.strip()]) == rows, name
        assert "array" not in name or "array-1" in "\n".join(shown)
        walked = snmp(peer, site, "snmpwalk", name).splitlines()
        assert all(line.startswith("PROSTAR-GATEWAY-MIB::pgw") for line in walked)
        assert len(walked) >= 2 * rows
    devices = snmp(peer, site, "snmptable", "-Ci", "-Cf", "|", "pgwDeviceTable")
    assert all(name in devices for _, name, _, _ in ALL_DEVICES)


@pytest.mark.peer
def test_promtool_and_a_real_prometheus_have_nothing_to_complain_about(
    site: Running, peer: Callable[[str], str], start: Start, tmp_path: Path, free_tcp_port: Callable[[], int]
) -> None:
    scrape = site.get("/metrics")[1]
    checked = subprocess.run(
        [peer("promtool"), "check", "metrics"], input=scrape, check=False, capture_output=True, text=True
    )
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, "", "")
    config = tmp_path / "prometheus.yml"
    target = f"127.0.0.1:{site.http}"
    config.write_text(
        "scrape_configs:\n- job_name: gateway\n  scrape_interval: 200ms\n  scrape_timeout: 200ms\n"
        f"  static_configs:\n  - targets: ['{target}']\n"
    )
    web = f"127.0.0.1:{free_tcp_port()}"
    arguments = [f"--config.file={config}", f"--storage.tsdb.path={tmp_path / 'tsdb'}", f"--web.listen-address={web}"]
    prometheus = start(peer("prometheus"), *arguments, "--log.level=debug")

    def query(text: str) -> list[Mapping[str, object]]:
        try:
            with urllib.request.urlopen(f"http://{web}/api/v1/query?query={text}", timeout=60) as reply:
                answer = json.load(reply)
        except urllib.error.HTTPError as error:
            error.close()
            return []
        except OSError:
            return []
        result: list[Mapping[str, object]] = answer["data"]["result"]
        return result

    wait_until(lambda: query("count_over_time(up[1m])>3"), "four scrapes")
    assert [float(entry["value"][1]) for entry in query("up")] == [1.0]  # type: ignore[index]
    assert len(query("morningstar_battery_voltage_volts")) == 5
    assert len(query("morningstar_charge_state==1")) == 5
    assert len(query("scrape_samples_scraped>100")) == 1
    assert prometheus.end() == 0
    complaints = [line for line in prometheus.log().splitlines() if re.search(r"level=(warn|error)", line)]
    assert [line for line in complaints if not re.search("Received (SIGTERM|an OS signal)", line)] == []
