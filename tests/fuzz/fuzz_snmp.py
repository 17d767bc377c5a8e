"""Fuzz the SNMP agent by coverage, by hand: `.venv/bin/python tests/fuzz/fuzz_snmp.py [libFuzzer options] [CORPUS]`.

Needs `pip install atheris`, which is in no requirements file. `python -m tests.fuzz.corpus FOLDER` makes a corpus.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import atheris  # type: ignore[import-not-found, import-untyped, unused-ignore]  # installed by hand

sys.path.insert(0, str(Path(__file__).parents[2]))
with atheris.instrument_imports(include=["gateway.faces.snmp"]):
    from tests.fuzz.snmp import agent, feed

AGENT = agent()


def one_input(data: bytes) -> None:
    """Feed one datagram."""
    feed(AGENT, data)


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    atheris.Setup(sys.argv, one_input)
    atheris.Fuzz()
