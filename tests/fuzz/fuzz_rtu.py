"""Fuzz the RTU client by coverage, by hand: `.venv/bin/python tests/fuzz/fuzz_rtu.py [libFuzzer options] [CORPUS]`.

Needs `pip install atheris`, which is in no requirements file. `python -m tests.fuzz.corpus FOLDER` makes a corpus.
"""

from __future__ import annotations

import sys
from pathlib import Path

import atheris  # type: ignore[import-not-found, import-untyped, unused-ignore]  # installed by hand

sys.path.insert(0, str(Path(__file__).parents[2]))
with atheris.instrument_imports(include=["gateway.modbus"]):
    from tests.fuzz.rtu import feed


def one_input(data: bytes) -> None:
    """Play one script."""
    feed(data)


if __name__ == "__main__":
    atheris.Setup(sys.argv, one_input)
    atheris.Fuzz()
