"""The configuration: what is accepted, and that everything that is wrong is told at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from ipaddress import ip_network
from pathlib import Path

import pytest

from gateway.core.ratelimit import ClientRate, LineRates
from gateway.devices.schema import load_map
from gateway.errors import ConfigError
from gateway.faces.modbus.admission import rate_of
from gateway.faces.modbus.settings import LineListen, ModbusSettings
from gateway.service.config import Config, load_config, parse_config
from gateway.service.plain import PlainTable, with_values
from gateway.service.problems import Problem, in_file_order, render_path
from gateway.service.schema import Key, Table
from gateway.service.settings import modbus_settings

CONFIGS = Path(__file__).parents[2] / "config"

MINIMAL = """
site = "ridge-07"
[[line]]
name = "shelter-a"
port = "/dev/serial/by-id/usb-a"
[[line.device]]
name = "array-1"
address = 1
unit_id = 11
model = "prostar-mppt"
"""

WRITE = '[[modbus.write]]\nsource = ["127.0.0.1"]\n'


def problems(text: str) -> list[str]:
    """What is wrong with a file, without its name."""
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "c.toml")
    assert all(problem.startswith("c.toml: ") for problem in caught.value.problems)
    return [problem.removeprefix("c.toml: ") for problem in caught.value.problems]


def with_device(lines: str) -> str:
    return MINIMAL + lines


def replaced(old: str, new: str) -> str:
    assert MINIMAL.count(old) == 1
    return MINIMAL.replace(old, new)


def schema_keys(table: type[Table], path: str = "") -> Iterator[tuple[str, Key]]:
    """Every key of the schema as (path without positions, key)."""
    for name, field in table.model_fields.items():
        key = next(data for data in field.metadata if isinstance(data, Key))
        at = f"{path}.{name}" if path else name
        yield at, key
        inner = [kind for kind in Table.__subclasses__() if kind.__name__ in str(field.annotation)]
        for kind in inner:
            yield from schema_keys(kind, at)


def raw_keys(raw: object, path: str = "") -> Iterator[str]:
    if isinstance(raw, dict):
        for name, value in raw.items():
            at = f"{path}.{name}" if path else name
            yield at
            yield from raw_keys(value, at)
    elif isinstance(raw, list):
        for value in raw:
            yield from raw_keys(value, path)


def test_defaults_reach_nothing_but_loopback() -> None:
    config = parse_config(MINIMAL)
    assert config.modbus.listen == ("127.0.0.1:1502",)
    assert config.snmp.listen == ("127.0.0.1:1161",)
    assert config.http.listen == ("127.0.0.1:9850",)
    assert config.modbus.allow == ("127.0.0.0/8", "::1/128")
    assert config.snmp.community == ()
    assert config.modbus.writes is False
    line = config.line[0]
    assert (line.baudrate, line.bytesize, line.parity, line.stopbits) == (9600, 8, "N", 2)
    assert (line.reply_timeout_s, line.retries) == (0.5, 2)
    assert (config.poll.live_s, config.poll.settings_s, config.cache.max_age_s) == (1.0, 300.0, 5.0)


def test_a_config_cannot_be_changed() -> None:
    config = parse_config(MINIMAL)
    with pytest.raises(AttributeError, match="is not changed: site"):
        config.site = "another"  # type: ignore[misc]  # that it is refused is the test
    with pytest.raises(AttributeError, match="is not changed: writes"):
        config.modbus.writes = True  # type: ignore[misc]  # as above


@pytest.mark.parametrize("name", ["minimal.toml", "full.toml"])
def test_the_examples_are_right(name: str) -> None:
    assert isinstance(load_config(CONFIGS / name), PlainTable)


def test_the_full_example_names_every_key_and_comments_it() -> None:
    import tomllib

    text = (CONFIGS / "full.toml").read_text()
    named = set(raw_keys(tomllib.loads(text)))
    expected = {path for path, _ in schema_keys(Config)}
    assert expected <= named
    assert {path for path in named if not path.startswith("line.device.decode.")} == expected
    # A key follows a comment, with at most its neighbours between, has one beside it, or was explained above.
    explained: set[str] = set()
    commented = False
    for row in map(str.strip, text.splitlines()):
        if row.startswith("#"):
            commented = True
        elif not row:
            commented = False
        elif " = " in row and not row.startswith("["):
            key = row.split(" =")[0]
            assert commented or "#" in row or key in explained, row
            explained.add(key)


def test_the_full_example_shows_the_defaults() -> None:
    full, minimal = load_config(CONFIGS / "full.toml"), load_config(CONFIGS / "minimal.toml")
    assert with_values(full.poll, {"night_s": None}) == minimal.poll  # TOML cannot show "as by day"
    assert full.cache == minimal.cache
    rate = with_values(full.modbus.rate, {"network": ()})
    assert with_values(full.modbus, {"listener": (), "write": (), "rate": rate, "tls": None}) == minimal.modbus
    assert full.http == minimal.http
    assert full.state_dir == minimal.state_dir
    shown = set(vars(full.line[0])) - {"name", "port", "device"}
    assert all(getattr(full.line[0], key) == getattr(minimal.line[0], key) for key in shown)


def test_all_problems_are_told_at_once_in_the_order_of_the_file() -> None:
    text = """
sight = "ridge-07"
[[line]]
name = "a"
port = "ttyUSB0"
bautrate = 9600
[[line.device]]
name = "x"
address = 1
unit_id = 300
model = "prostar-mppt"
[[line.device]]
name = "x"
address = 1
unit_id = 0
model = "tracer"
[[line]]
name = "a"
port = "/dev/b"
[[line.device]]
name = "y"
address = "1"
unit_id = 11
model = "automatic"
[poll]
live_s = true
[modbus]
listen = ["localhost:1502", "127.0.0.1:9850"]
allow = ["10.0.0.1/8"]
writes = "yes"
[snmp]
enterprise_root = "1.3.6.1.4.1.33333.9"
[[snmp.community]]
name = "s3cret"
[[snmp.user]]
name = "noc"
[http]
listen = ["127.0.0.1:70000"]
"""
    found = problems(text)
    paths = [problem.split(": ")[0] for problem in found]
    assert paths == [
        "sight",
        "line[0].port",
        "line[0].bautrate",
        "line[0].device[0].unit_id",
        "line[0].device[1].name",
        "line[0].device[1].address",
        "line[0].device[1].unit_id",
        "line[0].device[1].model",
        "line[1].name",
        "line[1].device[0].address",
        "line[1].device[0].model",
        "poll.live_s",
        "modbus.listen[0]",
        "modbus.allow[0]",
        "modbus.writes",
        "snmp.enterprise_root",
        "snmp.community[0].source",
        "snmp.user[0].auth_password_file",
        "snmp.user[0].priv_password_file",
        "http.listen[0]",
        "site",
    ]
    assert all("allowed: " in problem for problem in found)
    assert "s3cret" not in "\n".join(found)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "site: is missing; allowed: 1 to 64 printable characters"),
        ("", "line: is missing; allowed: one [[line]] table or more"),
        (
            MINIMAL + "[pol]\nlive_s = 1\n",
            'pol: unknown key; did you mean "poll"? allowed: site, state_dir, line, poll',
        ),
        (MINIMAL + "[cache]\nmax_age_s = inf\n", "cache.max_age_s: Infinity is not a finite number; allowed: 0.1 to"),
        (MINIMAL + '[cache]\nmax_age_s = "5"\n', 'cache.max_age_s: "5" is not a number; allowed: 0.1 to 3600.0'),
        (MINIMAL + "[cache]\nmax_age_s = 1979-05-27\n", "cache.max_age_s: 1979-05-27 is not a number"),
        (MINIMAL + "[modbus]\nmax_connections = 1.5\n", "modbus.max_connections: 1.5 is not a whole number"),
        (MINIMAL + "[modbus]\nwrites = 0\n", "modbus.writes: 0 is not true or false; allowed: true or false"),
        (MINIMAL + "[[modbus.write]]\n", "modbus.write[0]: holds for nobody; allowed: source or role"),
        (MINIMAL + WRITE, "modbus.write[0]: allows nothing; allowed: point, registers or coils"),
        (MINIMAL + WRITE + "unit_id = [99]\n", "modbus.write[0].unit_id[0]: no device has unit id 99; allowed: 11"),
        (
            MINIMAL + '[http]\ntls_certificate = "/etc/crt"\n',
            "http.tls_private_key: is missing, and http.tls_certificate is there; allowed: both or neither",
        ),
        (
            MINIMAL + '[http]\nbearer_token_file = "token"\n',
            'http.bearer_token_file: the value is not allowed; allowed: the absolute path of a file, or "" for none',
        ),
        (
            MINIMAL + WRITE + 'point = ["battery_voltage"]\n',
            'modbus.write[0].point[0]: "battery_voltage" can only be r',
        ),
        (MINIMAL + WRITE + 'point = ["lighting_test"]\n', 'modbus.write[0].point[0]: "lighting_test" can only be read'),
        (
            MINIMAL + WRITE + 'point = ["reset"]\n',
            'modbus.write[0].point[0]: "reset" is no point of these devices; all',
        ),
        (MINIMAL + WRITE + 'registers = ["E000"]\n', 'modbus.write[0].registers[0]: "E000" is not allowed; allowed: a'),
        (MINIMAL + WRITE + 'registers = ["0x2-0x1"]\n', 'modbus.write[0].registers[0]: "0x2-0x1" is not allowed; a'),
        (MINIMAL + WRITE + 'registers = ["0x0000-0x0024"]\n', "modbus.write[0].registers[0]: "),
        (MINIMAL + WRITE + 'coils = ["0x00FE-0x00FF"]\n', 'modbus.write[0].coils[0]: "0x00FE-0x00FF" has nothing that'),
        (MINIMAL + "[modbus]\nwrite_interval_s = -1.0\n", "modbus.write_interval_s: -1.0 is out of range"),
        (MINIMAL + "[modbus]\neeprom_writes_per_day = 0\n", "modbus.eeprom_writes_per_day: 0 is out of range"),
        (
            MINIMAL + '[modbus]\nlisten = "127.0.0.1:1"\n',
            'modbus.listen: "127.0.0.1:1" is not a list; allowed: a list of',
        ),
        (
            MINIMAL + '[modbus]\nlisten = ["::1:1502"]\n',
            'modbus.listen[0]: "::1:1502" is not allowed; allowed: a list of',
        ),
        (
            MINIMAL + '[modbus]\nallow = ["192.168.1.10/24"]\n',
            'modbus.allow[0]: "192.168.1.10/24" is not allowed; did you mean "192.168.1.0/24"? allowed: a list of',
        ),
        (
            MINIMAL + 'state_dir = "/srv/gateway"\n',
            "line[0].device[0].state_dir: unknown key; it stands above the first [table]; allowed: name, address,",
        ),
        (f"x = {'[' * 9999}{']' * 9999}\n{MINIMAL}", "not TOML that can be read: "),
        (replaced("unit_id = 11", f"unit_id = {'9' * 9999}"), "not TOML that can be read: "),
        (
            'state_dir = "/tmp/\\u0000"\n' + MINIMAL,
            'state_dir: "/tmp/\\u0000" is not allowed; allowed: an absolute path',
        ),
        (
            replaced('"/dev/serial/by-id/usb-a"', '"/dev/\\u0000"'),
            'line[0].port: "/dev/\\u0000" is not allowed; allowed:',
        ),
        (
            replaced('"/dev/serial/by-id/usb-a"', '"tcp://host:0"'),
            'line[0].port: "tcp://host:0" is not allowed; allowed:',
        ),
        (replaced('"/dev/serial/by-id/usb-a"', '"TCP://host:502"'), 'line[0].port: "TCP://host:502" is not allowed;'),
        (replaced('"/dev/serial/by-id/usb-a"', '"tcp://me:x@host:502"'), "line[0].port: "),
        (replaced('"/dev/serial/by-id/usb-a"', '"tcp://host:502?timeout=3"'), "line[0].port: "),
        (
            MINIMAL + '[modbus]\nallow = ["nas"]\n',
            'modbus.allow[0]: "nas" is not allowed; allowed: a list of addresses',
        ),
        (
            MINIMAL + '[[snmp.community]]\nname = "a"\nsource = ["::1"]\nview = "x"\n',
            'snmp.community[0].view: there is no view "x"; allowed: none',
        ),
        (
            MINIMAL + "[[snmp.emc1]]\nunit_id = 12\n",
            "snmp.emc1[0].unit_id: no device has unit_id 12; allowed: 11",
        ),
        (MINIMAL + "[[snmp.emc1]]\nunit_id = 0\n", "snmp.emc1[0].unit_id: 0 is out of range; allowed: the unit_id of"),
        (MINIMAL + '[[snmp.emc1]]\nlisten = ["::1:1"]\n', 'snmp.emc1[0].listen[0]: "::1:1" is not allowed; allowed: a'),
        (MINIMAL + "[[snmp.emc1]]\nport = 1162\n", "snmp.emc1[0].unit_id: is missing"),
        (MINIMAL + "[[snmp.emc1]]\nunit_id = 11\nport = 1\n", "snmp.emc1[0].port: unknown key; allowed: unit_id, list"),
        (
            MINIMAL + "[[snmp.emc1]]\nunit_id = 11\n" * 2,
            "snmp.emc1[1].unit_id: 11 is already used by snmp.emc1[0].unit_id; allowed: a value of its own",
        ),
        (
            MINIMAL + '[[snmp.emc1]]\nunit_id = 11\nlisten = ["0.0.0.0:1161"]\n',
            'snmp.emc1[0].listen[0]: "0.0.0.0:1161" clashes with snmp.listen[0]; allowed: another address or port',
        ),
        (
            MINIMAL + '[[snmp.notify]]\nkind = "trap"\n',
            "snmp.notify[0].address: is missing",
        ),
        (MINIMAL + '[snmp]\nenterprise_root = "1.3.6.1.4.1"\n', 'snmp.enterprise_root: "1.3.6.1.4.1" is not allowed;'),
        (
            MINIMAL + '[snmp]\nenterprise_root = "1.3.6.1.4.1.33333"\n',
            "never 33333, which is Morningstar's",
        ),
        (
            MINIMAL + '[[snmp.community]]\nname = "a b"\nsource = []\n',
            "snmp.community[0].name: the value is not allowed; allowed: 1 to 32 printable ASCII",
        ),
        (MINIMAL + '[[snmp.community]]\nname = "a"\nsource = []\n', "snmp.community[0].source: is empty; allowed:"),
        (
            replaced('model = "prostar-mppt"', 'model = "auto"\nproduct = "PWM-1"'),
            'line[0].device[0].product: no known model calls itself "PWM-1"; allowed: PS-MPPT-25, ',
        ),
        (
            replaced('model = "prostar-mppt"', 'model = "auto"\ndecode = { hourmeter = "f16" }'),
            'line[0].device[0].decode.hourmeter: "f16" is no reading of this point; allowed: "document", "lo_hi"',
        ),
        (
            replaced('model = "prostar-mppt"', 'model = "auto"\ndecode = { battery_voltage = "f16" }'),
            "line[0].device[0].decode.battery_voltage: no point of auto with another reading has this name; allowed: ",
        ),
        (
            replaced('model = "prostar-mppt"', 'model = "prostar"'),
            'line[0].device[0].model: "prostar" has no map; allowed: "prostar-mppt", "tristar-mppt", "auto"',
        ),
        (
            replaced('"/dev/serial/by-id/usb-a"', '"tcp://10.0.0.1:502"\nbaudrate = 19200'),
            "line[0].baudrate: has no meaning for a Modbus TCP upstream",
        ),
        (
            replaced('"/dev/serial/by-id/usb-a"', '"/dev/serial/by-id/usb-a"\npipelining = 4'),
            "line[0].pipelining: has no meaning for a serial port",
        ),
        (replaced('"/dev/serial/by-id/usb-a"', '"tcp://10.0.0.1"'), "allowed: a device path such as"),
        (
            replaced('"/dev/serial/by-id/usb-a"', '"loop://"'),
            'line[0].port: "loop://" is not allowed; allowed: a device',
        ),
        (replaced('"/dev/serial/by-id/usb-a"', '"socket://host"'), "line[0].port: "),
        (
            replaced('"/dev/serial/by-id/usb-a"', '"ttyUSB0"'),
            'line[0].port: "ttyUSB0" is not allowed; allowed: a device',
        ),
        (replaced("unit_id = 11", "unit_id = 248"), "unit_id: 248 is out of range; allowed: 1 to 247"),
        (replaced("unit_id = 11", "unit_id = 0"), "unit_id: 0 is out of range; allowed: 1 to 247"),
        (replaced("address = 1", "address = true"), "address: true is not a whole number; allowed: 1 to 247"),
        (replaced('"array-1"', '" array-1"'), 'name: " array-1" is not allowed; allowed: 1 to 64 printable characters'),
        (replaced("address = 1", "adress = 1"), 'adress: unknown key; did you mean "address"? allowed: name, address'),
        (replaced("[[line]]", "[line]").replace("[[line.device]]", "[line.device]"), "line: {"),
        (
            with_device('[line.device.decode]\nnonsense = "f16"\n'),
            "line[0].device[0].decode.nonsense: no point of prostar-mppt with another reading has this name; allowed: ",
        ),
        (
            with_device('[line.device.decode]\ncharge_energy_total = "f17"\n'),
            'line[0].device[0].decode.charge_energy_total: "f17" is no reading of this point; allowed: "document", "f1',
        ),
        (with_device("[line.device.decode]\ncharge_energy_total = 16\n"), "charge_energy_total: 16 is not a text"),
        (
            with_device('product = "TS-MPPT-60"\n'),
            'line[0].device[0].product: no prostar-mppt calls itself "TS-MPPT-60"; allowed: PS-MPPT-25, ',
        ),
        (
            with_device('product = "PS-MPPT-40M "\n'),
            'product: "PS-MPPT-40M " is not allowed; allowed: the product',
        ),
        (
            with_device("serial_number = 17410042\n"),
            "serial_number: 17410042 is not a text; allowed: 1 to 32",
        ),
        (with_device("[poll]\nnight_s = 0.1\n"), "poll.night_s: 0.1 is out of range; allowed: 0.2 to 3600.0"),
    ],
)
def test_a_problem_names_key_fault_and_what_is_allowed(text: str, expected: str) -> None:
    found = problems(text)
    assert any(expected in problem for problem in found), found


SECOND = """
[[line]]
name = "shelter-b"
port = "/dev/b"
[[line.device]]
name = "array-2"
address = 1
unit_id = 12
model = "prostar-mppt"
"""


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            '"shelter-b"',
            '"shelter-a"',
            'line[1].name: "shelter-a" is already used by line[0].name; allowed: a value of',
        ),
        ('"/dev/b"', '"/dev/serial/by-id/usb-a"', "line[1].port: "),
        ('"array-2"', '"array-1"', 'line[1].device[0].name: "array-1" is already used by line[0].device[0].name;'),
        ("= 12", "= 11", "line[1].device[0].unit_id: 11 is already used by line[0].device[0].unit_id;"),
    ],
)
def test_what_must_be_unique_over_the_lines(old: str, new: str, expected: str) -> None:
    parse_config(MINIMAL + SECOND)  # equal addresses on two lines are the normal case
    (found,) = problems(MINIMAL + SECOND.replace(old, new))
    assert found.startswith(expected)


def test_an_address_is_unique_on_its_line() -> None:
    second = SECOND.partition("[[line.device]]")[2]
    (found,) = problems(f"{MINIMAL}[[line.device]]{second}")
    assert found.startswith("line[0].device[1].address: 1 is already used by line[0].device[0].address;")


def test_a_community_is_named_once_and_never_shown() -> None:
    table = '[[snmp.community]]\nname = "s3cret"\nsource = ["127.0.0.1"]\n'
    (found,) = problems(MINIMAL + table + table)
    assert found.startswith("snmp.community[1].name: the same value is already used by snmp.community[0].name;")


@pytest.mark.parametrize(
    ("one", "other", "clash"),
    [
        ("127.0.0.1:5000", "127.0.0.1:5000", True),
        ("0.0.0.0:5000", "127.0.0.1:5000", True),
        ("[::1]:5000", "[::]:5000", True),
        ("[::]:5000", "127.0.0.1:5000", False),
        ("127.0.0.2:5000", "127.0.0.1:5000", False),
        ("127.0.0.1:0", "127.0.0.1:0", False),
    ],
)
def test_tcp_addresses_that_cannot_be_opened_together_clash(one: str, other: str, clash: bool) -> None:
    text = f'{MINIMAL}[modbus]\nlisten = ["{one}"]\n[http]\nlisten = ["{other}"]\n'
    if clash:
        (found,) = problems(text)
        assert found.startswith(f'http.listen[0]: "{other}" clashes with modbus.listen[0];')
    else:
        parse_config(text)


def test_udp_and_tcp_do_not_clash_but_a_default_may() -> None:
    parse_config(MINIMAL + '[snmp]\nlisten = ["127.0.0.1:1502"]\n')
    (found,) = problems(MINIMAL + '[modbus]\nlisten = ["127.0.0.1:9850"]\n')
    assert found.startswith('http.listen[0]: "127.0.0.1:9850" clashes with modbus.listen[0];')


@pytest.mark.parametrize("model", ["prostar-mppt", "tristar-mppt"])
def test_an_emc1_knows_both_models(model: str) -> None:
    text = MINIMAL.replace("prostar-mppt", model)
    assert f'"{model}"' in text
    assert [each.unit_id for each in parse_config(text + "[[snmp.emc1]]\nunit_id = 11\n").snmp.emc1] == [11]


def test_a_model_that_an_emc1_does_not_know_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    unknown = replace(load_map("prostar-mppt"), emc1_root=None)
    monkeypatch.setattr("gateway.service.emc1.load_map", lambda _model: unknown)
    (found,) = problems(MINIMAL + "[[snmp.emc1]]\nunit_id = 11\n")
    assert found == 'snmp.emc1[0].unit_id: the EMC-1 knows no "prostar-mppt"; allowed: none'


def test_a_syntax_error_has_its_place(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text('site = "a"\nline = = 1\n')
    with pytest.raises(ConfigError, match=r"c\.toml: not TOML: .*line 2, column 8"):
        load_config(path)


@pytest.mark.parametrize(
    ("content", "expected"),
    [(None, "cannot be read: No such file"), (b"site = \xff", "not UTF-8 at byte 7")],
)
def test_a_file_that_is_no_text(tmp_path: Path, content: bytes | None, expected: str) -> None:
    path = tmp_path / "c.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=expected):
        load_config(path)


def test_the_mark_of_utf_8_in_front_is_no_matter(tmp_path: Path) -> None:
    """Editors on Windows put it there."""
    path = tmp_path / "c.toml"
    path.write_text(MINIMAL.lstrip().replace("\n", "\r\n"), encoding="utf-8-sig", newline="")
    assert path.read_bytes()[:3] == b"\xef\xbb\xbf"
    assert load_config(path) == parse_config(MINIMAL)


@pytest.mark.parametrize("port", ["rfc2217://host:1?logging=debug", "socket://[::1]:1", "tcp://[2001:db8::7]:502/"])
def test_a_port_that_can_be_is_allowed(port: str) -> None:
    assert parse_config(replaced("/dev/serial/by-id/usb-a", port)).line[0].port == port


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load_config(tmp_path)


def test_problems_sort_by_where_they_stand() -> None:
    raw = {"b": [{"y": 1, "x": 2}], "a": 1}
    found = in_file_order([Problem(("a",), "3"), Problem(("b", 0, "x"), "2"), Problem(("b", 0, "y"), "1")], raw)
    assert [problem.text for problem in found] == ["1", "2", "3"]
    assert render_path(("b", 0, "x")) == "b[0].x"


LISTENER = '[[modbus.listener]]\nlisten = ["127.0.0.1:1503"]\nline = "{}"\n'


def test_a_listener_stands_for_one_line() -> None:
    config = parse_config(MINIMAL + LISTENER.format("shelter-a"))
    settings = modbus_settings(config)
    assert settings.lines == (LineListen((("127.0.0.1", 1503),), "shelter-a"),)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (LISTENER.format("shelter-x"), 'modbus.listener[0].line: no line is called "shelter-x"; allowed: "shelter-a"'),
        (
            LISTENER.format("shelter-a") + LISTENER.format("shelter-a").replace("1503", "1504"),
            'modbus.listener[1].line: "shelter-a" is already used by modbus.listener[0].line',
        ),
        (
            LISTENER.format("shelter-a").replace("1503", "1502"),
            'modbus.listener[0].listen[0]: "127.0.0.1:1502" clashes with modbus.listen[0]',
        ),
        (LISTENER.format("shelter-a").replace('"127.0.0.1:1503"', ""), "modbus.listener[0].listen: is empty; allowed:"),
        (
            LISTENER.format("shelter-a") + "tls = true\n",
            "modbus.listener[0].tls: there is no [modbus.tls] with the files for it; allowed: that table, or false",
        ),
    ],
)
def test_a_listener_that_cannot_be(text: str, problem: str) -> None:
    (found,) = problems(MINIMAL + text)
    assert found.startswith(problem)


def test_rates_reach_the_face() -> None:
    text = """
[modbus]
max_per_client = 3
priority = ["10.9.0.0/16"]
[modbus.rate]
requests_per_s = 7.0
client_line_per_s = 6.0
device_per_s = 5.0
line_per_s = 4.0
burst_s = 3.0
[[modbus.rate.network]]
source = ["10.1.0.0/16", "::1/128"]
requests_per_s = 0.0
client_line_per_s = 9.0
"""
    settings = modbus_settings(parse_config(MINIMAL + text))
    assert settings.max_per_client == 3
    assert settings.priority == (ip_network("10.9.0.0/16"),)
    rate = settings.rate
    assert (rate.client, rate.lines, rate.burst_s) == (ClientRate(7.0, 6.0), LineRates(5.0, 4.0), 3.0)
    assert rate_of("10.1.2.3", rate) == rate_of("::1", rate) == ClientRate(0.0, 9.0)
    assert rate_of("127.0.0.1", rate) == ClientRate(0.0, 6.0)
    assert rate_of("10.2.2.3", rate) == ClientRate(7.0, 6.0)


def test_the_defaults_of_the_file_are_those_of_the_face() -> None:
    settings, defaults = modbus_settings(parse_config(MINIMAL)), ModbusSettings()
    assert settings.rate == defaults.rate
    assert settings.max_per_client == defaults.max_per_client
    assert settings.priority == defaults.priority


@pytest.mark.parametrize("model", ["[]", "{ a = 1 }", "[[1], {}]", "1", "true"])
def test_a_model_that_is_no_text_is_one_problem_beside_a_write_rule(model: str) -> None:
    text = replaced('model = "prostar-mppt"', f"model = {model}") + WRITE + 'points = ["reset_control"]\n'
    assert any(problem.startswith("line[0].device[0].model: ") for problem in problems(text))
