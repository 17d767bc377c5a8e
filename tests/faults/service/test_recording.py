"""A line of a running gateway is traced and recorded while it works, and the recording is a line again."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path

from gateway.devices.schema import load_map
from gateway.modbus.recording import Recording
from gateway.simulator.device import SimulatedController
from gateway.simulator.tcp import TcpServer
from gateway.simulator.upstream import Habits, SimulatedServer
from tests.e2e.programs import GATEWAY, REPOSITORY, Program
from tests.faults.service.rig import Service, client, until

FAST = "[poll]\nlive_s = 0.2\n"


async def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run one of our commands to its end."""
    return await asyncio.to_thread(
        subprocess.run, [*GATEWAY, *arguments], capture_output=True, text=True, cwd=REPOSITORY, check=False
    )


async def test_a_recording_replays_into_a_gateway(service: Service, tmp_path: Path) -> None:
    service.configure(devices=(("shelter-a", "array-1", 1, 11), ("shelter-a", "array-2", 2, 12)), rest=FAST)
    recording = tmp_path / "line.rec"
    service.start()
    await service.online()
    # From the start of the line on, so that a gateway finds the answers to its first questions too.
    record = Program([*GATEWAY, "record", "-c", str(service.config), "shelter-a", str(recording), "--seconds", "60"])
    service.programs.insert(0, record)
    await service.log("event=trace line=shelter-a state=on")
    service.lines["shelter-a"].replug()
    await service.log("event=line_up")
    await service.online()
    async with client(service.modbus) as asker:
        before = [await asker.read(unit) for unit in (11, 12)]
    await until(lambda: recording.stat().st_size > 0)
    await asyncio.sleep(1.0)
    assert await asyncio.to_thread(record.end) == 0
    await service.log("event=trace line=shelter-a state=off .*lost=0")
    assert await service.end() == 0
    with recording.open() as lines:
        parsed = Recording.parse(lines)
    assert parsed.about["line"] == "shelter-a"
    assert {piece.sent for piece in parsed.pieces} == {True, False}

    service.lines["shelter-a"].close()
    link = str(service.folder / "shelter-a")
    replay = Program([*GATEWAY, "replay", str(recording), "--link", link])
    service.programs.insert(0, replay)
    await until((service.folder / "shelter-a").is_symlink)
    service.start()
    await service.online()
    async with client(service.modbus) as asker:
        assert [await asker.read(unit) for unit in (11, 12)] == before
    assert await service.end() == 0
    assert await asyncio.to_thread(replay.end) == 0
    assert "unknown=0" in replay.log()


async def test_an_upstream_is_recorded_and_replayed_too(
    service: Service, tmp_path: Path, free_tcp_port: Callable[[], int]
) -> None:
    units = [SimulatedController(load_map("tristar-mppt"), address=k) for k in (1, 2)]
    config, recording = tmp_path / "upstream.toml", tmp_path / "upstream.rec"
    text = f'site = "s"\nstate_dir = "{tmp_path}"\n{FAST}[modbus]\nlisten = []\n[snmp]\nlisten = []\n'
    text += '[http]\nlisten = []\n[history]\nenabled = false\n[[line]]\nname = "far"\nport = "tcp://127.0.0.1:PORT"\n'
    for k in (1, 2):
        text += f'[[line.device]]\nname = "t-{k}"\naddress = {k}\nunit_id = {k}\nmodel = "tristar-mppt"\n'
    simulated = SimulatedServer(units, habits=Habits(closes=True))
    simulated.refusing = True  # so that the recording has the first questions too
    async with TcpServer(simulated) as server:
        config.write_text(text.replace("PORT", str(server.port)))
        gateway = Program([*GATEWAY, "run", "-c", str(config)])
        service.programs.append(gateway)
        await until((tmp_path / "trace").exists)
        record = Program([*GATEWAY, "record", "-c", str(config), "far", str(recording), "--seconds", "60"])
        service.programs.append(record)
        await until(lambda: "event=trace line=far state=on" in gateway.log())
        simulated.refusing = False
        await until(
            lambda: gateway.log().count("event=device_online") == 2, 130.0
        )  # a silent one is asked once a minute
        traced = await command("trace", "-c", str(config), "far", "--seconds", "1")
        assert traced.stdout.startswith("far at tcp://127.0.0.1:")
        assert " closed\n" in traced.stdout
        assert await asyncio.to_thread(record.end) == 0
        assert await asyncio.to_thread(gateway.end) == 0

    port = str(free_tcp_port())
    replay = Program([*GATEWAY, "replay", str(recording), "--port", port])
    service.programs.append(replay)
    config.write_text(text.replace("PORT", port))
    gateway = Program([*GATEWAY, "run", "-c", str(config)])
    service.programs.append(gateway)
    await until(lambda: gateway.log().count("event=device_online") == 2, 130.0)  # a silent one is asked once a minute
    assert await asyncio.to_thread(gateway.end) == 0
    assert await asyncio.to_thread(replay.end) == 0
    assert "unknown=0" in replay.log()
    assert (await command("replay", str(recording), "--link", str(tmp_path / "link"))).returncode == 1


async def test_tracing_ends_with_who_asked_and_is_for_nobody_else(service: Service) -> None:
    service.configure(rest=FAST)
    service.start()
    await service.online()
    path = service.folder / "state" / "trace"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    traced = await command("trace", "-c", str(service.config), "shelter-a", "--seconds", "1")
    head, *lines = traced.stdout.splitlines()
    assert head.startswith("shelter-a at ")
    assert any(" > 01 " in line for line in lines)
    assert any(" < 01 " in line for line in lines)
    await service.log("event=trace line=shelter-a state=off")
    unknown = await command("trace", "-c", str(service.config), "elsewhere")
    assert unknown.returncode == 1
    assert unknown.stderr == 'there is no line "elsewhere"; there are: shelter-a\n'
    for nonsense in (b"", b"\n", b"[" * 900 + b"\n", b"\xff\n", b'{"a": 1}\n', b"x" * 5000):
        with socket.socket(socket.AF_UNIX) as sock:
            sock.connect(str(path))
            sock.sendall(nonsense)
            sock.shutdown(socket.SHUT_WR)
            sock.settimeout(5)
            reply = await asyncio.to_thread(sock.recv, 4096)
            assert reply == b"" or b'"error"' in reply
    assert await service.end() == 0
    assert not path.exists()
    assert "Traceback" not in service.programs[-1].log()
    gone = await command("trace", "-c", str(service.config), "shelter-a")
    assert gone.returncode == 1
    assert "the gateway cannot be asked" in gone.stderr


async def test_who_does_not_read_disturbs_nobody_and_a_fifth_is_refused(service: Service) -> None:
    """What becomes of what is not read: tests/service/test_tracing.py."""
    service.configure(rest=FAST)
    service.start()
    await service.online()
    watchers = []
    for number in range(5):
        sock = socket.socket(socket.AF_UNIX)
        sock.settimeout(30)
        sock.connect(str(service.folder / "state" / "trace"))
        watchers.append(sock)
        with contextlib.suppress(BrokenPipeError):  # the fifth may be refused before it has said what it wants
            sock.sendall(b'"shelter-a"\n')
        answer = await asyncio.to_thread(sock.recv, 4096)
        assert answer.startswith(b'{"error": "4 are watching already"}' if number == 4 else b'{"format": ')
    async with client(service.modbus) as asker:
        for _ in range(50):
            assert (await asker.read(11))[:2] == b"\x03\x04"
    assert await service.end() == 0
    for sock in watchers:
        sock.close()


async def test_a_file_that_is_there_and_one_that_is_none_are_refused(service: Service, tmp_path: Path) -> None:
    service.configure(rest=FAST)
    service.start()
    await service.online()
    there = tmp_path / "there"
    there.write_text("mine")
    refused = await command("record", "-c", str(service.config), "shelter-a", str(there))
    assert (refused.returncode, refused.stderr) == (1, f"{there} is there already\n")
    assert there.read_text() == "mine"
    small = tmp_path / "small"
    done = await command("record", "-c", str(service.config), "shelter-a", str(small), "--most-kib", "2")
    assert done.returncode == 0
    assert small.stat().st_size <= 2048
    with small.open() as lines:
        assert Recording.parse(lines).pieces
    refused = await command("replay", str(there))
    assert refused.returncode == 1
    assert "line 1: " in refused.stderr
    assert await service.end() == 0
