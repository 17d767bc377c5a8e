"""Writing through the gateway as its user has it: `run` over simulated controllers, mbpoll as the client."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable

import pytest

from gateway.core.write_ledger import Entry, Fate, entries
from gateway.devices.schema import load_map
from gateway.faces.modbus.ledger import read_ledger
from tests.e2e.programs import GATEWAY, Launch, Running, Start, environment, wait_until

pytestmark = pytest.mark.peer

MAP = load_map("prostar-mppt")
ONE_LINE = (("shelter-a", "array-1", 1, 11), ("shelter-a", "array-2", 2, 12))
ON = """
writes = true
eeprom_writes_per_day = 3
write_interval_s = 0.0
"""
RULE = """
[[modbus.write]]
source = ["127.0.0.1/32"]
unit_id = [11]
registers = ["0xE000-0xE00A"]
coils = ["0x0000-0x00FE"]
point = ["battery_target_voltage_slave", "reset_control"]
"""
SETTING_EDIT = next(bit.number for bit in MAP.bit_tables["array_faults"] if bit.name == "eeprom_edited")


class Site:
    """A gateway that lets mbpoll write to unit 11."""

    def __init__(self, running: Running, mbpoll: str) -> None:
        self.running = running
        self._mbpoll = mbpoll

    def poll(self, unit: int, kind: str, address: int, *values: int, count: int = 1) -> str:
        """What mbpoll says when it reads (no values) or writes."""
        options = ["-m", "tcp", "-p", str(self.running.modbus), "-a", str(unit), "-0", "-1", "-q", "-o", "5"]
        options += ["-t", kind, "-r", str(address)] + ([] if values else ["-c", str(count)])
        done = subprocess.run(
            [self._mbpoll, *options, "127.0.0.1", *map(str, values)],
            capture_output=True,
            text=True,
            check=False,
            env=environment(),
            timeout=30,
        )
        return done.stdout + done.stderr

    def word(self, name: str) -> int | None:
        """The register of a point, read by mbpoll; None when there is no value."""
        text = self.poll(11, "4", MAP.point(name).address)
        return int(text.rpartition("]:")[2].split()[0]) if "]:" in text else None

    def edited(self) -> bool | None:
        """Whether the controller says that a setting was changed; None when it says nothing."""
        faults = self.word("array_faults")
        return None if faults is None else bool(faults >> SETTING_EDIT & 1)

    def ledger(self) -> list[Entry]:
        return entries(read_ledger(self.running.folder / "state"))

    def printed(self) -> str:
        """What `prostar-gateway writes` prints."""
        command = [*GATEWAY, "writes", "-c", str(self.running.folder / "site.toml")]
        return subprocess.run(
            command, capture_output=True, text=True, check=True, env={**environment(), "COLUMNS": "200"}
        ).stdout


MakeSite = Callable[..., Site]


@pytest.fixture
def site(launch: Launch, peer: Callable[[str], str]) -> MakeSite:
    def make(keys: str = ON, rule: str = RULE) -> Site:
        running = launch(simulate=("--line", "shelter-a=1,2"), devices=ONE_LINE, rest=rule, modbus_keys=keys)
        running.wait_online()
        return Site(running, peer("mbpoll"))

    return make


def test_mbpoll_writes_what_a_rule_allows_and_nothing_else(site: MakeSite) -> None:
    it = site()
    voltage = MAP.point("absorption_voltage").address
    assert "Written 1 references" in it.poll(11, "4", voltage, 0x4B64)
    assert it.word("absorption_voltage") == 0x4B64
    wait_until(it.edited, "the fault of a changed setting")

    refused = "failed: Illegal function"
    assert refused in it.poll(12, "4", voltage, 0x4B65), "another controller"
    assert refused in it.poll(11, "4", 0xE00A, 60, 61), "partly inside of the range"
    assert refused in it.poll(11, "0", 0x00FE, 1), "a reset that is not named"
    assert "failed: Illegal data value" in it.poll(11, "4", voltage, 0x7E00), "not a number"
    assert it.word("absorption_voltage") == 0x4B64

    assert "Written 1 references" in it.poll(11, "4", MAP.point("battery_target_voltage_slave").address, 0x4B00)
    assert "Written 2 references" in it.poll(11, "4", 0xE002, 9000, 9001), "function 10"
    assert (it.word("absorption_time"), it.word("absorption_time_low_battery")) == (9000, 9001)
    assert "Written 1 references" in it.poll(11, "0", 0x00FF, 1), "reset: silence is success"
    wait_until(lambda: it.edited() is False, "the controller to come back without the fault", timeout_s=40)

    found = {(entry.intent.point, entry.verdict.fate if entry.verdict else None) for entry in it.ledger()}
    assert ("absorption_voltage", Fate.WRITTEN) in found
    assert ("reset_control", Fate.WRITTEN) in found
    assert {entry.intent.unit_id for entry in it.ledger()} == {11}
    assert "absorption_voltage" in it.printed()
    text = it.running.get("/metrics")[1]
    assert 'prostar_gateway_modbus_writes_total{outcome="written"}' in text
    assert 'prostar_gateway_modbus_requests_refused_total{reason="write_not_allowed"}' in text
    assert it.running.gateway.end() == 0
    log = it.running.gateway.log()
    assert "event=write peer=127.0.0.1 unit=11 point=absorption_voltage registers=0xE000 old=0x" in log


def test_the_budget_of_a_register_survives_a_kill(site: MakeSite, start: Start) -> None:
    it = site()
    address = MAP.point("absorption_time").address
    for value in (1000, 1001):
        assert "Written 1 references" in it.poll(11, "4", address, value)
    it.running.gateway.end(signal.SIGKILL)
    again = start(*GATEWAY, "run", "-c", str(it.running.folder / "site.toml"))
    again.wait_for("device_online .*device=array-1")
    assert "Written 1 references" in it.poll(11, "4", address, 1002)
    assert "failed: Slave device or server is busy" in it.poll(11, "4", address, 1003)
    assert "Written 1 references" in it.poll(11, "4", address, 1002), "it holds that already"
    assert it.word("absorption_time") == 1002
    assert again.end() == 0


def test_without_rules_mbpoll_is_refused_and_the_log_knows_who(site: MakeSite) -> None:
    it = site(keys="", rule="")
    assert "failed: Illegal function" in it.poll(11, "4", 0xE000, 19300)
    assert it.running.gateway.end() == 0
    log = it.running.gateway.log()
    assert "event=write_refused peer=127.0.0.1 unit=11 function=0x06 address=0xe000 reason=writes_disabled" in log
    assert "19300" not in log
    assert not (it.running.folder / "state" / "writes.jsonl").exists()
