"""Advice: what is allowed and yet worth a second look, and nothing about a file that is as it should be."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.service.advice import advice
from gateway.service.config import parse_config
from gateway.service.settings import line_budgets

HEAD = 'site = "ridge-07"\n'
DEVICE = '[[line.device]]\nname = "d{n}"\naddress = {n}\nunit_id = {n}\nmodel = "prostar-mppt"\n'
LINE = '[[line]]\nname = "shelter-a"\nport = "/dev/serial/by-id/usb-a"\n' + DEVICE.format(n=1)
COMMUNITY = '[[snmp.community]]\nname = "k7-reader"\nsource = ["127.0.0.0/8"]\n'
OWN_ROOT = '[snmp]\nenterprise_root = "1.3.6.1.4.1.12345.1"\n'
CLEAN = HEAD + LINE + OWN_ROOT + COMMUNITY


def advised(text: str) -> tuple[str, ...]:
    config = parse_config(text)
    return advice(config, line_budgets(config))


def test_a_file_that_is_as_it_should_be_needs_none() -> None:
    assert advised(CLEAN) == ()
    assert advised(CLEAN.replace('"/dev/serial/by-id/usb-a"', '"tcp://192.0.2.8:502"\nreply_timeout_s = 3.0')) == ()
    for name in ("by-id/usb-FTDI_FT232R_USB_UART_A50285BI-if00-port0", "by-path/pci-0000:00:14.0-usb-0:2:1.0-port0"):
        assert advised(CLEAN.replace("by-id/usb-a", name)) == ()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (HEAD + LINE + COMMUNITY, "snmp.enterprise_root: 32473 is the number for documentation"),
        (
            HEAD + LINE,
            "snmp.community, snmp.user: there is none, so nobody can read by SNMP and the port is not opened",
        ),
        (
            CLEAN.replace("/dev/serial/by-id/usb-a", "tcp://192.0.2.8:502"),
            "line[0].reply_timeout_s: 0.5 s has to do for the network",
        ),
        (CLEAN.replace("/dev/serial/by-id/usb-a", "/dev/ttyUSB0"), "line[0].port: /dev/ttyUSB0 may be another adapter"),
        (CLEAN.replace("/dev/serial/by-id/usb-a", "/dev/ttyACM0"), "line[0].port: /dev/ttyACM0 may be another adapter"),
        *(
            (CLEAN.replace("usb-a", f"usb-{name}"), "line[0].port: adapters of this kind have no serial number")
            for name in (
                "1a86_USB_Serial-if00-port0",
                "1a86_USB2.0-Serial-if00-port0",
                "Prolific_Technology_Inc._USB-Serial_Controller-if00-port0",
                "Silicon_Labs_CP2102_USB_to_UART_Bridge_Controller_0001-if00-port0",
            )
        ),
        (
            CLEAN + '[modbus]\nlisten = ["0.0.0.0:1502"]\nallow = ["10.0.0.0/8"]\n',
            "modbus.listen[0]: 0.0.0.0:1502 can be reached from other machines, and Modbus TCP has no password",
        ),
        (CLEAN + '[modbus]\nlisten = ["0.0.0.0:1502"]\n', "modbus.allow: only this machine may connect"),
        (CLEAN + '[modbus]\nallow = ["::/0"]\n', "modbus.allow[0]: ::/0 is everybody"),
        (CLEAN + "[modbus]\nallow = []\n", "modbus.allow: is empty, so nobody may connect"),
        (CLEAN + '[http]\nlisten = ["[::]:9850"]\n', "http.listen[0]: [::]:9850 can be reached from other machines"),
        (
            CLEAN.replace("[snmp]\n", '[snmp]\nlisten = ["192.0.2.1:161"]\n'),
            "snmp.listen[0]: 192.0.2.1:161 can be reached from other machines, and SNMP v2c sends the community in",
        ),
        (
            CLEAN + '[[snmp.emc1]]\nunit_id = 1\nlisten = ["192.0.2.1:162"]\n',
            "snmp.emc1[0].listen[0]: 192.0.2.1:162 can be reached from other machines, and SNMP v2c sends the",
        ),
        (CLEAN.replace("127.0.0.0/8", "0.0.0.0/0"), "snmp.community[0].source[0]: 0.0.0.0/0 is everybody"),
        (
            CLEAN.replace("127.0.0.0/8", "10.0.0.0/8").replace("k7-reader", "public"),
            "snmp.community[0].name: is one that everybody tries first",
        ),
        (CLEAN + "[cache]\nmax_age_s = 0.5\n", "line[0]: live values come every 1.0 s, which is not within cache.max"),
        (
            CLEAN + "[poll]\nnight_s = 30.0\n",
            "poll.night_s: 30 s is not within cache.max_age_s (5 s): Modbus reads",
        ),
        (
            HEAD + LINE + "".join(DEVICE.format(n=n) for n in range(2, 9)) + OWN_ROOT + COMMUNITY,
            "% of the line, so live values come every 2.",
        ),
    ],
)
def test_what_deserves_a_second_look(text: str, expected: str) -> None:
    found = advised(text)
    assert any(expected in each for each in found), found


def test_two_names_of_one_port_are_noticed(tmp_path: Path) -> None:
    real, link = tmp_path / "ttyS0", tmp_path / "by-id"
    real.touch()
    link.symlink_to(real)
    text = f'{HEAD}[[line]]\nname = "a"\nport = "{real}"\n{DEVICE.format(n=1)}'
    text += f'[[line]]\nname = "b"\nport = "{link}"\n{DEVICE.format(n=2)}{OWN_ROOT}{COMMUNITY}'
    assert advised(text) == (
        f"line[1].port: {link} is at present the same port as line[0].port; only one line can have it",
    )


def test_links_that_lead_in_a_circle_are_no_matter_of_advice(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    line = f'[[line]]\nname = "a"\nport = "{tmp_path / "a"}"\n{DEVICE.format(n=1)}'
    assert advised(f"{HEAD}{line}{OWN_ROOT}{COMMUNITY}") == ()


def test_a_face_that_is_off_needs_no_advice() -> None:
    assert advised(f"{HEAD}{LINE}[snmp]\nlisten = []\n") == ()


def test_secret_files_are_looked_at(tmp_path: Path) -> None:
    token = tmp_path / "token"
    text = f'{CLEAN}[http]\nlisten = ["0.0.0.0:9850"]\nbearer_token_file = "{token}"\n'
    [clear, unreadable] = advised(text)
    assert clear.endswith("without TLS the secret is sent in clear")
    assert unreadable == (
        f"http.bearer_token_file: {token} cannot be read: No such file or directory; the HTTP face stays closed "
        "until it can"
    )
    token.write_text("a-token-of-more-than-16")
    token.chmod(0o644)
    assert advised(text)[1:] == (f"http.bearer_token_file: {token} is open to every user of this machine (mode 644)",)
    token.chmod(0o640)
    assert len(advised(text)) == 1


def test_a_secret_file_that_cannot_even_be_looked_at_is_named(tmp_path: Path) -> None:
    """Such as one in a folder that only root may enter; root itself is refused a name that is too long."""
    token = tmp_path / ("t" * 300)
    text = f'{CLEAN}[http]\nbearer_token_file = "{token}"\n[[snmp.notify]]\naddress = "127.0.0.1:162"\n'
    text += f'community_file = "{token}"\n'
    [community, unreadable] = advised(text)
    assert community.endswith("cannot be read: File name too long; the gateway will not start without it")
    assert unreadable.endswith("cannot be read: File name too long; the HTTP face stays closed until it can")
