"""`prostar-gateway simulate` as a program, and its layouts."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from pathlib import Path

import pytest
from pymodbus.client import ModbusSerialClient

from gateway.devices.model import DeviceMap
from gateway.modbus.mbap import encode
from gateway.modbus.pdu import ReadRequest
from gateway.simulator.layout import DEMO_LAYOUT, Behaviour, LinePlan, SimulatedSite
from gateway.simulator.oracle import OracleController

SIMULATE = (sys.executable, "-m", "gateway", "simulate")


def links(folder: Path) -> list[Path]:
    return list(folder.iterdir())


def test_the_default_layout_has_factory_address_1_on_two_lines() -> None:
    assert [(plan.name, plan.addresses) for plan in DEMO_LAYOUT] == [("shelter-a", (1, 2)), ("shelter-b", (1, 2))]
    assert [plan.models for plan in DEMO_LAYOUT] == [{}, {2: "tristar-mppt"}]


def test_lines_are_written_as_name_and_addresses() -> None:
    assert LinePlan.parse("hut=1,2,17") == LinePlan("hut", (1, 2, 17))
    assert LinePlan.parse("hut=1,2:tristar-mppt") == LinePlan("hut", (1, 2), {2: "tristar-mppt"})


@pytest.mark.parametrize(
    "text", ["hut", "=1", "hut=", "hut=1,", "hut=x", "hut=0", "hut=248", "a/b=1", "..=1", ".=1", "hut=1:", "hut=1:pwm"]
)
def test_wrong_lines_are_refused_with_their_text(text: str) -> None:
    with pytest.raises(ValueError, match=r"hut|=1"):
        LinePlan.parse(text)


def test_repeated_names_are_refused(prostar_map: DeviceMap) -> None:
    with pytest.raises(ValueError, match="repeat"):
        SimulatedSite.build(prostar_map, (LinePlan("a", (1,)), LinePlan("a", (2,))))


def test_every_controller_of_a_site_is_another(prostar_map: DeviceMap) -> None:
    site = SimulatedSite.build(prostar_map, behaviour=Behaviour(oracle=True))
    units = [unit for unit in site.controllers if isinstance(unit, OracleController)]
    assert [(unit.device, unit.address) for unit in units] == [(0, 1), (1, 2), (2, 1), (3, 2)]
    assert [unit.map.model for unit in units] == [*["prostar-mppt"] * 3, "tristar-mppt"]
    words = [unit.word(address) for unit in units for address in unit.addresses]
    assert len(words) == len(set(words)), "also of different models no two registers are alike"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_it_prints_its_ports_serves_them_and_ends(tmp_path: Path, number: signal.Signals) -> None:
    program = await asyncio.create_subprocess_exec(
        *SIMULATE,
        "--json",
        "--link-dir",
        str(tmp_path),
        "--oracle",
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    assert program.stdout is not None
    assert program.stderr is not None
    try:
        told = json.loads(await program.stdout.readline())
        assert told == {
            "lines": [
                {
                    "name": "shelter-a",
                    "port": str(tmp_path / "shelter-a"),
                    "addresses": [1, 2],
                    "models": ["prostar-mppt"] * 2,
                },
                {
                    "name": "shelter-b",
                    "port": str(tmp_path / "shelter-b"),
                    "addresses": [1, 2],
                    "models": ["prostar-mppt", "tristar-mppt"],
                },
            ]
        }

        def read_one() -> list[int]:
            with ModbusSerialClient(told["lines"][1]["port"], stopbits=2, timeout=2, retries=0) as client:
                return list(client.read_input_registers(0, count=3, device_id=1).registers)

        registers = await asyncio.to_thread(read_one)
    finally:
        ending = asyncio.create_task(program.wait())
        while not ending.done():  # once or many times, until there is nobody left
            with contextlib.suppress(ProcessLookupError):
                os.kill(program.pid, number)  # asyncio's way of sending may take the status from who waits for it
            await asyncio.wait([ending], timeout=0.001)
        status = ending.result()
    assert status == 0
    summary = (await program.stderr.read()).decode().splitlines()
    assert summary[0].startswith("line=shelter-a requests=0 replies=0 ")
    assert summary[1].startswith("line=shelter-b requests=1 replies=1 bad_frames=0 gap_violations=0 collisions=0 ")
    assert len(set(registers)) == 3
    assert links(tmp_path) == []


async def test_the_table_names_every_port_and_a_command_to_try() -> None:
    program = await asyncio.create_subprocess_exec(
        *SIMULATE, "--lines", "2", "--devices", "3", stdout=asyncio.subprocess.PIPE
    )
    assert program.stdout is not None
    shown = b""
    try:
        while b"Ctrl-C" not in shown:
            line = await asyncio.wait_for(program.stdout.readline(), 20)
            assert line
            shown += line
    finally:
        program.terminate()
        await program.wait()
    text = shown.decode()
    assert "line-1" in text
    assert "line-2" in text
    assert text.count("/dev/pts/") == 3
    assert "1, 2, 3" in text
    assert "Try: mbpoll -m rtu" in text


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--line", "hut=300"], "1 to 247"),
        (["--line", "hut=1", "--lines", "2"], "exclude each other"),
        (["--tcp", "65534", "--lines", "3"], "--tcp 65534 leaves no ports for 3 lines"),
        (["--line", "hut=1", "--line", "hut=2"], "repeat"),
        (["--oracle", "--lines", "16"], "no room"),
        (["--link-dir", "/nonexistent"], "does not exist"),
    ],
)
async def test_wrong_options_are_explained(arguments: list[str], said: str) -> None:
    program = await asyncio.create_subprocess_exec(*SIMULATE, *arguments, stderr=asyncio.subprocess.PIPE)
    _, error = await program.communicate()
    assert program.returncode == 2
    assert said in " ".join(error.decode().replace("│", " ").split())


@pytest.mark.parametrize("options", [(), ("--close-after-reply",)])
async def test_it_serves_its_lines_by_modbus_tcp_where_wanted(options: tuple[str, ...]) -> None:
    program = await asyncio.create_subprocess_exec(
        *SIMULATE,
        *("--tcp", "0", "--json", *options),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    assert program.stdout is not None
    assert program.stderr is not None
    try:
        told = json.loads(await program.stdout.readline())["lines"]
        assert [line["models"] for line in told] == [["prostar-mppt"] * 2, ["prostar-mppt", "tristar-mppt"]]
        port = int(told[1]["port"].removeprefix("tcp://127.0.0.1:"))
        for unit, size in ((1, 82), (2, 0x5C)):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(encode(7, unit, ReadRequest(3, 0, size).encode()))
            reply = await reader.readexactly(9 + 2 * size)
            assert (reply[:2], reply[6], reply[7], reply[8]) == (b"\0\7", unit, 3, 2 * size)
            if options:
                assert await reader.read() == b"", "closed after the reply"
            writer.close()
    finally:
        program.send_signal(signal.SIGTERM)
    said = (await program.stderr.read()).decode()
    assert await program.wait() == 0
    assert "line=shelter-b connections=2 requests=2 replies=2" in said


@pytest.mark.parametrize("options", [("--close-after-reply",), ("--tcp", "0", "--link-dir", ".")])
async def test_options_that_do_not_go_together_are_refused(options: tuple[str, ...]) -> None:
    program = await asyncio.create_subprocess_exec(*SIMULATE, *options, stderr=asyncio.subprocess.PIPE)
    assert await program.wait() == 2
