"""Every register and coil of the documents, read through the gateway by two unrelated clients, of five controllers.

The controllers' registers all differ (simulator/oracle.py), three of them share an address on different lines: a word
of another controller, register or moment cannot pass. One TriStar is on a serial line, one on a network, where it
closes each connection after its reply.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pymodbus.client import ModbusTcpClient

from gateway.devices.model import Extent, Space
from gateway.devices.schema import load_map
from gateway.simulator.oracle import OracleController
from tests.e2e.fast_lines import BAUDRATE, controllers, networked
from tests.e2e.programs import ALL_DEVICES, Launch, Running, Start, environment, wait_until

DOCUMENTS = {
    "prostar-mppt": {
        Space.REGISTERS: [(0x0000, 0x0051), (0xE000, 0xE04F), (0x8000, 0x8FFF)],
        Space.COILS: [(0x00, 0xFF)],
    },
    "tristar-mppt": {
        Space.REGISTERS: [(0x0000, 0x005B), (0x1000, 0x1030), (0x151B, 0x1521), (0xE000, 0xE0CD)],
        Space.COILS: [(0x00, 0xFF), (0x1000, 0x1003), (0x10FF, 0x10FF)],
    },
}
POLL = "[poll]\nlive_s = 5.0\n"
LARGEST = 125  # what mbpoll asks at most, of coils too


def chunks(extent: Extent) -> Iterator[tuple[int, int]]:
    """The extent as (first, count) of the largest reads that are allowed."""
    for first in range(extent.first, extent.last + 1, LARGEST):
        yield first, min(LARGEST, extent.last + 1 - first)


def held(oracle: OracleController, extent: Extent, first: int, count: int) -> list[int]:
    """What the controller holds there."""
    word = oracle.coil if extent.space is Space.COILS else oracle.word
    return [word(address) for address in range(first, first + count)]


@pytest.fixture
def fast_site(launch: Launch, start: Start, tmp_path: Path, free_tcp_port: Callable[[], int]) -> Running:
    """A gateway over the oracle controllers; polling leaves the lines to the clients."""
    port = free_tcp_port()
    start(sys.executable, "-m", "tests.e2e.fast_lines", str(tmp_path), str(port))
    wait_until((tmp_path / "shelter-b").exists, "the fast lines")
    keys = f"baudrate = {BAUDRATE}"
    site = launch(simulate=None, devices=ALL_DEVICES, line_keys=keys, rest=POLL, upstreams={"hilltop": port})
    site.wait_online()
    return site


def by_unit() -> dict[int, OracleController]:
    """The oracle of each unit id."""
    flat = [*(oracle for stations in controllers().values() for oracle in stations), networked()]
    return dict(zip((unit for _, _, _, unit in ALL_DEVICES), flat, strict=True))


@pytest.mark.parametrize("model", DOCUMENTS)
def test_the_map_has_every_register_of_the_document(model: str) -> None:
    spans: dict[Space, set[int]] = {Space.REGISTERS: set(), Space.COILS: set()}
    for extent in load_map(model).extents:
        spans[extent.space] |= set(range(extent.first, extent.last + 1))
    for space, ranges in DOCUMENTS[model].items():
        assert {address for first, last in ranges for address in range(first, last + 1)} == spans[space]


@pytest.mark.peer
def test_mbpoll_reads_what_each_controller_holds(fast_site: Running, peer: Callable[[str], str]) -> None:
    mbpoll = peer("mbpoll")
    read = 0
    for unit, oracle in by_unit().items():
        for extent in oracle.map.extents:
            for first, count in chunks(extent):
                kind = "0" if extent.space is Space.COILS else "4:hex"
                options = ["-0", "-1", "-o", "5", "-a", str(unit), "-t", kind, "-r", str(first), "-c", str(count)]
                arguments = [mbpoll, "-m", "tcp", "-p", str(fast_site.modbus), *options, "127.0.0.1"]
                done = subprocess.run(arguments, capture_output=True, text=True, env=environment(), check=False)
                assert done.returncode == 0, done.stderr
                shown = re.findall(r"^\[(\d+)\]:\s+(\S+)", done.stdout, re.MULTILINE)
                assert [int(address) for address, _ in shown] == list(range(first, first + count))
                base = 10 if extent.space is Space.COILS else 16
                assert [int(value, base) for _, value in shown] == held(oracle, extent, first, count)
                read += count
    assert read >= 3 * (82 + 80 + 4096 + 256) + 2 * (92 + 49 + 7 + 206 + 256 + 5)


def test_pymodbus_reads_what_each_controller_holds(fast_site: Running) -> None:
    read = 0
    with ModbusTcpClient("127.0.0.1", port=fast_site.modbus, timeout=60, retries=0) as client:
        for unit, oracle in by_unit().items():
            for extent in oracle.map.extents:
                if extent.space is Space.COILS:
                    ways = [client.read_coils, client.read_discrete_inputs]
                else:
                    ways = [client.read_holding_registers, client.read_input_registers]
                for first, count in chunks(extent):
                    for number, ask in enumerate(ways):
                        if number and extent.name == "daily_log" and first % 3:
                            continue  # function 04 answers from where 03 does; a third of the log shows it
                        reply = ask(first, count=count, device_id=unit)
                        assert not reply.isError(), (unit, hex(first), reply)
                        values = reply.bits[:count] if extent.space is Space.COILS else reply.registers
                        assert [int(value) for value in values] == held(oracle, extent, first, count)
                        read += count
            assert client.read_holding_registers(0x005C, count=1, device_id=unit).exception_code == 2
            information = client.read_device_information(device_id=unit)
            assert dict(information.information) == oracle.identification()
    assert read >= 3 * 2 * (82 + 80 + 256) + 3 * 4096 + 2 * 2 * (92 + 49 + 7 + 206 + 256 + 5)


def test_nobody_can_write(fast_site: Running) -> None:
    with ModbusTcpClient("127.0.0.1", port=fast_site.modbus, timeout=60, retries=0) as client:
        for reply in (
            client.write_register(0xE000, 1, device_id=11),
            client.write_coil(0x00FF, value=True, device_id=11),
            client.write_registers(0xE000, [1, 2], device_id=11),
            client.write_coils(0, [True], device_id=11),
            client.mask_write_register(address=0xE000, and_mask=0, or_mask=1, device_id=11),
        ):
            assert reply.exception_code == 1
