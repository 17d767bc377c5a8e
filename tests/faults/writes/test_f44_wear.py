"""F44: the same EEPROM register written again and again: a budget for each register, 06 beyond it.

The budget is for 24 hours, and so for every hour of them: what a day may cost, no single hour of it can exceed.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from gateway.core.write_ledger import Fate
from gateway.core.write_wear import WearLimits
from gateway.faces.modbus.settings import RateSettings
from tests.faces.modbus.writing import WALL_OFFSET_S, writing


async def test_a_value_that_is_there_already_costs_the_eeprom_nothing(tmp_path: Path) -> None:
    async with writing(tmp_path) as it:
        for _ in range(100):
            assert await it.query("06 e000 4b64") == "06e0004b64"
        assert len(it.line.writes) == 1
        assert it.stats.writes == {"written": 1, "unchanged": 99}
        await it.until(lambda: it.fates() == [Fate.WRITTEN])


async def test_values_that_change_have_a_budget_for_each_register(tmp_path: Path) -> None:
    async with writing(tmp_path, per_day=10) as it:
        replies = [await it.query(f"06 e000 {0x4B00 + at % 2:04x}") for at in range(100)]
        assert sum(reply[:2] == "06" for reply in replies) >= 10
        assert len(it.line.writes) == 10
        assert set(replies[20:]) == {"8606", "06e0004b01"}, "what it holds already is still a success"
        assert it.stats.refused == {"write_budget_spent": sum(reply == "8606" for reply in replies)}
        assert await it.query("06 e001 4b10") == "06e0014b10", "another register has its own"
        it.clock.now += 86_400
        assert await it.query("06 e000 4b02") == "06e0004b02"


async def test_a_day_of_a_hundred_writes_a_second_costs_ten_as_the_gateway_is_by_default(tmp_path: Path) -> None:
    limits = WearLimits()
    async with writing(tmp_path, per_day=limits.per_day, interval_s=limits.interval_s) as it:
        written_at: list[float] = []
        for hour in range(24):  # a quarter of a second of each as fast as that
            for at in range(25):
                before = len(it.line.writes)
                reply = await it.query(f"06 e000 {0x4B00 + (25 * hour + at) % 0xFF:04x}")
                assert reply == "8606" or reply.startswith("06e000")
                written_at += [it.clock.now] * (len(it.line.writes) - before)
                it.clock.now += 0.01
            it.clock.now += 3599.0
        assert len(written_at) == limits.per_day == 10
        assert all(later - earlier >= limits.interval_s for earlier, later in pairwise(written_at))
        assert set(it.stats.refused) == {"write_too_soon", "write_budget_spent"}


async def test_the_budget_survives_a_restart_and_wrong_clocks(tmp_path: Path) -> None:
    async with writing(tmp_path, per_day=2) as it:
        line = it.line
        assert await it.query("06 e000 4b01") == "06e0004b01"
        assert await it.query("06 e000 4b02") == "06e0004b02"
    for wall_offset_s in (WALL_OFFSET_S + 3600, WALL_OFFSET_S - 10 * 86_400):
        async with writing(tmp_path, per_day=2, line=line, wall_offset_s=wall_offset_s) as it:
            assert await it.query("06 e000 4b03") == "8606"
    async with writing(tmp_path, per_day=2, line=line, wall_offset_s=WALL_OFFSET_S + 2 * 86_400) as it:
        assert await it.query("06 e000 4b03") == "06e0004b03"
        it.clock.wall_offset_s += 365 * 86_400  # a step while it runs changes nothing
        assert await it.query("06 e000 4b04") == "06e0004b04"
        assert await it.query("06 e000 4b05") == "8606"


async def test_ram_and_coils_have_an_interval(tmp_path: Path) -> None:
    async with writing(tmp_path, interval_s=1.0) as it:
        replies = [await it.query(f"05 0001 {'ff00' if at % 2 else '0000'}") for at in range(20)]
        assert replies[0] == "0500010000"
        assert set(replies[1:]) == {"8506"}
        assert len(it.line.writes) == 1
        it.clock.now += 1.0
        assert await it.query("05 0001 ff00") == "050001ff00"


async def test_slave_control_is_free_of_all_of_it(tmp_path: Path) -> None:
    async with writing(tmp_path, interval_s=3600.0, per_day=1, rate=RateSettings()) as it:
        for _ in range(300):
            assert await it.query("06 0025 4b00") == "0600254b00"
        assert len(it.line.sent) == 300, "neither compared nor read back"
        for at in range(300):  # what is not slave control has its rate
            if await it.query(f"04 {at % 80:04x} 0001") == "8406":
                break
        else:
            pytest.fail("no limit was met")
        assert await it.query("06 0025 4b00") == "0600254b00"
