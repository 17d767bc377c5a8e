"""SNMP, from the configuration: settings, what is wrong with them, what is worth a second look.

Pass phrases live in files of their own and are read here. One that can be read and must not be used is a problem of
the configuration; one that cannot be read is advice while the file is checked (another user may be allowed to) and a
problem when the gateway starts.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

from gateway.errors import ConfigError
from gateway.faces.snmp.secret import Secret
from gateway.faces.snmp.settings import EVERYTHING, Community, SnmpSettings, User, View
from gateway.faces.snmp.usm import MIN_PASS_PHRASE, Auth, Credentials, Priv, fits
from gateway.service.emc1 import emc1_devices
from gateway.service.notify import receivers, unreadable_communities
from gateway.service.parsing import parse_listen, parse_oid, parse_root
from gateway.service.problems import Path, Problem, show
from gateway.service.secret_files import open_to_all, read_line, unreadable_text

if TYPE_CHECKING:  # what it is at run time, plain.py says
    from gateway.service.schema import Config, UserTable

Raw = Mapping[str, object]

_PASSWORDS = ("auth_password_file", "priv_password_file")
_AUTH = {each.label: each for each in Auth}
_PRIV = {each.label: each for each in Priv}


def snmp_settings(config: Config) -> SnmpSettings:
    """The settings of the SNMP face; without a community or user nothing listens, for nobody could be answered.

    Raises ConfigError when a pass phrase cannot be read or must not be used.
    """
    snmp = config.snmp
    views = {"": EVERYTHING} | {
        view.name: View(tuple(map(parse_oid, view.include)), tuple(map(parse_oid, view.exclude))) for view in snmp.view
    }
    credentials = [_credentials(index, user) for index, user in enumerate(snmp.user)]
    return SnmpSettings(
        listen=tuple((at.host, at.port) for at in map(parse_listen, snmp.listen)) if snmp_on(config) else (),
        communities=tuple(Community(each.name, _networks(each.source), views[each.view]) for each in snmp.community),
        users=tuple(
            User(secret, _networks(user.source), views[user.view])
            for secret, user in zip(credentials, snmp.user, strict=True)
        ),
        enterprise_root=parse_root(snmp.enterprise_root),
        contact=snmp.contact,
        location=snmp.location,
        v1=snmp.v1,
        state_dir=FilePath(config.state_dir),
        renew_engine=snmp.engine_lost == "new",
        requests_per_s=snmp.requests_per_s,
        emc1=emc1_devices(config, listen=snmp_on(config)),
        receivers=receivers(config, dict(zip((user.name for user in snmp.user), credentials, strict=True))),
        log_table=snmp.log_table,
        authentication_traps=snmp.authentication_traps,
    )


def snmp_on(config: Config) -> bool:
    """Whether anybody may read."""
    return bool(config.snmp.community or config.snmp.user)


def snmp_problems(
    users: Sequence[tuple[Path, Raw]], communities: Sequence[tuple[Path, Raw]], views: Sequence[tuple[Path, Raw]]
) -> Iterator[Problem]:
    """What is wrong with these raw tables, beyond the form."""
    known = [view.get("name") for _, view in views]
    for path, table in (*communities, *users):
        name = table.get("view", "")
        if isinstance(name, str) and name and name not in known:
            names = ", ".join(show(each) for each in known) or "none"
            yield Problem((*path, "view"), f"there is no view {show(name)}; allowed: {names}")
    for path, table in users:
        yield from _pass_phrases(path, table)
        auth, priv = _AUTH.get(str(table.get("auth", ""))), _PRIV.get(str(table.get("priv", "")))
        if auth is not None and priv is not None and not fits(auth, priv):
            text = f"{show(priv.label)} needs a longer digest than {auth.label}'s"
            yield Problem((*path, "priv"), f'{text}; allowed: a shorter key, or auth = "SHA-256" or longer')


def unreadable(config: Config) -> Iterator[str]:
    """The pass phrases and communities that cannot be read here and now, by key path."""
    for index, user in enumerate(config.snmp.user):
        for key in _PASSWORDS:
            try:
                read_pass_phrase(getattr(user, key))
            except OSError as error:
                yield f"snmp.user[{index}].{key}: {unreadable_text(getattr(user, key), error)}"
    yield from unreadable_communities(config)


def snmp_advice(config: Config) -> Iterator[str]:
    """What an experienced colleague would say about users and their secrets."""
    for text in unreadable(config):
        yield f"{text}; the gateway will not start without it"
    for index, user in enumerate(config.snmp.user):
        for number, network in enumerate(_networks(user.source)):
            if network.prefixlen == 0:
                yield f"snmp.user[{index}].source[{number}]: {network} is everybody"
        for key in _PASSWORDS:
            yield from open_to_all(f"snmp.user[{index}].{key}", getattr(user, key))


def read_pass_phrase(text: str) -> Secret:
    """The one line of the file. OSError when it cannot be read, ValueError when it is no pass phrase to use."""
    line = read_line(text)
    if len(line) < MIN_PASS_PHRASE:
        raise ValueError(f"holds fewer than {MIN_PASS_PHRASE} characters, which is too easily guessed (RFC 3414 §11.2)")
    return Secret(line)


def _pass_phrases(path: Path, table: Raw) -> Iterator[Problem]:
    for key in _PASSWORDS:
        text = table.get(key)
        if not isinstance(text, str) or not text:
            continue
        try:
            read_pass_phrase(text)
        except OSError:
            continue
        except ValueError as error:
            yield Problem((*path, key), f"{show(text)} {error}; allowed: one line of {MIN_PASS_PHRASE} or more")


def _credentials(index: int, user: UserTable) -> Credentials:
    secrets: list[Secret] = []
    for key in _PASSWORDS:
        text = getattr(user, key)
        try:
            secrets.append(read_pass_phrase(text))
        except OSError as error:
            raise ConfigError((f"snmp.user[{index}].{key}: {unreadable_text(text, error)}",)) from None
        except ValueError as error:
            raise ConfigError((f"snmp.user[{index}].{key}: {error}",)) from None
    auth, priv = secrets
    return Credentials(user.name.encode(), _AUTH[user.auth], auth, _PRIV[user.priv], priv)


def _networks(texts: Sequence[str]) -> tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, ...]:
    return tuple(ipaddress.ip_network(text) for text in texts)
