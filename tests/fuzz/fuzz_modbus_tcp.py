"""Fuzz the Modbus TCP face by coverage, by hand: `.venv/bin/python tests/fuzz/fuzz_modbus_tcp.py [libFuzzer options]`.

Needs `pip install atheris`, which is in no requirements file. The first two bytes of an input say where it is cut.
"""

from __future__ import annotations

import asyncio
import logging
import sys
from pathlib import Path

import atheris  # type: ignore[import-not-found, import-untyped, unused-ignore]  # installed by hand

sys.path.insert(0, str(Path(__file__).parents[2]))
with atheris.instrument_imports(include=["gateway.faces.modbus", "gateway.core", "gateway.modbus"]):
    from tests.fuzz.modbus_tcp import Target

LOOP = asyncio.new_event_loop()


async def _target() -> Target:
    return Target()


TARGET = LOOP.run_until_complete(_target())


def one_input(data: bytes) -> None:
    """Feed one input."""
    LOOP.run_until_complete(TARGET.feed(data[2:], [data[0], data[0] + data[1]] if len(data) > 1 else []))


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    atheris.Setup(sys.argv, one_input)
    atheris.Fuzz()
