"""What is allowed in a configuration and yet worth a second look; `check-config` and the log show it.

Advice never keeps the gateway from starting. Each begins with the key path, as problems do.
"""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from gateway.clock import SystemClock
from gateway.core.budget import LineBudget
from gateway.devices.schema import models
from gateway.devices.unknown import AUTO
from gateway.service.http_files import unreadable_http
from gateway.service.notify import notify_advice
from gateway.service.parsing import DOCUMENTATION_ROOT, parse_listen, parse_root
from gateway.service.secret_files import open_to_all
from gateway.service.snmp import snmp_advice, snmp_on
from gateway.service.tls import tls_advice
from gateway.service.writes import write_advice

if TYPE_CHECKING:  # what it is at run time, plain.py says
    from gateway.service.schema import Config, LineTable

SATURATED = 0.95
SHORT_TIMEOUT_S = 1.0
_NAMELESS = re.compile(
    r"/dev/serial/by-id/usb-"
    r"(1a86_USB[^-]*([-_]Ser[^-]*)?|Prolific_Technology_Inc\._USB-Serial_Controller(_[A-D])?|Silicon_Labs_CP21\w+_0001)-if"
)
"""CH340, PL2303, and CP210x as they leave the factory."""

GUESSED_COMMUNITIES = ("public", "private")


def advice(config: Config, budgets: Sequence[LineBudget]) -> tuple[str, ...]:
    """What an experienced colleague would say about the file; `budgets` in the order of the lines."""
    return (*_lines(config, budgets), *_modbus(config), *_snmp(config), *notify_advice(config), *_http(config))


def _lines(config: Config, budgets: Sequence[LineBudget]) -> Iterator[str]:
    seen: dict[str, str] = {}
    for index, (line, budget) in enumerate(zip(config.line, budgets, strict=True)):
        path = f"line[{index}]"
        yield from _port(f"{path}.port", line, seen)
        if line.port.startswith("tcp://") and line.reply_timeout_s < SHORT_TIMEOUT_S:
            yield (
                f"{path}.reply_timeout_s: {line.reply_timeout_s:g} s has to do for the network, the server's own line "
                "and its own wait for a silent controller; 2 or 3 s is usual for a Modbus TCP upstream"
            )
        if budget.use_ratio is not None and budget.use_ratio > SATURATED:
            yield (
                f"{path}: polling would take {budget.use_ratio:.0%} of the line, so live values come every "
                f"{budget.live_refresh_s:.1f} s; ask for them less often (poll.live_s) or use a second line"
                + ("; the daily logs wait for idle time" if config.history.enabled else "")
            )
        if budget.live_refresh_s >= config.cache.max_age_s:
            yield (
                f"{path}: live values come every {budget.live_refresh_s:.1f} s, which is not within cache.max_age_s "
                f"({config.cache.max_age_s} s): Modbus reads will have to wait for the line"
            )
    if any(device.model == AUTO for line in config.line for device in line.device):
        yield (
            f'line.device.model: what "{AUTO}" stands for is known once the controller answered; one that is none of '
            f"{', '.join(models())} is served by Modbus TCP alone, as it is"
        )
    if config.poll.night_s is not None and config.poll.night_s >= config.cache.max_age_s > config.poll.live_s:
        yield (
            f"poll.night_s: {config.poll.night_s:g} s is not within cache.max_age_s ({config.cache.max_age_s:g} s): "
            "Modbus reads will have to wait for the line at night"
        )


def _port(path: str, line: LineTable, seen: dict[str, str]) -> Iterator[str]:
    port = line.port
    if "://" in port:
        return
    if port.startswith(("/dev/ttyUSB", "/dev/ttyACM")):
        text = f"{port} may be another adapter after the next start"
        yield f"{path}: {text}; use its name in /dev/serial/by-id or /dev/serial/by-path"
    if _NAMELESS.match(port):
        text = "adapters of this kind have no serial number of their own, so two of them share one name"
        yield f"{path}: {text}; use the name of the socket in /dev/serial/by-path"
    real = os.path.realpath(port)  # never raises, unlike `Path.resolve`: a loop of links is the port's trouble
    if real in seen:
        yield f"{path}: {port} is at present the same port as {seen[real]}; only one line can have it"
    seen.setdefault(real, path)


def _modbus(config: Config) -> Iterator[str]:
    exposed = _beyond_loopback(config.modbus.listen)
    for path, text in _named("modbus.listen", exposed):
        what = "can be reached from other machines, and Modbus TCP has no password"
        yield f"{path}: {text} {what}; keep modbus.allow narrow"
    for index, network in enumerate(config.modbus.allow):
        if ipaddress.ip_network(network).prefixlen == 0:
            yield f"modbus.allow[{index}]: {network} is everybody"
    tls = () if config.modbus.tls is None else config.modbus.tls.listen
    if (exposed or _beyond_loopback(tls)) and all(
        ipaddress.ip_network(network).is_loopback for network in config.modbus.allow
    ):
        yield "modbus.allow: only this machine may connect, so listening on other addresses is of no use"
    if config.modbus.listen and not config.modbus.allow:
        yield "modbus.allow: is empty, so nobody may connect"
    yield from write_advice(config)
    yield from tls_advice(config, SystemClock().wall())


def _snmp(config: Config) -> Iterator[str]:
    snmp = config.snmp
    if not snmp.listen:
        return
    if not snmp_on(config):
        yield "snmp.community, snmp.user: there is none, so nobody can read by SNMP and the port is not opened"
        return
    yield from snmp_advice(config)
    if parse_root(snmp.enterprise_root)[: len(DOCUMENTATION_ROOT)] == DOCUMENTATION_ROOT:
        yield "snmp.enterprise_root: 32473 is the number for documentation; use your own enterprise number in service"
    listens = [("snmp.listen", snmp.listen)]
    listens += [(f"snmp.emc1[{index}].listen", each.listen) for index, each in enumerate(snmp.emc1)]
    exposed = [found for key, texts in listens for found in _named(key, _beyond_loopback(texts))]
    for path, text in exposed if snmp.community else ():
        yield f"{path}: {text} can be reached from other machines, and SNMP v2c sends the community in clear"
    for index, community in enumerate(snmp.community):
        networks = [ipaddress.ip_network(source) for source in community.source]
        if community.name in GUESSED_COMMUNITIES and not all(network.is_loopback for network in networks):
            yield f"snmp.community[{index}].name: is one that everybody tries first"
        for number, network in enumerate(networks):
            if network.prefixlen == 0:
                yield f"snmp.community[{index}].source[{number}]: {network} is everybody"


def _http(config: Config) -> Iterator[str]:
    http = config.http
    secrets = {"basic_auth_file": http.basic_auth_file, "bearer_token_file": http.bearer_token_file}
    for path, text in _named("http.listen", _beyond_loopback(http.listen)):
        if not any(secrets.values()):
            yield f"{path}: {text} can be reached from other machines, and /metrics has no password"
        elif not http.tls_certificate:
            yield f"{path}: {text} can be reached from other machines, and without TLS the secret is sent in clear"
    for key, name in {**secrets, "tls_private_key": http.tls_private_key}.items():
        if name:
            yield from open_to_all(f"http.{key}", name)
    for problem in unreadable_http(config):
        yield f"{problem}; the HTTP face stays closed until it can"


def _beyond_loopback(listens: Sequence[str]) -> list[tuple[int, str]]:
    return [(index, text) for index, text in enumerate(listens) if not parse_listen(text).loopback]


def _named(key: str, found: Sequence[tuple[int, str]]) -> Iterator[tuple[str, str]]:
    for index, text in found:
        yield f"{key}[{index}]", text
