"""Fixtures for tests: `pytest_plugins = ["gateway.simulator.plugin"]` in the root conftest.py.

The only module of the simulator that knows pytest; the product never imports it.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AsyncExitStack
from pathlib import Path

import pytest
import pytest_asyncio

from gateway.devices.model import DeviceMap
from gateway.devices.schema import load_map
from gateway.simulator.device import SimulatedController
from gateway.simulator.layout import DEMO_LAYOUT, Behaviour, LinePlan, SimulatedSite
from gateway.simulator.line import SimulatedLine
from gateway.simulator.oracle import OracleController
from gateway.simulator.pty import PtyLine

OpenSite = Callable[..., SimulatedSite]


@pytest.fixture(scope="session")
def prostar_map() -> DeviceMap:
    """The ProStar MPPT map."""
    return load_map("prostar-mppt")


@pytest.fixture
def controller(prostar_map: DeviceMap) -> SimulatedController:
    """A simulated controller at address 1, at nine in the morning."""
    return SimulatedController(prostar_map)


@pytest.fixture
def oracles(prostar_map: DeviceMap) -> tuple[OracleController, ...]:
    """Three oracle controllers whose registers all differ, at addresses 1, 2 and 3."""
    return tuple(OracleController(prostar_map, device=k, address=k + 1) for k in range(3))


@pytest.fixture
def simulated_line(controller: SimulatedController) -> SimulatedLine:
    """A line in virtual time with `controller` on it."""
    return SimulatedLine([controller])


@pytest_asyncio.fixture
async def pty_line(simulated_line: SimulatedLine, tmp_path: Path) -> AsyncIterator[PtyLine]:
    """`simulated_line` as a real serial port with a stable path."""
    async with PtyLine(simulated_line, link=tmp_path / "line") as line:
        yield line


@pytest_asyncio.fixture
async def open_site(prostar_map: DeviceMap, tmp_path: Path) -> AsyncIterator[OpenSite]:
    """`open_site(plans, behaviour)` opens a site on ptys, by default the demo's; closed at the end of the test."""
    async with AsyncExitStack() as stack:

        def build(plans: Sequence[LinePlan] = DEMO_LAYOUT, behaviour: Behaviour | None = None) -> SimulatedSite:
            site = SimulatedSite.build(prostar_map, plans, behaviour, tmp_path)
            site.open()
            stack.callback(site.close)
            return site

        yield build
