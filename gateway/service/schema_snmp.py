"""The SNMP part of the configuration file; see service/schema.py for the rules."""

from __future__ import annotations

import ipaddress
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from gateway.faces.snmp.settings import SnmpSettings
from gateway.service.keys import A_TEXT, LISTENS, LOOPBACK, NETWORKS, Key, Listens, Networks, Rate, Seconds, Table, Text
from gateway.service.parsing import parse_listen, parse_oid, parse_root

_DEFAULT = SnmpSettings()
_SECRET_FILE = "the absolute path of a file, or the name of a systemd credential"  # noqa: S105 - a description
_VIEW = 'the name of an [[snmp.view]], or "" for all that the gateway serves'
_OIDS = 'a list of OIDs such as "1.3.6.1.2.1.1"'


def _root(text: str) -> str:
    parse_root(text)
    return text


def _oid(text: str) -> str:
    parse_oid(text)
    return text


def _receiver(text: str) -> str:
    address = parse_listen(text)
    host = ipaddress.ip_address(address.host)
    if not address.port or host.is_unspecified or host.is_multicast:
        raise ValueError("nobody can be reached there")
    return str(address)


Oids = Annotated[tuple[Annotated[str, AfterValidator(_oid)], ...], Field(strict=False)]
Credential = Annotated[str, Field(pattern=r"^(/[^\x00-\x1f]+|[A-Za-z0-9_][A-Za-z0-9_.-]{0,254})$", repr=False)]
OptionalCredential = Annotated[str, Field(pattern=r"^(/[^\x00-\x1f]+|[A-Za-z0-9_][A-Za-z0-9_.-]{0,254})?$")]
ViewName = Annotated[str, Field(pattern=r"^[!-~]{0,32}$")]


class ViewTable(Table):
    """`[[snmp.view]]`: a part of the tree; where subtrees overlap, the longest one that holds an OID decides."""

    name: Annotated[
        Annotated[str, Field(pattern=r"^[!-~]{1,32}$")],
        Key("1 to 32 printable ASCII characters without blanks", "What communities and users call it; unique."),
    ]
    include: Annotated[Oids, Key(_OIDS, "Subtrees that are shown; none shows nothing.")] = ()
    exclude: Annotated[Oids, Key(_OIDS, "Subtrees of these that are not.")] = ()


class CommunityTable(Table):
    """`[[snmp.community]]`: who may read by SNMP v2c; none by default."""

    name: Annotated[
        Annotated[str, Field(pattern=r"^[!-~]{1,32}$", repr=False)],
        Key("1 to 32 printable ASCII characters without blanks", "The community name.", secret=True),
    ]
    source: Annotated[Networks, Key(NETWORKS + ", at least one", "From where it may be used.")] = Field(min_length=1)
    view: Annotated[ViewName, Key(_VIEW, "What it may read.")] = ""


class UserTable(Table):
    """`[[snmp.user]]`: who may read by SNMPv3, always with authentication and privacy; none by default."""

    name: Annotated[
        Annotated[str, Field(pattern=r"^[!-~]{1,32}$")],
        Key("1 to 32 printable ASCII characters without blanks", "The user name."),
    ]
    auth: Annotated[
        Literal["SHA-224", "SHA-256", "SHA-384", "SHA-512"],
        Key(
            '"SHA-224", "SHA-256", "SHA-384" or "SHA-512"; not MD5 and SHA-1, which are broken',
            "How messages are signed.",
        ),
    ] = "SHA-256"
    auth_password_file: Annotated[
        Credential,
        Key(_SECRET_FILE, "Holds the pass phrase for signing, 8 characters or more; read at the start."),
    ]
    priv: Annotated[
        Literal["AES-128", "AES-192", "AES-256"],
        Key(
            '"AES-128", "AES-192" or "AES-256"; not DES, which is broken, and AES-256 not with SHA-224',
            "How messages are encrypted.",
        ),
    ] = "AES-128"
    priv_password_file: Annotated[
        Credential,
        Key(_SECRET_FILE, "Holds the pass phrase for encryption, 8 characters or more; read at the start."),
    ]
    source: Annotated[Networks, Key(NETWORKS + ", at least one", "From where it may be used.")] = Field(
        default=LOOPBACK, min_length=1
    )
    view: Annotated[ViewName, Key(_VIEW, "What it may read.")] = ""


class Emc1Table(Table):
    """`[[snmp.emc1]]`: a controller that is shown also as Morningstar's EMC-1 would show it; none by default."""

    unit_id: Annotated[int, Key("the unit_id of a device whose model that converter knows", "Which controller.")] = (
        Field(ge=1, le=247)
    )
    listen: Annotated[
        Listens,
        Key(
            'a list of "IPv4:port" or "[IPv6]:port" of its own such as "127.0.0.1:1162"',
            "Where it is what is asked for (UDP); elsewhere it is by community NAME@unit_id, or by context unit_id.",
        ),
    ] = ()


class NotifyTable(Table):
    """`[[snmp.notify]]`: who is told of conditions by traps or informs; nobody by default."""

    address: Annotated[
        Annotated[str, AfterValidator(_receiver)],
        Key(
            'an IP address with a port, such as "192.0.2.7:162" or "[2001:db8::7]:162"',
            "Where the receiver listens (UDP); 162 is the usual port.",
        ),
    ]
    kind: Annotated[
        Literal["trap", "inform"],
        Key('"trap" or "inform"', "Sent once, or repeated until the receiver acknowledges it."),
    ] = "inform"
    user: Annotated[
        Annotated[str, Field(pattern=r"^[!-~]{0,32}$")],
        Key(
            'the name of an [[snmp.user]], or ""',
            "Send by SNMPv3 as this user, signed and encrypted; either this or community_file.",
        ),
    ] = ""
    community_file: Annotated[
        OptionalCredential,
        Key(f'{_SECRET_FILE}, or ""', "Holds the community to send with by SNMP v2c; either this or user."),
    ] = ""
    severity: Annotated[
        Literal["info", "warning", "critical"],
        Key('"info", "warning" or "critical"', "Nothing less severe is told."),
    ] = "info"
    hold_s: Annotated[
        Seconds,
        Key(
            "0.0 to 86400.0",
            "The receiver is told of one condition again so much later at the earliest; what holds then is what it is"
            " told.",
        ),
    ] = Field(default=30.0, ge=0.0, le=86400.0)
    per_minute: Annotated[
        Rate,
        Key("1.0 to 6000.0", "Notifications in the long run; a minute's worth may come at once. The rest waits."),
    ] = Field(default=60.0, ge=1.0, le=6000.0)


class SnmpTable(Table):
    """`[snmp]`: the SNMP face; its port is opened only when there is a community or a user."""

    listen: Annotated[Listens, Key(LISTENS, "Where the SNMP agent answers (UDP).")] = ("127.0.0.1:1161",)
    enterprise_root: Annotated[
        Annotated[str, AfterValidator(_root)],
        Key(
            'an OID of yours below 1.3.6.1.4.1, such as "1.3.6.1.4.1.32473.1"; never 33333, which is Morningstar\'s',
            "Where the MIB hangs; 32473 is for documentation, use your own enterprise number in service.",
        ),
    ] = "1.3.6.1.4.1.32473.1"
    contact: Annotated[Text, Key(A_TEXT, "sysContact: whom to call.")] = ""
    location: Annotated[Text, Key(A_TEXT, "sysLocation: where the gateway is.")] = ""
    v1: Annotated[bool, Key("true or false", "Communities may be used with SNMPv1 too.")] = False
    requests_per_s: Annotated[
        Rate,
        Key(
            "1.0 to 1000000.0",
            "Requests of one address in the long run; ten seconds' worth may come at once."
            " One in unusual BER counts once more for every 22 octets.",
        ),
    ] = Field(default=_DEFAULT.requests_per_s, ge=1.0, le=1e6)
    engine_lost: Annotated[
        Literal["new", "refuse"],
        Key(
            '"new" or "refuse"',
            "When the SNMPv3 engine id and boots in state_dir are missing or damaged: take a new engine id and say so,"
            " or leave SNMPv3 off. The first start needs a new one.",
        ),
    ] = "new"
    log_table: Annotated[
        bool,
        Key(
            "true or false",
            "Show the newest 256 days of each controller's log, when there is a history: 3300 cells a controller,"
            " behind everything else.",
        ),
    ] = True
    community: Annotated[
        Annotated[tuple[CommunityTable, ...], Field(strict=False)],
        Key("[[snmp.community]] tables", "Who may read by SNMP v2c; without one nobody can."),
    ] = ()
    user: Annotated[
        Annotated[tuple[UserTable, ...], Field(strict=False)],
        Key("[[snmp.user]] tables", "Who may read by SNMPv3; without one nobody can."),
    ] = ()
    view: Annotated[
        Annotated[tuple[ViewTable, ...], Field(strict=False)],
        Key("[[snmp.view]] tables", "Parts of the tree, for communities and users that may not read all."),
    ] = ()
    emc1: Annotated[
        Annotated[tuple[Emc1Table, ...], Field(strict=False)],
        Key("[[snmp.emc1]] tables", "Controllers that are shown also as Morningstar's EMC-1 would show them."),
    ] = ()
    authentication_traps: Annotated[
        bool,
        Key("true or false", "Receivers are told of wrong communities and pass phrases, once a minute at most."),
    ] = False
    notify: Annotated[
        Annotated[tuple[NotifyTable, ...], Field(strict=False)],
        Key("[[snmp.notify]] tables", "Who is told of conditions by traps or informs; without one nobody is."),
    ] = ()
