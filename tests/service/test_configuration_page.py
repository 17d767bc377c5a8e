"""docs/configuration.md says of every key what the schema says, and nothing else."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from gateway.service import schema
from gateway.service.problems import show
from gateway.service.schema import Key

TEXT = (Path(__file__).parents[2] / "docs" / "configuration.md").read_text()
SECTIONS: dict[str, type[BaseModel]] = {
    "Top level": schema.Config,
    "`[[line]]`": schema.LineTable,
    "`[[line.device]]`": schema.DeviceTable,
    "`[poll]`": schema.PollTable,
    "`[cache]`": schema.CacheTable,
    "`[modbus]`": schema.ModbusTable,
    "`[modbus.rate]`": schema.RateTable,
    "`[[modbus.rate.network]]`": schema.ClientNetworkTable,
    "`[modbus.tls]`": schema.TlsTable,
    "`[[modbus.listener]]`": schema.ListenerTable,
    "`[[modbus.write]]`": schema.WriteTable,
    "`[snmp]`": schema.SnmpTable,
    "`[[snmp.community]]`": schema.CommunityTable,
    "`[[snmp.user]]`": schema.UserTable,
    "`[[snmp.view]]`": schema.ViewTable,
    "`[[snmp.emc1]]`": schema.Emc1Table,
    "`[[snmp.notify]]`": schema.NotifyTable,
    "`[http]`": schema.HttpTable,
    "`[history]`": schema.HistoryTable,
    "`[log]`": schema.LogTable,
}


def default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        return "see below"
    if isinstance(value, tuple):
        value = list(value)
    return "none" if value in ([], {}, None) else f"`{show(value)}`"


def row(name: str, field: FieldInfo) -> str:
    key = next(data for data in field.metadata if isinstance(data, Key))
    return f"| `{name}` | {default(field)} | {key.allowed} | {key.does} |"


@pytest.mark.parametrize("heading", SECTIONS)
def test_the_table_of_a_section_is_the_schema(heading: str) -> None:
    section = TEXT.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `.*$", section, re.MULTILINE)
    assert rows == [row(name, field) for name, field in SECTIONS[heading].model_fields.items()]
