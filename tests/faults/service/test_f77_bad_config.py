"""F77: a bad configuration at the start: every problem at once, exit status 78, and systemd does not try again."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path

import pytest

from tests.e2e.programs import GATEWAY, Program
from tests.faults.service.rig import Service, client

UNIT = Path(__file__).parents[3] / "deploy" / "systemd" / "prostar-gateway.service"

MISTAKES = {
    "site": ('site = "ridge-07"', "site = 7"),
    "line[0].baudrate": ("baudrate = 115200", "baudrate = 1"),
    "line[0].device[0].unit_id": ("unit_id = 11", "unit_id = 300"),
    "modbus.listne": ("[modbus]\n", '[modbus]\nlistne = "x"\n'),
    "http.listen[0]": ("[http]\nlisten = [", '[http]\nlisten = ["nowhere", '),
}
"""The key of each problem, and how it comes into the file: a type, a range, an unknown key, another form."""


async def ended(service: Service, program: Program) -> tuple[int, list[str]]:
    """Exit status and standard error of a start that fails."""
    service.programs.append(program)
    await asyncio.to_thread(program.process.wait, 30)
    return program.end(), program.log().splitlines()


async def test_every_problem_at_once_and_78_which_ends_the_restarts(service: Service) -> None:
    service.configure()
    text = service.config.read_text()
    for right, wrong in MISTAKES.values():
        assert right in text
        text = text.replace(right, wrong, 1)
    service.config.write_text(text)
    status, said = await ended(service, Program([*GATEWAY, "run", "-c", str(service.config)]))
    assert status == 78
    assert {line.removeprefix(f"{service.config}: ").split(": ")[0] for line in said[:-1]} == set(MISTAKES)
    assert said[-1] == f"{len(MISTAKES)} problems in {service.config}"
    assert not (service.folder / "state").exists()  # nothing was begun
    assert re.search(rf"^RestartPreventExitStatus={status}$", UNIT.read_text(), re.MULTILINE)
    with pytest.raises(OSError):
        async with client(service.modbus):
            pass


async def test_a_secret_that_cannot_be_read_is_named_and_not_served_without(service: Service) -> None:
    missing = service.folder / "noc.auth"
    user = f'[[snmp.user]]\nname = "noc"\nauth_password_file = "{missing}"\npriv_password_file = "{missing}"\n'
    service.configure(rest=user)
    status, lines = await ended(service, Program([*GATEWAY, "run", "-c", str(service.config)]))
    assert status == 78
    for key in ("auth_password_file", "priv_password_file"):
        (line,) = (line for line in lines if f"snmp.user[0].{key}" in line)
        assert str(missing) in line
