"""What differs between two configurations, by key path."""

from __future__ import annotations

from gateway.service.changes import changes
from gateway.service.config import Config, parse_config

LINE = """
[[line]]
name = "{name}"
port = "/dev/{name}"
[[line.device]]
name = "{name}-1"
address = 1
unit_id = {unit}
model = "prostar-mppt"
"""
A, B = LINE.format(name="a", unit=11), LINE.format(name="b", unit=12)


def config(*parts: str) -> Config:
    return parse_config('site = "ridge-07"\n' + "".join(parts))


def test_the_same_file_has_no_changes() -> None:
    assert changes(config(A, B), config(A, B)) == ()


def test_keys_are_named_by_table_and_never_with_their_values() -> None:
    secret = '[[snmp.community]]\nname = "s3cret"\nsource = ["10.0.0.0/8"]\n'
    found = changes(config(A, B), config(A, B.replace("/dev/b", "/dev/c"), secret, "[modbus]\nmax_connections = 3\n"))
    assert found == ("line[b].port", "modbus.max_connections", "snmp.community[0]")
    other = secret.replace("10.0.0.0", "11.0.0.0")
    assert changes(config(A, secret), config(A, other)) == ("snmp.community[0].source",)
    assert changes(config(A, secret), config(A, secret.replace("s3cret", "other"))) == ("snmp.community[0].name",)


def test_tables_with_a_name_are_compared_by_it() -> None:
    assert changes(config(A, B), config(B, A)) == ()
    assert changes(config(A, B), config(B)) == ("line[a]",)
    assert changes(config(A), config(A.replace("unit_id = 11", "unit_id = 9"))) == ("line[a].device[a-1].unit_id",)
