"""Receivers of traps and informs, from the configuration: settings, what is wrong with them, what is worth a look.

A community lives in a file of its own, as a pass phrase does (service/snmp.py).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from gateway.core.conditions import Severity
from gateway.errors import ConfigError
from gateway.faces.snmp.secret import Secret
from gateway.faces.snmp.settings import Receiver
from gateway.faces.snmp.usm import Credentials
from gateway.service.parsing import DOCUMENTATION_ROOT, parse_listen, parse_root
from gateway.service.problems import Path, Problem, show
from gateway.service.secret_files import open_to_all, read_line, unreadable_text

if TYPE_CHECKING:  # what it is at run time, plain.py says
    from gateway.service.schema import Config

Raw = Mapping[str, object]

COMMUNITY = "one line of 1 to 32 printable ASCII characters without blanks"


def receivers(config: Config, credentials: Mapping[str, Credentials]) -> tuple[Receiver, ...]:
    """The receivers of the file; `credentials` are the users' by name. ConfigError for a community that cannot be."""
    found = []
    for index, table in enumerate(config.snmp.notify):
        address = parse_listen(table.address)
        community = None
        if table.community_file:
            key = f"snmp.notify[{index}].community_file"
            try:
                community = read_community(table.community_file)
            except OSError as error:
                raise ConfigError((f"{key}: {unreadable_text(table.community_file, error)}",)) from None
            except ValueError as error:
                raise ConfigError((f"{key}: {error}; allowed: {COMMUNITY}",)) from None
        found.append(
            Receiver(
                address.host,
                address.port,
                table.kind == "inform",
                community,
                credentials[table.user] if table.user else None,
                Severity[table.severity.upper()],
                table.hold_s,
                table.per_minute,
            )
        )
    return tuple(found)


def notify_problems(tables: Sequence[tuple[Path, Raw]], users: Sequence[tuple[Path, Raw]]) -> Iterator[Problem]:
    """What is wrong with these raw tables, beyond the form."""
    known = [user.get("name") for _, user in users]
    seen: dict[tuple[str, str, str], Path] = {}
    for path, table in tables:
        user, community = table.get("user", ""), table.get("community_file", "")
        if not isinstance(user, str) or not isinstance(community, str):
            continue
        if bool(user) == bool(community):
            which = "both user and community_file are there" if user else "neither user nor community_file is there"
            yield Problem(path, f"{which}; allowed: one of the two")
        elif user and user not in known:
            names = ", ".join(show(each) for each in known) or "none"
            yield Problem((*path, "user"), f"there is no user {show(user)}; allowed: {names}")
        elif community:
            try:
                read_community(community)
            except OSError:
                pass  # another user may be allowed to read it: advice
            except ValueError as error:
                yield Problem((*path, "community_file"), f"{error}; allowed: {COMMUNITY}")
        address = table.get("address")
        if isinstance(address, str):
            if (address, user, community) in seen:
                yield Problem(path, "is the same receiver with the same name again; allowed: each once")
            seen.setdefault((address, user, community), path)


def unreadable_communities(config: Config) -> Iterator[str]:
    """The communities that cannot be read here and now, by key path."""
    for index, table in enumerate(config.snmp.notify):
        if table.community_file:
            try:
                read_community(table.community_file)
            except OSError as error:
                yield f"snmp.notify[{index}].community_file: {unreadable_text(table.community_file, error)}"


def notify_advice(config: Config) -> Iterator[str]:
    """What an experienced colleague would say about the receivers."""
    snmp = config.snmp
    alone = not (snmp.community or snmp.user)
    if alone:  # otherwise told with the other secrets of SNMP
        for text in unreadable_communities(config):
            yield f"{text}; the gateway will not start without it"
    for index, table in enumerate(snmp.notify):
        if table.community_file:
            key = f"snmp.notify[{index}].community_file"
            if not parse_listen(table.address).loopback:
                yield f"{key}: SNMP v2c sends the community and all else in clear to {table.address}"
            yield from open_to_all(key, table.community_file)
    if snmp.notify and alone and parse_root(snmp.enterprise_root)[: len(DOCUMENTATION_ROOT)] == DOCUMENTATION_ROOT:
        yield "snmp.enterprise_root: 32473 is for documentation; use your own enterprise number in service"
    if snmp.authentication_traps and not snmp.notify:
        yield "snmp.authentication_traps: there is no [[snmp.notify]], so nobody is told"


def read_community(text: str) -> Secret:
    """The community in the file. OSError when it cannot be read, ValueError when it cannot be one."""
    line = read_line(text)
    if not re.fullmatch(rb"[!-~]{1,32}", line):
        raise ValueError("holds no community")
    return Secret(line)
