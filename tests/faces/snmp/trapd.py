"""A real snmptrapd of net-snmp on a free port, and what it got."""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.faces.snmp.poller import AUTH_PHRASE, PRIV_PHRASE

_LINE = re.compile(r"GOT (\S*) (.*)")


@dataclass(frozen=True)
class Got:
    """A notification: its name, and its objects by name without index, as net-snmp prints them."""

    name: str
    objects: dict[str, str]
    names: tuple[str, ...]  # of the objects, in their order, with index


def parse(line: str) -> Got | None:
    found = _LINE.search(line)
    if found is None:
        return None
    pairs = [each.split(" = ", 1) for each in found[2].split("\t") if " = " in each]
    named = [(name.rpartition("::")[2], value) for name, value in pairs]
    objects = {name.partition(".")[0]: value for name, value in named}
    kind = next(value for name, value in named if "snmpTrapOID" in name or name.endswith("1.1.4.1.0"))
    return Got(kind.rpartition("::")[2].rpartition(" ")[2], objects, tuple(name for name, _ in named))


class Trapd:
    """The running program."""

    def __init__(self, process: asyncio.subprocess.Process, port: int) -> None:
        self.process = process
        self.port = port

    async def next(self) -> Got:
        """The next notification; fails when none comes."""
        assert self.process.stdout is not None
        async with asyncio.timeout(30):
            while line := await self.process.stdout.readline():
                got = parse(line.decode())
                if got is not None:
                    return got
        raise AssertionError("snmptrapd ended")

    async def until(self, name: str) -> Got:
        """The next notification of this name; what comes before is left out."""
        while (got := await self.next()).name != name:
            pass
        return got


def user(engine_id: bytes | None = None) -> str:
    """Configuration of the user that may notify: at the sender's engine for traps, at its own for informs."""
    at = "" if engine_id is None else f"-e 0x{engine_id.hex()} "
    return f'createUser {at}noc SHA-256 "{AUTH_PHRASE}" AES "{PRIV_PHRASE}"\nauthUser log noc priv\n'


COMMUNITY = "authCommunity log public\n"


@asynccontextmanager
async def trapd(
    peer: Callable[[str], str], folder: Path, mib_path: str, port: int, configuration: str
) -> AsyncIterator[Trapd]:
    """Run it until the end of the block; `folder` is its persistent directory, so it can be started again there."""
    (folder / "snmptrapd.conf").write_text(configuration)
    process = await asyncio.create_subprocess_exec(
        peer("snmptrapd"), "-f", "-Lo", "-C", "-c", str(folder / "snmptrapd.conf"), "-M", mib_path, "-m",
        "PROSTAR-GATEWAY-MIB", "-F", "GOT %q %v\n", f"udp:127.0.0.1:{port}",
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        env={**os.environ, "SNMP_PERSISTENT_DIR": str(folder), "SNMPCONFPATH": str(folder)},
    )  # fmt: skip
    assert process.stdout is not None
    try:
        async with asyncio.timeout(30):
            while b"NET-SNMP version" not in await process.stdout.readline():
                pass
        yield Trapd(process, port)
    finally:
        if process.returncode is None:
            process.terminate()
        await process.wait()
