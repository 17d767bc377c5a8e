"""From one configuration to another: which parts stay the same objects."""

from __future__ import annotations

import asyncio
import gc
import socket
import sys
import weakref
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.core.snapshot import DeviceState
from gateway.errors import ConfigError, ListenError
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.secret import Secret
from gateway.history.keeper import HistoryKeeper
from gateway.lines.factory import Line
from gateway.service.config import Config, parse_config
from gateway.service.gateway import Gateway
from gateway.service.logs import Log
from gateway.service.reload import Reloader
from gateway.service.systemd import Systemd

LINE = """
[[line]]
name = "{name}"
port = "/nonexistent/{name}"
[[line.device]]
name = "{name}-1"
address = 1
unit_id = {unit}
model = "prostar-mppt"
"""
A, B = LINE.format(name="a", unit=11), LINE.format(name="b", unit=12)
FACES = '[modbus]\nlisten = ["127.0.0.1:0"]\n[http]\nlisten = ["127.0.0.1:0"]\n'
COMMUNITY = '[snmp]\nlisten = ["127.0.0.1:0"]\n[[snmp.community]]\nname = "public"\nsource = ["127.0.0.0/8"]\n'


class Untouched(Log):
    """The log of the test runner goes on as it is."""

    def __init__(self) -> None:
        """Have no writer."""

    def use(self, level: str, form: str) -> None:
        """See `Log.use`."""


class Site:
    """A folder with the files of a configuration."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def text(self, *parts: str) -> str:
        return f'site = "ridge-07"\nstate_dir = "{self.folder}"\n' + "".join(parts)

    def config(self, *parts: str) -> Config:
        return parse_config(self.text(*parts))

    def receiver(self, port: int, secret: str = "secret-1") -> str:
        (self.folder / secret).write_text(secret)
        return (
            f'[[snmp.notify]]\naddress = "127.0.0.1:{port}"\nkind = "trap"\ncommunity_file = "{self.folder / secret}"\n'
        )

    def user(self, name: str) -> str:
        (self.folder / name).write_text("correct-horse-1")
        files = "".join(f'{kind}_password_file = "{self.folder / name}"\n' for kind in ("auth", "priv"))
        return f'[[snmp.user]]\nname = "{name}"\n{files}'


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


@asynccontextmanager
async def running(config: Config) -> AsyncIterator[Gateway]:
    gateway = Gateway(config, SystemClock())
    stop = asyncio.Event()
    task = asyncio.create_task(gateway.run(stop))
    await gateway.supervisor.settled()
    try:
        yield gateway
    finally:
        stop.set()
        await task


def speaks_v3(agent: SnmpAgent) -> bool:
    return agent._responder.security is not None


async def change(gateway: Gateway, config: Config) -> None:
    await gateway.change(await gateway.plan(config))


async def test_the_same_configuration_changes_no_object(site: Site) -> None:
    config = site.config(A, B, FACES, COMMUNITY)
    async with running(config) as gateway:
        before = (gateway.site, gateway.lines, gateway.listeners, gateway.keepers, gateway.conditions)
        await change(gateway, site.config(A, B, FACES, COMMUNITY))
        assert (gateway.site, gateway.lines, gateway.listeners, gateway.keepers, gateway.conditions) == before
        assert gateway.not_ready() == ()


async def test_to_the_history_it_is_the_same_run(site: Site) -> None:
    def keeper(gateway: Gateway) -> HistoryKeeper:
        (found,) = [each for each in gateway.keepers if isinstance(each, HistoryKeeper)]
        return found

    async with running(site.config(A, FACES)) as gateway:
        before = keeper(gateway)
        await change(gateway, site.config(A, B, FACES))
        assert keeper(gateway) is not before
        assert keeper(gateway)._session is before._session


async def test_a_line_more_keeps_the_others_and_all_listeners(site: Site) -> None:
    async with running(site.config(A, FACES, COMMUNITY)) as gateway:
        line, device, listeners = gateway.lines[0], gateway.site.devices[0], gateway.listeners
        await change(gateway, site.config(B, A, FACES, COMMUNITY))
        assert [one.name for one in gateway.lines] == ["b", "a"]
        assert gateway.lines[1] is line
        assert gateway.site.by_unit[11] is device
        assert line.index == 2
        assert gateway.listeners == listeners
        await change(gateway, site.config(B, FACES, COMMUNITY))
        assert [one.name for one in gateway.lines] == ["b"]
        assert list(gateway.site.by_unit) == [12]
        assert list(gateway.conditions.devices) == [12]


def lines_by_snmp(gateway: Gateway) -> dict[int, bytes]:
    """pgwLineName by index."""
    agent, found = gateway._snmp, {}
    table = next(table for table in agent.layout.tables if table.name == "pgwLine")
    name = next(column.number for column in table.columns if column.name == "pgwLineName")
    for index in range(1, 9):
        oid = (*table.base, 1, name, index)
        cell = agent.tree.get(oid, 0.0)
        if cell is not None:
            found[index] = cell[-1:]
    return found


async def test_a_line_that_stays_has_its_new_index_in_every_table(site: Site) -> None:
    async with running(site.config(A, B, FACES, COMMUNITY)) as gateway:
        for parts, names in (((B,), "b"), ((A, B), "ab"), ((B, A), "ba"), ((A,), "a")):
            await change(gateway, site.config(*parts, FACES, COMMUNITY))
            gateway.conditions.look(10.0)
            codes = {watch.condition.code: watch.line for watch in gateway.conditions.gateway if watch.line is not None}
            assert {1000 + line.index: line for line in gateway.lines} == codes
            assert [codes[1001 + place].name for place in range(len(names))] == list(names)
            assert lines_by_snmp(gateway) == {place: name.encode() for place, name in enumerate(names, 1)}
        assert not gateway.stats.restarts


async def test_nothing_is_kept_of_what_went(site: Site) -> None:
    """Reload upon reload, each with something else, must not fill the memory of a gateway that runs for years."""
    writing = '[[modbus.write]]\nsource = ["127.0.0.1"]\npoint = ["float_voltage"]\n'
    faces = FACES.replace("[http]", f"writes = true\n{writing}[http]")
    port = '[[modbus.listener]]\nline = "{}"\nlisten = ["127.0.0.1:0"]\n'
    receiver = site.receiver(9)
    first = site.config(A, B, port.format("a"), faces, COMMUNITY, receiver)
    others = (
        site.config(B, FACES, COMMUNITY, receiver, site.user("noc")),
        site.config(LINE.format(name="c", unit=11), port.format("c"), faces, COMMUNITY, receiver),
        site.config(LINE.format(name="a", unit=12), faces, COMMUNITY, "[history]\nenabled = false\n"),
        first,
    )
    async with running(first) as gateway:
        gone: list[weakref.ref[Line]] = []  # whose devices know it
        for config in (*others, *others):
            gone += map(weakref.ref, gateway.lines)
            await change(gateway, config)
        tasks = len(asyncio.all_tasks())
        await change(gateway, others[0])
        await change(gateway, first)
        gc.collect()
        left = [line for each in gone if (line := each()) is not None and line not in gateway.lines]
        assert left == []
        assert len(asyncio.all_tasks()) == tasks


async def test_a_plan_that_is_not_carried_out_touches_nothing(site: Site) -> None:
    async with running(site.config(A, FACES, COMMUNITY)) as gateway:
        before = (gateway.site, gateway.lines, gateway.listeners, gateway.keepers, gateway.config)
        await gateway.plan(site.config(B, FACES, COMMUNITY, "[history]\nenabled = false\n"))
        bad = FACES.replace("[http]", f'[http]\nbearer_token_file = "{site.folder}/none"')
        with pytest.raises(ConfigError) as caught:
            await gateway.plan(site.config(B, bad, COMMUNITY, site.user("noc")))
        assert [problem.split(":")[0] for problem in caught.value.problems] == ["http"]
        assert (gateway.site, gateway.lines, gateway.listeners, gateway.keepers, gateway.config) == before


async def test_a_refused_plan_says_nothing_of_what_it_would_have_been(
    site: Site, caplog: pytest.LogCaptureFixture
) -> None:
    async with running(site.config(A, FACES, COMMUNITY, site.user("noc"))) as gateway:
        caplog.set_level("INFO")
        bad = FACES.replace("[http]", f'[http]\nbearer_token_file = "{site.folder}/none"')
        with pytest.raises(ConfigError):
            await gateway.plan(site.config(A, bad, COMMUNITY, site.user("noc"), site.user("admin")))
        assert "event=snmp_v3_on" not in caplog.text
        await change(gateway, site.config(A, FACES, COMMUNITY, site.user("noc"), site.user("admin")))
        assert "event=snmp_v3_on" in caplog.text


async def test_what_is_known_of_a_daily_log_is_never_shown_of_another_device(site: Site) -> None:
    async with running(site.config(A, B, FACES)) as gateway:
        assert gateway._history is not None
        for unit in (11, 12):
            known = gateway._history.devices[unit]
            known.harvests, known.days = 3, 5
        kept = gateway._history.devices[12]
        await change(gateway, site.config(A.replace("a-1", "other"), B, FACES))
        fresh = gateway._history.devices[11]
        assert (fresh.harvests, fresh.days or 0) == (0, 0)
        assert gateway._history.devices[12] is kept
        assert kept.harvests == 3
        await change(gateway, site.config(B.replace("12", "13"), FACES))
        assert list(gateway._history.devices) == [13]


async def test_a_port_that_opens_late_brings_in_no_secret_that_was_not_taken(site: Site) -> None:
    """A token was changed, and the reload was refused for something else: the one in use holds on all ports alike."""
    token = site.folder / "token"
    token.write_text("0123456789abcdef")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        ports = f'["127.0.0.1:0", "127.0.0.1:{taken.getsockname()[1]}"]'
        http = f'[http]\nlisten = {ports}\nbearer_token_file = "{token}"\n'
        gateway = Gateway(site.config(A, http), SystemClock())
        first, second = gateway._http.listeners
        with pytest.raises(ListenError):
            await second.start()
        await first.start()
        access = gateway._http.access
        token.write_text("fedcba9876543210")
    await second.start()
    assert gateway._http.access is access
    await first.stop()
    await second.stop()
    await first.start()
    assert gateway._http.access is not access
    await first.stop()


async def test_an_engine_that_starts_while_another_agent_is_made_starts_once(site: Site) -> None:
    """A second start would leave the traps of the first one outside of everybody's time window."""
    async with running(site.config(A, FACES, COMMUNITY)) as gateway:
        plan = await gateway.plan(site.config(A, FACES, COMMUNITY, site.user("noc")))
        engine = gateway._snmp.engine()
        await gateway.change(plan)
        assert gateway._snmp.engine() is engine
        assert speaks_v3(gateway._snmp)


async def test_the_log_table_is_not_empty_for_a_while_when_users_are_others(site: Site) -> None:
    async with running(site.config(A, FACES, COMMUNITY)) as gateway:
        days = gateway._days
        assert days is not None
        await change(gateway, site.config(A, FACES, COMMUNITY, site.user("noc")))
        assert gateway._days is days
        assert days in gateway.keepers
        await change(gateway, site.config(A, B, FACES, COMMUNITY))
        assert gateway._days is not days


async def test_snmpv3_comes_with_its_first_user_and_goes_with_its_last(site: Site) -> None:
    async with running(site.config(A, FACES, COMMUNITY)) as gateway:
        agent = gateway._snmp
        assert not speaks_v3(agent)
        await change(gateway, site.config(A, FACES, COMMUNITY, site.user("noc")))
        assert speaks_v3(agent)
        engine = agent.engine()
        await change(gateway, site.config(A, FACES, COMMUNITY, site.user("noc"), site.user("admin")))
        assert agent.engine() is engine
        await change(gateway, site.config(A, FACES, COMMUNITY))
        assert not speaks_v3(agent)


async def test_a_receiver_that_stays_is_told_what_was_left_and_a_new_one_what_is_raised(site: Site) -> None:
    first, second = site.receiver(9), site.receiver(10, "secret-2")
    async with running(site.config(A, FACES, COMMUNITY, first)) as gateway:
        (post,) = gateway._snmp.notifier._posts
        await change(gateway, site.config(A, B, FACES, COMMUNITY, first))
        assert gateway._snmp.notifier._posts == [post]
        await change(gateway, site.config(A, B, FACES, COMMUNITY, second, first))
        new, old = gateway._snmp.notifier._posts
        assert old is post
        assert [stats.receiver for stats in gateway._snmp.notifier.stats] == ["127.0.0.1:10", "127.0.0.1:9"]
        assert gateway._snmp.notifier in gateway.keepers
        assert new is not post
        await change(gateway, site.config(A, B, FACES, COMMUNITY))
        assert gateway._snmp.notifier not in gateway.keepers


async def test_a_receiver_with_another_secret_is_the_same_and_is_told_what_is_clear_by_now(site: Site) -> None:
    async with running(site.config(A, FACES, COMMUNITY, site.receiver(9))) as gateway:
        (post,) = gateway._snmp.notifier._posts
        stats = post.delivery.stats
        known = post.delivery._announcer._told
        device = gateway.site.by_unit[11]
        device.snapshot = replace(device.snapshot, state=DeviceState.OFFLINE)
        gateway._watching.look()
        assert (11, 401) in known
        secret = site.receiver(9, "secret-2").replace("[[snmp.notify]]", "[[snmp.notify]]\nper_minute = 7")
        await change(gateway, site.config(A, FACES, COMMUNITY, secret))
        assert gateway._snmp.notifier._posts == [post]
        assert post.receiver.per_minute == 7
        assert post.receiver.community == Secret(b"secret-2")
        assert gateway._snmp.notifier.stats == (stats,)
        assert gateway._snmp.notifier in gateway.keepers
        assert (11, 401) in post.delivery._announcer._told
        informs = secret.replace('"trap"', '"inform"')
        await change(gateway, site.config(A, FACES, COMMUNITY, informs))
        assert post not in gateway._snmp.notifier._posts


async def test_a_receiver_that_was_told_of_a_device_is_told_of_it_when_its_line_is_a_new_one(site: Site) -> None:
    receiver = site.receiver(9)
    async with running(site.config(A, FACES, COMMUNITY, receiver)) as gateway:
        device = gateway.site.by_unit[11]
        device.snapshot = replace(device.snapshot, state=DeviceState.OFFLINE)
        gateway._watching.look()
        (post,) = gateway._snmp.notifier._posts
        told = post.delivery._announcer._told
        assert told[11, 401].watch is gateway.conditions.at(11, 401)
        await change(gateway, site.config(A.replace("address = 1", "address = 2"), FACES, COMMUNITY, receiver))
        told = post.delivery._announcer._told
        assert told[11, 401].watch is gateway.conditions.at(11, 401)
        await change(gateway, site.config(B, FACES, COMMUNITY, receiver))
        assert (11, 401) not in post.delivery._announcer._told


async def test_a_mistake_in_the_middle_of_a_change_ends_the_process_for_a_new_start(
    site: Site, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = site.folder / "site.toml"
    path.write_text(site.text(A, FACES))
    gateway = Gateway(site.config(A, FACES), SystemClock())
    reloader = Reloader(path, gateway, SystemClock(), Systemd({}), Untouched())
    gateway.keep(reloader)

    def fail(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(gateway._modbus, "adjust", fail)
    reloader.wanted()
    await gateway.run(asyncio.Event())
    assert gateway.supervisor.beyond_help == "reload"
    assert 'event=task_failed task="reload"' in caplog.text


async def test_what_a_reload_made_is_set_aside_from_the_collector(site: Site) -> None:
    path = site.folder / "site.toml"
    path.write_text(site.text(A, B, FACES))
    async with running(site.config(A, FACES)) as gateway:
        gc.unfreeze()
        await Reloader(path, gateway, SystemClock(), Systemd({}), Untouched())._reload(0.0)
        assert list(gateway.site.by_unit) == [11, 12]
        assert gc.get_freeze_count() > 10_000
        gc.unfreeze()


async def test_without_a_process_that_reads_the_reload_is_refused_and_nothing_else(
    site: Site, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = site.folder / "site.toml"
    path.write_text(site.text(A, B, FACES))
    async with running(site.config(A, FACES)) as gateway:
        reloader = Reloader(path, gateway, SystemClock(), Systemd({}), Untouched())
        with monkeypatch.context() as patch:
            patch.setattr(sys, "executable", "/nothing/here")
            await reloader._reload(0.0)
        assert list(gateway.site.by_unit) == [11]
        assert gateway.stats.reloads == {"refused": 1}
        assert "no process can be started to read it: No such file or directory" in caplog.text
        await reloader._reload(0.0)
        assert list(gateway.site.by_unit) == [11, 12]
