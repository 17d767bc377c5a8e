"""What the gateway tells its conditions of itself, and whom it tells of changes."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from gateway.core.conditions import DOWN_S, Watch
from gateway.core.site import Site
from gateway.core.stats import HistoryStats
from gateway.service import conditions as module
from gateway.service.conditions import ConditionKeeper, usable


@dataclass
class Plant:
    """A keeper of a site without lines; time passes in its sleeps."""

    directory: Path
    now: float = 100.0
    reasons: tuple[str, ...] = ()
    history: HistoryStats = field(default_factory=HistoryStats)
    heard: list[tuple[float, list[str]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.keeper = ConditionKeeper(
            Site.of("s", (), ()),
            self,
            not_ready=lambda: self.reasons,
            history=self.history,
            state_dir=self.directory,
            sleep=self.sleep,
        )
        self.keeper.told = self.hear
        self.news: asyncio.Queue[str] = asyncio.Queue()

    def monotonic(self) -> float:
        return self.now

    def wall(self) -> float:
        return 0.0

    async def sleep(self, seconds: float) -> None:
        await asyncio.sleep(0)
        self.now += seconds

    def hear(self, changed: Sequence[Watch], now: float) -> None:
        texts = [f"{watch.condition.name} {watch.state.name}" for watch in changed]
        self.heard.append((now, texts))
        for text in texts:
            self.news.put_nowait(text)

    async def wait_for(self, text: str) -> None:
        async with asyncio.timeout(30):
            while await self.news.get() != text:
                pass

    def raised(self) -> set[str]:
        return {watch.condition.name for watch in self.keeper.conditions.active()}


def test_what_changed_is_told_once(tmp_path: Path) -> None:
    plant = Plant(tmp_path)
    plant.keeper.look()
    plant.keeper.look()
    plant.history.store_up = False
    plant.keeper.look()
    assert plant.heard == [
        (100.0, ["not_ready CLEAR", "history_store_down CLEAR"]),
        (100.0, ["history_store_down RAISED"]),
    ]


def test_a_listener_that_is_closed_for_a_moment_is_no_condition(tmp_path: Path) -> None:
    plant = Plant(tmp_path, reasons=("snmp 127.0.0.1:161 is not open",))
    plant.keeper.look()
    assert plant.raised() == set()
    plant.now += DOWN_S
    plant.keeper.look()
    assert plant.raised() == {"not_ready"}


async def test_it_looks_until_cancelled_and_probes_the_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fine = False
    monkeypatch.setattr(module, "usable", lambda _directory: fine)
    plant = Plant(tmp_path)
    task = asyncio.create_task(plant.keeper.run())
    await plant.wait_for("state_dir_unusable RAISED")
    fine = True
    await plant.wait_for("state_dir_unusable CLEAR")
    task.cancel()
    await asyncio.wait([task])
    assert task.cancelled()


def test_a_directory_that_can_be_made_is_usable(tmp_path: Path) -> None:
    assert usable(tmp_path)
    assert usable(tmp_path / "state" / "gateway")


def test_a_full_or_forbidden_directory_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_path: Path) -> os.statvfs_result:
        return os.statvfs_result((4096, 4096, 1000, 3, 3, 0, 0, 0, 0, 255))

    with monkeypatch.context() as patched:
        patched.setattr(os, "statvfs", full)
        assert not usable(tmp_path)
    monkeypatch.setattr(os, "access", lambda *_: False)  # as on a read-only filesystem, for root too
    assert not usable(tmp_path)


def test_a_disk_that_gives_errors_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_path: Path) -> os.statvfs_result:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "statvfs", broken)
    assert not usable(tmp_path)
