"""The oracle's eye on the devices of a rig: what a face could show of them, each thing judged once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from gateway.core.site import Device
from gateway.simulator.oracle import OracleController, Verdict


class Judge:
    """Judges devices by the controllers behind them, in the same order; `tell` hears each verdict and what it is of."""

    def __init__(
        self,
        units: Sequence[OracleController],
        devices: Sequence[Device],
        tell: Callable[[Verdict, str], None],
    ) -> None:
        self._pairs = tuple(zip(units, devices, strict=True))
        self._tell = tell
        self._versions = [0] * len(self._pairs)
        self._judged: dict[tuple[int, str, int, int], float] = {}

    def blocks(self) -> None:
        """The blocks that are new since the last time."""
        for index, (unit, device) in enumerate(self._pairs):
            snapshot = device.snapshot
            if snapshot.version == self._versions[index]:
                continue
            self._versions[index] = snapshot.version
            for block in snapshot.blocks:
                key = (index, block.space.value, block.first, block.count)
                if self._judged.get(key) == block.read_at:
                    continue
                self._judged[key] = block.read_at
                verdict = unit.judge(block.space, block.first, block.count, block.data, asked_at=block.read_at)
                self._tell(verdict, f"block {block} of {device.name}")

    def values(self) -> None:
        """The decoded values that a face would show now."""
        for unit, device in self._pairs:
            snapshot = device.snapshot
            points = {point.name: point for point in device.map.points}
            for name, value in snapshot.shown().items():
                verdict = unit.judge_value(points[name], value, read_at=snapshot.read_at[name])
                self._tell(verdict, f"value {name}={value!r} of {device.name}")
