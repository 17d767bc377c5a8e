"""What the gateway tells its conditions of itself, and whom it tells of changes."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from gateway.core.conditions import DOWN_S, Watch
from gateway.core.site import Site
from gateway.core.stats import HistoryStats
from gateway.service import conditions as module
from gateway.service.conditions import ConditionKeeper, why_unusable


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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    reason = 'the "disk" is full'
    monkeypatch.setattr(module, "why_unusable", lambda _directory: reason)
    plant = Plant(tmp_path)
    task = asyncio.create_task(plant.keeper.run())
    await plant.wait_for("state_dir_unusable RAISED")
    reason = ""
    await plant.wait_for("state_dir_unusable CLEAR")
    task.cancel()
    await asyncio.wait([task])
    assert task.cancelled()
    said = [record.getMessage() for record in caplog.records if "event=state_dir" in record.getMessage()]
    assert said[0] == """event=state_dir_unusable reason="the 'disk' is full\""""
    assert [text.partition("=")[2].split("=")[0] for text in said[1:]] == ["state_dir_usable lasted_s"]


def test_a_directory_that_can_be_made_is_usable(tmp_path: Path) -> None:
    assert why_unusable(tmp_path) == ""
    assert why_unusable(tmp_path / "state" / "gateway") == ""


def on_a_disk(monkeypatch: pytest.MonkeyPatch, free: int, flags: int) -> None:
    result = os.statvfs_result((4096, 4096, 1000, free, free, 0, 0, 0, flags, 255))
    monkeypatch.setattr(os, "statvfs", lambda _path: result)


def test_why_it_is_not_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        on_a_disk(patched, free=3, flags=0)
        assert why_unusable(tmp_path) == f"{tmp_path}: less than 1 MiB is free"
        on_a_disk(patched, free=1000, flags=os.ST_RDONLY)
        assert why_unusable(tmp_path) == f"{tmp_path}: is on a read-only file system"
    monkeypatch.setattr(os, "access", lambda *_: False)
    mine = os.geteuid()
    assert why_unusable(tmp_path) == f"{tmp_path}: belongs to uid {mine}, and uid {mine} may not write there"


def test_a_disk_that_gives_errors_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_path: Path) -> os.statvfs_result:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "statvfs", broken)
    assert why_unusable(tmp_path) == f"{tmp_path}: Input/output error"
