"""`[modbus.tls]` from the file to the face: what is wrong with it, and what is worth a second look."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from ipaddress import ip_network
from pathlib import Path

import pytest

from gateway.core.write_rules import Requester
from gateway.errors import ConfigError
from gateway.faces.modbus.settings import LineListen
from gateway.faces.modbus.tls_names import WantedNames
from gateway.service.advice import advice
from gateway.service.config import Config, parse_config
from gateway.service.settings import line_budgets, modbus_settings
from gateway.service.tls import tls_advice, tls_problems, tls_settings
from gateway.service.writes import write_rules
from tests.faces.modbus.tls.site import SERVER, Pki, run

pytestmark = pytest.mark.peer

MINIMAL = """
site = "ridge-07"
[[line]]
name = "shelter-a"
port = "/dev/serial/by-id/usb-1"
  [[line.device]]
  name = "array-1"
  address = 1
  unit_id = 11
  model = "prostar-mppt"
"""
TLS = """
[modbus.tls]
certificate_file = "{0}/server.pem"
key_file = "{0}/server.key"
client_ca_file = "{0}/ca.pem"
"""


@pytest.fixture
def pki(tmp_path: Path, peer: Callable[[str], str]) -> Pki:
    peer("openssl")
    return Pki.of_the_recipe(tmp_path / "pki")


def config(pki: Pki, more: str = "") -> Config:
    return parse_config(MINIMAL + TLS.format(pki.folder) + more)


def problems(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_config(MINIMAL + text, "c.toml")
    return [problem.removeprefix("c.toml: ") for problem in caught.value.problems]


def test_without_the_table_there_is_no_tls() -> None:
    assert modbus_settings(parse_config(MINIMAL)).tls is None


def test_with_it_port_802_is_the_default_and_a_role_is_required(pki: Pki) -> None:
    settings = tls_settings(config(pki))
    assert settings is not None
    assert settings.listen == (("127.0.0.1", 802),)
    assert settings.require_role
    assert settings.files.crl is None
    assert modbus_settings(config(pki)).tls == settings


def test_the_only_way_in_by_tls_may_be_the_port_of_a_line(pki: Pki) -> None:
    more = 'listen = []\n[[modbus.listener]]\nline = "shelter-a"\nlisten = ["127.0.0.1:1503"]\ntls = true\n'
    settings = modbus_settings(config(pki, more))
    assert settings.lines == (LineListen((("127.0.0.1", 1503),), "shelter-a", tls=True),)
    assert settings.tls is not None
    assert settings.tls.listen == ()
    assert modbus_settings(config(pki, "listen = []\n")).tls is None


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[modbus.tls]\n", "modbus.tls.certificate_file: is missing; allowed: the absolute path of a PEM file"),
        ("[modbus.tls]\n", "modbus.tls.key_file: is missing; allowed: the absolute path of a PEM file"),
        (
            TLS.replace("{0}/ca.pem", "ca.pem"),
            "modbus.tls.client_ca_file: the value is not allowed; allowed: the absolute",
        ),
        (TLS + "key = 'x'\n", "modbus.tls.key: unknown key; "),
        (TLS + '[modbus]\nlisten = ["127.0.0.1:802"]\n', '"127.0.0.1:802" clashes with modbus.'),
        (
            '[[modbus.write]]\nrole = ["a\\nb"]\n',
            'modbus.write[0].role[0]: "a\\nb" is not allowed; allowed: a list of roles',
        ),
        (TLS + "client_names = []\n", 'modbus.tls.client_names: is empty; allowed: a list of names such as "scada'),
        (
            TLS + 'client_names = ["scada.example.net", "10.1.2.1/28"]\n',  # host bits in a network: a slip of the pen
            'modbus.tls.client_names[1]: "10.1.2.1/28" is not allowed; allowed: a list of names',
        ),
        (TLS + 'client_names = ["scada..net"]\n', 'modbus.tls.client_names[0]: "scada..net" is not allowed; '),
        (TLS + 'client_names = ["a.*.net"]\n', 'modbus.tls.client_names[0]: "a.*.net" is not allowed; '),
        ("[[modbus.write]]\nrole = []\n", "modbus.write[0].role: is empty; allowed: a list of roles"),
        ('[[modbus.write]]\npoint = ["modbus_id"]\n', "modbus.write[0]: holds for nobody; allowed: source or role"),
    ],
)
def test_a_problem_names_key_fault_and_what_is_allowed(text: str, expected: str) -> None:
    assert any(expected in problem for problem in problems(text))


def test_files_are_looked_at_only_where_it_listens(pki: Pki) -> None:
    shutil.rmtree(pki.folder)
    assert len(tls_problems(config(pki), time.time())) == 3
    assert not tls_problems(config(pki, "listen = []\n"), time.time())


def test_every_file_that_is_wrong_is_named(pki: Pki) -> None:
    (pki.folder / "ca.pem").write_text("nothing")
    (pki.folder / "server.key").unlink()
    found = tls_problems(config(pki), time.time() + 366 * 86400)
    assert [problem.partition(": ")[0] for problem in found] == [
        "modbus.tls.key_file",
        "modbus.tls.client_ca_file",
        "modbus.tls.certificate_file",
    ]
    assert "cannot be read: No such file or directory" in found[0]
    assert "holds no certificate" in found[1]
    assert "expired on" in found[2]


def test_a_key_with_a_passphrase_is_told_and_asks_nobody(pki: Pki) -> None:
    run("openssl pkey -in server.key -aes256 -passout pass:secret -out locked && mv locked server.key", pki.folder)
    (problem,) = tls_problems(config(pki), time.time())
    assert problem == "modbus.tls.key_file: has a passphrase, which nobody can type; allowed: a key without one"


def test_what_is_worth_a_second_look(pki: Pki) -> None:
    pki.issue("server", usage=SERVER, days=(-1, 9.2))
    (pki.folder / "server.key").chmod(0o644)
    told = advice(config(pki), line_budgets(config(pki)))
    assert f"modbus.tls.key_file: {pki.folder}/server.key can be read by every user of this machine" in told
    assert "modbus.tls.certificate_file: expires in 9 days" in told


def test_whose_certificates_are_wanted_comes_from_the_file(pki: Pki) -> None:
    settings = tls_settings(config(pki))
    assert settings is not None
    assert (settings.client_names, settings.require_address) == (None, False)
    settings = tls_settings(config(pki, 'client_names = ["SCADA.example.net", "10.1.2.3"]\nrequire_address = true\n'))
    assert settings is not None
    assert settings.client_names == WantedNames(frozenset({"scada.example.net"}), (ip_network("10.1.2.3/32"),))
    assert settings.require_address


REFUSED = ", so clients that check whom they talk to refuse it"


@pytest.mark.parametrize(
    ("names", "listen", "told"),
    [
        ((), "127.0.0.1:802", "modbus.tls.certificate_file: names nobody, for it has no subjectAltName"),
        (("gateway.example.net",), "127.0.0.1:802", "DNS:gateway.example.net, not for 127.0.0.1:802"),
        (("localhost", "127.0.0.1"), "192.0.2.7:802", "DNS:localhost, IP:127.0.0.1, not for 192.0.2.7:802"),
        (("localhost", "127.0.0.1"), "0.0.0.0:802", "DNS:localhost, IP:127.0.0.1, not for 0.0.0.0:802"),
        (("192.0.2.7",), "[::]:802", "IP:192.0.2.7, not for [::]:802"),
        (("192.0.2.8", "2001:db8::7"), "192.0.2.7:802", "IP:192.0.2.8, IP:2001:db8::7, not for 192.0.2.7:802"),
        (("localhost",), "127.0.0.1:802", None),
        (("127.0.0.1",), "127.0.0.1:802", None),
        (("gateway.example.net",), "192.0.2.7:802", None),
        (("*.example.net",), "0.0.0.0:802", None),
        (("192.0.2.7",), "192.0.2.7:802", None),
        (("192.0.2.7",), "0.0.0.0:802", None),
        (("2001:db8::7",), "[2001:db8:0::7]:802", None),
    ],
)
def test_a_server_of_another_name_is_told(pki: Pki, names: tuple[str, ...], listen: str, told: str | None) -> None:
    pki.issue("server", usage=SERVER, names=names, days=(-1, 100))
    said = list(tls_advice(config(pki, f'listen = ["{listen}"]\n'), time.time()))
    if told is None:
        assert not said
    elif names:
        assert said == [f"modbus.tls.listen[0]: the server's certificate is for {told}{REFUSED}"]
    else:
        assert said == [told + REFUSED]


def test_each_listener_through_tls_wants_a_name(pki: Pki) -> None:
    more = """listen = ["127.0.0.1:802", "[::1]:802"]
[[modbus.listener]]
line = "shelter-a"
listen = ["127.0.0.1:1503", "192.0.2.7:1503"]
tls = true
"""
    pki.issue("server", usage=SERVER, names=("127.0.0.1",), days=(-1, 100))
    told = list(tls_advice(config(pki, more), time.time()))
    assert [text.partition(":")[0] for text in told] == ["modbus.tls.listen[1]", "modbus.listener[0].listen[1]"]
    assert not list(tls_advice(config(pki, more.replace("tls = true", "").replace(', "[::1]:802"', "")), time.time()))


def test_a_role_without_tls_is_told() -> None:
    text = MINIMAL + '[modbus]\nwrites = true\n[[modbus.write]]\nrole = ["operator"]\npoint = ["modbus_id"]\n'
    told = advice(parse_config(text), line_budgets(parse_config(text)))
    assert "modbus.write[0].role: holds for nobody, because [modbus.tls] does not listen" in told


def test_a_rule_by_role_holds_for_nobody_else(pki: Pki) -> None:
    rules = '[modbus]\nwrites = true\n[[modbus.write]]\nrole = ["operator", "engineer"]\npoint = ["modbus_id"]\n'
    (rule,) = write_rules(parse_config(MINIMAL + rules))
    assert rule.holds_for(Requester("192.0.2.7", "operator"))
    assert rule.holds_for(Requester("192.0.2.7", "engineer"))
    assert not rule.holds_for(Requester("192.0.2.7", "Operator"))
    assert not rule.holds_for(Requester("127.0.0.1", None))
    both = rules.replace('role = ["operator", "engineer"]', 'role = ["operator"]\nsource = ["192.0.2.7/32"]')
    (rule,) = write_rules(parse_config(MINIMAL + both))
    assert rule.holds_for(Requester("192.0.2.7", "operator"))
    assert not rule.holds_for(Requester("192.0.2.8", "operator"))
    assert not rule.holds_for(Requester("192.0.2.7", None))
