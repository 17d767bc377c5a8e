"""Traps and informs to a real snmptrapd of net-snmp: v2c and v3, after restarts, and while nobody listens."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.core.conditions import Conditions
from gateway.core.site import Device, LineState, Site
from gateway.core.snapshot import DeviceState
from gateway.core.stats import ModbusServerStats
from gateway.devices.model import DeviceMap
from gateway.faces.snmp import notifier
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.notifier import Notifier
from gateway.faces.snmp.secret import Secret
from gateway.faces.snmp.settings import Receiver, SnmpSettings
from tests.faces.snmp.poller import a_user, credentials
from tests.faces.snmp.stub_site import StubLine, online, run_tool
from tests.faces.snmp.trapd import COMMUNITY, Trapd, trapd, user

pytestmark = pytest.mark.peer

COLD_START = "snmpModules.1.1.5.1"
WAYS = [("trap", "v2c"), ("inform", "v2c"), ("trap", "v3"), ("inform", "v3")]
QUIET = {"array_faults": 0, "load_faults": 0, "alarms": 0, "load_state": 1, "battery_voltage": 12.125}


class Gateway:
    """An agent with one device and its receivers; its time is the machine's."""

    def __init__(self, device_map: DeviceMap, receivers: tuple[Receiver, ...], state_dir: Path) -> None:
        self.clock = SystemClock()
        self.line = StubLine("shelter-a", 1, "/dev/ttyA")
        self.device = Device("array-1", 11, 1, device_map)
        self.device.line = self.line
        site = Site.of("ridge-07", (self.line,), [self.device])
        self.conditions = Conditions(site, (), self.clock.monotonic())
        settings = SnmpSettings(
            listen=(("127.0.0.1", 0),),
            users=(a_user(),),
            receivers=receivers,
            state_dir=state_dir,
            authentication_traps=True,
        )
        self.agent = SnmpAgent(settings, site, self.clock, ModbusServerStats(), conditions=self.conditions)
        self.stats = self.agent.notifier.stats[0]
        self.shown = online(device_map, 11, self.clock.monotonic())

    def look(self) -> None:
        now = self.clock.monotonic()
        self.conditions.look(now)
        self.agent.notifier.changed(self.conditions.take(), now)

    def shows(self, **values: float) -> None:
        self.device.snapshot = replace(self.shown, values={**QUIET, **values})
        self.look()

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        task = asyncio.create_task(self.agent.notifier.run())
        try:
            yield
        finally:
            task.cancel()
            await asyncio.wait([task])


def receiver(kind: str, version: str, port: int) -> Receiver:
    return Receiver(
        "127.0.0.1",
        port,
        inform=kind == "inform",
        community=Secret(b"public") if version == "v2c" else None,
        credentials=credentials() if version == "v3" else None,
        hold_s=0.0,
    )


def configuration(gateway: Gateway, kind: str, version: str) -> str:
    if version == "v2c":
        return COMMUNITY
    return user(gateway.agent.engine().engine_id if kind == "trap" else None)


class Scene:
    """A gateway and where its receiver will be; `gateway` again is the same one after a restart."""

    def __init__(self, device_map: DeviceMap, peer: Callable[[str], str], mib_path: str, folder: Path) -> None:
        self.device_map, self.peer, self.mib_path, self.folder = device_map, peer, mib_path, folder
        self.port = 0
        self.way = ("trap", "v2c")
        (folder / "trapd").mkdir()

    def gateway(self) -> Gateway:
        return Gateway(self.device_map, (receiver(*self.way, self.port),), self.folder / "state")

    def trapd(self, configured: str) -> AbstractAsyncContextManager[Trapd]:
        return trapd(self.peer, self.folder / "trapd", self.mib_path, self.port, configured)


@pytest.fixture
def scene(
    device_map: DeviceMap, peer: Callable[[str], str], mib_path: str, free_udp_port: Callable[[], int], tmp_path: Path
) -> Scene:
    made = Scene(device_map, peer, mib_path, tmp_path)
    made.port = free_udp_port()
    return made


async def until(holds: Callable[[], object]) -> None:
    async with asyncio.timeout(30):
        while not holds():  # noqa: ASYNC110 - what a datagram changes sets no event
            await asyncio.sleep(0.01)


@pytest.mark.parametrize(("kind", "version"), WAYS)
async def test_it_is_received_with_everything_that_the_mib_says(
    scene: Scene,
    kind: str,
    version: str,
) -> None:
    scene.way = (kind, version)
    gateway = scene.gateway()
    configured = configuration(gateway, kind, version)
    async with scene.trapd(configured) as there, gateway.running():
        assert (await there.next()).name == COLD_START
        gateway.shows(array_faults=1 << 3)
        got = await there.next()
        assert got.name == "pgwConditionRaised"
        assert got.names[2:] == (
            "pgwNotifySequence.0",
            "pgwNotifyCause.0",
            "pgwSiteName.0",
            "pgwNotifySubject.0",
            "pgwConditionName.11.103",
            "pgwConditionText.11.103",
            "pgwConditionSeverity.11.103",
            "pgwConditionState.11.103",
            "pgwNotifyBatteryVoltage.0",
        )
        assert [got.objects[name.partition(".")[0]] for name in got.names[2:]] == [
            "Gauge32: 2",
            "INTEGER: summary(2)",
            "STRING: ridge-07",
            "STRING: array-1",
            "STRING: array_fault_battery_hvd",
            "STRING: battery high-voltage disconnect",
            "INTEGER: critical(3)",
            "INTEGER: raised(2)",
            "INTEGER: 12125 millivolts",
        ]
        gateway.shows()
        got = await there.next()
        assert (got.name, got.objects["pgwConditionState"]) == ("pgwConditionCleared", "INTEGER: clear(1)")
        assert got.objects["pgwNotifyCause"] == "INTEGER: event(1)"
        if kind == "inform":
            await until(lambda: gateway.stats.acknowledged == 3)


@pytest.mark.parametrize(("kind", "version"), WAYS)
async def test_it_is_received_after_both_sides_were_started_again(
    scene: Scene,
    kind: str,
    version: str,
) -> None:
    scene.way = (kind, version)
    gateway = scene.gateway()
    assert gateway.agent.engine().boots == 1
    configured = configuration(gateway, kind, version)
    async with scene.trapd(configured) as there:
        async with gateway.running():
            assert (await there.next()).name == COLD_START
        again = scene.gateway()
        assert again.agent.engine().engine_id == gateway.agent.engine().engine_id
        assert again.agent.engine().boots == 2
        async with again.running():
            got = await there.next()
            assert (got.name, got.objects["pgwNotifySequence"]) == (COLD_START, "Gauge32: 1")
            if kind == "inform":
                await until(lambda: again.stats.acknowledged)
            there.process.terminate()
            await there.process.wait()
            async with scene.trapd(configured) as later:
                again.shows(load_state=3)
                got = await later.next()
                assert (got.name, got.objects["pgwNotifySequence"]) == ("pgwLoadDisconnect", "Gauge32: 2")


async def test_devices_lines_and_loads_have_notifications_of_their_own(
    scene: Scene,
) -> None:
    scene.way = ("trap", "v2c")
    gateway = scene.gateway()

    async def heard(there: Trapd) -> tuple[str, str]:
        got = await there.next()
        return got.name, got.objects["pgwNotifySubject"]

    async with scene.trapd(COMMUNITY) as there, gateway.running():
        await there.next()
        gateway.shows()
        gateway.device.snapshot = replace(gateway.device.snapshot, state=DeviceState.OFFLINE)
        gateway.look()
        assert await heard(there) == ("pgwDeviceOffline", "STRING: array-1")
        gateway.shows()
        assert await heard(there) == ("pgwDeviceOnline", "STRING: array-1")
        gateway.shows(load_state=4)
        assert await heard(there) == ("pgwLoadDisconnect", "STRING: array-1")
        gateway.shows(load_state=7)
        assert await heard(there) == ("pgwLoadReconnect", "STRING: array-1")
        gateway.line.state = LineState.DOWN
        gateway.conditions.look(gateway.clock.monotonic() + 1e6)
        gateway.agent.notifier.changed(gateway.conditions.take(), gateway.clock.monotonic())
        assert await heard(there) == ("pgwLineDown", "STRING: shelter-a")
        gateway.line.state = LineState.OPEN
        gateway.look()
        assert await heard(there) == ("pgwLineUp", "STRING: shelter-a")


async def test_a_wrong_pass_phrase_at_the_agent_is_told(
    scene: Scene,
) -> None:
    scene.way = ("trap", "v2c")
    gateway = scene.gateway()
    listener = gateway.agent.listeners[0]
    await listener.start()
    assert listener.bound is not None
    try:
        async with scene.trapd(COMMUNITY) as there, gateway.running():
            assert (await there.next()).name == COLD_START
            wrong = ("-v3", "-u", "noc", "-l", "authPriv", "-a", "SHA-256", "-A", "not the phrase", "-x", "AES")
            at = f"udp:127.0.0.1:{listener.bound[1]}"
            code, _ = await run_tool(
                scene.peer("snmpget"), *wrong, "-X", "not the phrase", "-t1", "-r0", at, "1.3.6.1.2.1.1.1.0"
            )
            assert code != 0
            got = await there.next()
            assert got.name == "snmpModules.1.1.5.5"
            assert got.objects["pgwSiteName"] == "STRING: ridge-07"
    finally:
        await listener.stop()


@pytest.mark.parametrize("version", ["v2c", "v3"])
async def test_informs_wait_for_a_receiver_that_comes_later(
    scene: Scene,
    version: str,
) -> None:
    scene.way = ("inform", version)
    gateway = scene.gateway()
    async with gateway.running():
        gateway.shows(array_faults=1, alarms=1 << 17)
        await until(lambda: gateway.stats.sent)
        async with scene.trapd(configuration(gateway, "inform", version)) as there:
            names = [(await there.next()).name for _ in range(3)]
            assert names == [COLD_START, "pgwConditionRaised", "pgwConditionRaised"]


async def test_a_receiver_that_does_not_know_the_user_is_named(
    scene: Scene,
    caplog: pytest.LogCaptureFixture,
) -> None:
    scene.way = ("inform", "v3")
    gateway = scene.gateway()
    async with scene.trapd(COMMUNITY), gateway.running():
        await until(lambda: gateway.stats.refused)
    assert set(gateway.stats.refused) == {"user"}
    assert f'event=notify_refused receiver=127.0.0.1:{scene.port} reason="user"' in caplog.text
    assert gateway.stats.acknowledged == 0


async def test_a_receiver_that_comes_later_is_not_told_that_the_gateway_started(scene: Scene) -> None:
    gateway = scene.gateway()
    ours = gateway.agent
    async with scene.trapd(COMMUNITY) as there:
        later = Notifier(
            (receiver("inform", "v2c", scene.port),),
            ours.layout,
            site="ridge-07",
            clock=gateway.clock,
            engine=ours.engine,
            ticks=lambda at: int(at * 100),
            before=ours.notifier,
        )
        task = asyncio.create_task(later.run())
        gateway.shows(array_faults=1)
        later.changed(tuple(gateway.conditions.active()), gateway.clock.monotonic())
        got = await there.next()
        assert (got.name, got.objects["pgwNotifySequence"]) == ("pgwConditionRaised", "Gauge32: 1")
        task.cancel()
        await asyncio.wait([task])


async def test_an_address_that_cannot_be_reached_is_tried_until_it_can(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    way = notifier._Post._open
    failures = 2

    def opened(post: notifier._Post) -> socket.socket:
        nonlocal failures
        failures -= 1
        if failures >= 0:
            raise OSError(101, "Network is unreachable")
        return way(post)

    monkeypatch.setattr(notifier._Post, "_open", opened)
    monkeypatch.setattr(notifier, "OPEN_AGAIN_S", 0.01)
    gateway = scene.gateway()
    async with scene.trapd(COMMUNITY) as there, gateway.running():
        assert (await there.next()).name == COLD_START
    assert caplog.text.count('reason="Network is unreachable"') == 1
    assert gateway.stats.failures == 0
