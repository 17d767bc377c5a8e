"""Makes corpora to begin with: `python -m tests.fuzz.corpus FOLDER` writes modbus_tcp, rtu and snmp there."""

from __future__ import annotations

import sys
from pathlib import Path
from random import Random

from tests.faults.snmp.test_f55_malformed_ber import hostile_datagrams
from tests.fuzz.modbus_tcp import mutated
from tests.fuzz.rtu import script
from tests.fuzz.snmp import agent, name

COUNT = 500


def write(folder: Path, count: int = COUNT) -> None:
    """Streams of requests, scripts of a line and datagrams, as the fuzzers take them; the same ones every time."""
    rng = Random(55)
    for room in ("modbus_tcp", "rtu", "snmp"):
        (folder / room).mkdir(parents=True, exist_ok=True)
    for _ in range(count):
        stream, cuts = mutated(rng)
        first = min((cuts[0] if cuts else 0), 255)
        second = min((cuts[1] - first if len(cuts) > 1 else 0), 255)
        data = bytes((first, max(second, 0))) + bytes(stream)
        (folder / "modbus_tcp" / name(data)).write_bytes(data)
    for data in [script(rng) for _ in range(count)]:
        (folder / "rtu" / name(data)).write_bytes(data)
    for data in hostile_datagrams(agent(), count):
        (folder / "snmp" / name(data)).write_bytes(data)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
