"""From the configuration to what lines, devices and faces are made of."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from gateway.core.budget import WATCH_S, LineBudget, line_budget
from gateway.core.identity import Identity
from gateway.core.ratelimit import ClientRate, LineRates
from gateway.core.settings import LineSettings, PollSettings, UpstreamSettings
from gateway.core.site import Device
from gateway.devices.agreement import all_maps
from gateway.devices.model import DeviceMap
from gateway.devices.schema import load_map
from gateway.devices.unknown import AUTO, UNKNOWN
from gateway.faces.http.settings import HttpSettings
from gateway.faces.modbus.settings import LineListen, ModbusSettings, Network, RateSettings
from gateway.history.settings import HistorySettings
from gateway.service.parsing import parse_listen
from gateway.service.tls import tls_settings
from gateway.service.writes import line_writes, write_rules, write_settings

if TYPE_CHECKING:  # what it is at run time, plain.py says
    from gateway.service.schema import Config, LineTable, RateTable

Pairs = tuple[tuple[str, int], ...]

STOP_GRACE_S = 4.0
"""How long a stopping Modbus face waits for transactions on the wire; the supervisor waits half a second longer."""
STOP_SCRAPES_S = 1.0
"""The same of the HTTP face, for scrapes under way."""


def line_settings(config: Config) -> tuple[LineSettings, ...]:
    """The settings of every line, in the order of the file."""
    rules = write_rules(config)
    poll = PollSettings(config.poll.live_s, config.poll.settings_s, config.poll.night_s)
    return tuple(
        LineSettings(
            name=line.name,
            index=number,
            port=line.port,
            baudrate=line.baudrate,
            bytesize=line.bytesize,
            parity=line.parity,
            stopbits=line.stopbits,
            reply_timeout_s=line.reply_timeout_s,
            retries=line.retries,
            quarantine_s=line.quarantine_s,
            gap_s=line.gap_s,
            queue_limit=line.queue_limit,
            queue_limit_s=line.queue_limit_s,
            writes=line_writes(rules, line_devices(line)),
            poll=poll,
            upstream=_upstream(line),
        )
        for number, line in enumerate(config.line, start=1)
    )


def _upstream(line: LineTable) -> UpstreamSettings | None:
    """Where a `tcp://` line leads; None: it is a serial port."""
    parts = urlsplit(line.port)
    if parts.scheme != "tcp" or parts.hostname is None or parts.port is None:
        return None
    return UpstreamSettings(
        parts.hostname,
        parts.port,
        pipelining=line.pipelining,
        connections=line.connections,
        connect_timeout_s=line.connect_timeout_s,
    )


def line_sites(config: Config) -> dict[str, str]:
    """The lines behind which there is another site, and its name."""
    return {line.name: line.site for line in config.line if line.site is not None}


def line_devices(line: LineTable) -> tuple[Device, ...]:
    """New devices for one line, in the order of the file; their line sets itself."""
    return tuple(
        Device(
            name=device.name,
            unit_id=device.unit_id,
            address=device.address,
            map=UNKNOWN if device.model == AUTO else load_map(device.model),
            auto=device.model == AUTO,
            decode=dict(device.decode),
            expected=Identity(product=device.product, serial_number=device.serial_number),
            reply_timeout_s=device.reply_timeout_s,
        )
        for device in line.device
    )


def maps_of(model: str) -> tuple[DeviceMap, ...]:
    """The maps that a configured model stands for: every one where it is to be found."""
    return all_maps() if model == AUTO else (load_map(model),)


def _heaviest(maps: Sequence[DeviceMap], settings: LineSettings) -> DeviceMap:
    """The one whose polls take most of a line's time: what a model that is still to be found may take."""
    return max(maps, key=lambda device_map: line_budget(settings, [device_map]).use_ratio or 0.0)


def line_budgets(config: Config) -> tuple[LineBudget, ...]:
    """What each line can carry, in the order of the file."""
    return tuple(
        line_budget(
            settings,
            [_heaviest(maps_of(device.model), settings) for device in line.device],
            timeouts_s=[device.reply_timeout_s for device in line.device if device.reply_timeout_s is not None],
        )
        for settings, line in zip(line_settings(config), config.line, strict=True)
    )


def modbus_settings(config: Config) -> ModbusSettings:
    """The settings of the Modbus TCP face."""
    modbus = config.modbus
    deadline_s = max(budget.reply_deadline_s for budget in line_budgets(config))
    return ModbusSettings(
        listen=_pairs(modbus.listen),
        lines=tuple(LineListen(_pairs(listener.listen), listener.line, listener.tls) for listener in modbus.listener),
        max_connections=modbus.max_connections,
        max_per_client=modbus.max_per_client,
        priority=_networks(modbus.priority),
        rate=_rates(modbus.rate),
        allow=_networks(modbus.allow),
        max_age_s=config.cache.max_age_s,
        writes=write_settings(config),
        tls=tls_settings(config),
        status_unit=modbus.status_unit,
        strict_map=modbus.strict_map,
        reply_timeout_s=deadline_s - WATCH_S,
        stop_grace_s=STOP_GRACE_S,
    )


def http_settings(config: Config) -> HttpSettings:
    """The settings of the HTTP face."""
    http = config.http
    return HttpSettings(
        listen=_pairs(http.listen),
        stop_grace_s=STOP_SCRAPES_S,
        basic_auth_file=http.basic_auth_file,
        bearer_token_file=http.bearer_token_file,
        tls_certificate=http.tls_certificate,
        tls_private_key=http.tls_private_key,
    )


def history_settings(config: Config) -> HistorySettings:
    """The settings of the history; whether there is one is `config.history.enabled`."""
    return HistorySettings(Path(config.state_dir), interval_s=config.history.interval_h * 3600)


def _rates(rate: RateTable) -> RateSettings:
    defaults = RateSettings()
    named = tuple(
        (_networks(table.source), ClientRate(table.requests_per_s, table.client_line_per_s)) for table in rate.network
    )
    # What holds for this machine itself comes last, and is as strict as the file about its use of the lines.
    own = tuple(
        (networks, ClientRate(local.requests_per_s, rate.client_line_per_s)) for networks, local in defaults.networks
    )
    return RateSettings(
        client=ClientRate(rate.requests_per_s, rate.client_line_per_s),
        lines=LineRates(rate.device_per_s, rate.line_per_s),
        burst_s=rate.burst_s,
        networks=named + own,
    )


def _networks(texts: tuple[str, ...]) -> tuple[Network, ...]:
    return tuple(ipaddress.ip_network(text) for text in texts)


def _pairs(listens: tuple[str, ...]) -> Pairs:
    return tuple((address.host, address.port) for address in map(parse_listen, listens))
