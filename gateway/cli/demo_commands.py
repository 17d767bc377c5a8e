"""The commands that the demo offers: each on one line of at most 80 characters, and each works as it stands."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

COMMUNITY = "public"
ROOT = "1.3.6.1.4.1.32473.1"


@dataclass(frozen=True, slots=True)
class Try:
    """A command and what it shows."""

    shows: str
    command: str


def commands_to_try(modbus_port: int, snmp_port: int, http_port: int, folder: Path) -> tuple[Try, ...]:
    """The commands for these ports, to be pasted in `folder`; names from the MIB where `folder` has it."""
    mbpoll = f"mbpoll -m tcp -p {modbus_port} -0 -1"
    agent = f"127.0.0.1:{snmp_port}"
    http = f"http://127.0.0.1:{http_port}"
    if (folder / "mibs" / "PROSTAR-GATEWAY-MIB.txt").is_file():
        snmp = f"-v2c -c {COMMUNITY} -M mibs:mibs/base -m ALL {agent}"
        walks: tuple[Try, ...] = (
            Try("live values by SNMP", f"snmpwalk {snmp} pgwLiveTable"),
            Try("the devices as a table", f"snmptable {snmp} pgwDeviceTable"),
        )
    else:
        walks = (Try("everything by SNMP", f"snmpwalk -v2c -c {COMMUNITY} {agent} {ROOT}"),)
    return (
        Try(
            "battery, array and load registers of unit 11, as float16", f"{mbpoll} -a 11 -t 4:hex -r 16 -c 8 127.0.0.1"
        ),
        Try("charge state of the three ProStars", f"{mbpoll} -a 11:13 -t 4 -r 33 -c 1 127.0.0.1"),
        *walks,
        Try("battery voltages as Prometheus sees them", f"curl -s {http}/metrics | grep battery_voltage_volts"),
        Try("whether the gateway is ready", f"curl -s {http}/readyz"),
    )
