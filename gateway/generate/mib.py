"""The MIB modules and their lock, from `faces/snmp/layout.py` (docs/adr/0001).

Rules: SMIv2 by RFC 4181 - one prefix, every object in a group, every group in the compliance. Nothing is ever
renumbered, renamed or retyped, nor shown in other units: `mibs/oids.lock` lists what was once published, one
`OID name syntax units` a line, and `mib_outputs` refuses to write a MIB that lacks or changes a line of it.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from gateway.errors import MapError
from gateway.faces.snmp import notifications
from gateway.faces.snmp.layout import Layout, shipped_layout
from gateway.faces.snmp.notifications import NotificationType
from gateway.faces.snmp.objects import Convention, Index, ObjectType, ScalarGroup, Syntax, Table
from gateway.faces.snmp.settings import DEFAULT_ROOT, Oid

REG = "PROSTAR-GATEWAY-REG-MIB"
TC = "PROSTAR-GATEWAY-TC-MIB"
MIB = "PROSTAR-GATEWAY-MIB"
LOCK = "mibs/oids.lock"

REVISIONS: tuple[tuple[str, str], ...] = (
    ("202611220000Z", "First version: gateway, lines, devices and their values, conditions, notifications."),
)
"""When the modules changed and how, newest first; a change of the lock needs a new entry."""

_WIDTH = 100
_ENTERPRISES: Oid = (1, 3, 6, 1, 4, 1)
_ASCII = {
    "°C": "degrees Celsius",
    "°": " degrees",
    "Ω": "ohms",
    "×": "x",
    "–": "-",
    "−": "-",
    "’": "'",
    '"': "'",  # would end the text clause
}

_TEXT_CONVENTION = """\
PgwText ::= TEXTUAL-CONVENTION
    DISPLAY-HINT "255t"
    STATUS       current
    DESCRIPTION
        "Words for people, in UTF-8."
    SYNTAX       OCTET STRING (SIZE (0..255))
"""

_PARENTS = """\
pgwNotifications OBJECT IDENTIFIER ::= { pgwMIB 0 }
pgwObjects       OBJECT IDENTIFIER ::= { pgwMIB 1 }
pgwConformance   OBJECT IDENTIFIER ::= { pgwMIB 2 }
"""

_LOCK_HEAD = """\
# OID, name, syntax and units of everything ever published; lines are only added, by `prostar-gateway generate`.
"""

_REPOSITORY = Path(__file__).parents[2]


def mib_outputs(root: Oid = DEFAULT_ROOT, locked: str | None = None) -> dict[str, str]:
    """The files of `mibs/` by path from the repository: three modules and the lock.

    Args:
        root: the OID of PROSTAR-GATEWAY-REG-MIB, below 1.3.6.1.4.1.
        locked: the published lock; by default that of this source tree, when there is one.

    Raises:
        MapError: a published object is missing, renumbered, renamed or retyped; all of them are named.
    """
    if locked is None:
        path = _REPOSITORY / LOCK
        locked = path.read_text(encoding="utf-8") if path.exists() else ""
    described = shipped_layout(root)
    return {
        f"mibs/{REG}.txt": _registration(described),
        f"mibs/{TC}.txt": _conventions(described),
        f"mibs/{MIB}.txt": _objects(described),
        # The lock is kept under the default root: moving the MIB under another number changes none of its lines.
        LOCK: lock(shipped_layout(), locked),
    }


def lock(described: Layout, published: str) -> str:
    """`published` with the lines of new objects behind it; MapError names every line that would change."""
    current = {line.split(" ", 1)[0]: line for line in _lock_lines(described)}
    kept = [line for line in published.splitlines() if line and not line.startswith("#")]
    problems = []
    for line in kept:
        now = current.get(line.split(" ", 1)[0])
        if now is None:
            problems.append(f"{LOCK}: {line}: is gone; allowed: objects are only added")
        elif now != line:
            problems.append(f"{LOCK}: {line}: would become {now!r}; allowed: objects are only added")
    names: dict[str, str] = {}
    for line in current.values():
        oid, name, _ = line.split(" ", 2)
        if names.setdefault(name, oid) != oid:
            problems.append(f"{LOCK}: {name} would be both {names[name]} and {oid}; allowed: one name, one object")
    if problems:
        raise MapError("\n".join(problems))
    added = [line for line in current.values() if line not in set(kept)]
    return _LOCK_HEAD + "".join(line + "\n" for line in (*kept, *added))


def _lock_lines(described: Layout) -> Iterator[str]:
    for group in (*described.groups, described.notify):
        for each in group.objects:
            yield _lock_line((*group.base, each.number, 0), each)
    for kind in notifications.TYPES:
        yield f"{_dotted((*described.notifications, kind.number))} {kind.name} {','.join(notifications.OBJECTS)}"
    for table in described.tables:
        for each in table.columns:
            yield _lock_line((*table.base, 1, each.number), each)
    for convention in described.conventions:
        for number, name in convention.labels:
            # Labels have no OID; the convention's name and the number stand where one would.
            yield f"{convention.name}.{number} {convention.name}.{name} {convention.syntax}"


def _lock_line(oid: Oid, each: ObjectType) -> str:
    return f"{_dotted(oid)} {each.name} {_syntax(each)} {each.units}".rstrip()


def _dotted(oid: Oid) -> str:
    return ".".join(map(str, oid))


def _syntax(each: ObjectType) -> str:
    return each.convention.name if each.convention else each.syntax.value


def _registration(described: Layout) -> str:
    if described.root[: len(_ENTERPRISES)] != _ENTERPRISES or len(described.root) <= len(_ENTERPRISES):
        raise MapError(f"enterprise root {_dotted(described.root)}; allowed: an OID below 1.3.6.1.4.1")
    # Every arc between enterprises and the root gets a node of its own, the last one is the module's identity.
    *above, last = described.root[len(_ENTERPRISES) :]
    parent = "enterprises"
    nodes = []
    for depth, arc in enumerate(above):
        name = f"pgwAbove{depth + 1}" if depth else "pgwOrganization"
        nodes.append(f"{name} OBJECT IDENTIFIER ::= {{ {parent} {arc} }}\n")
        parent = name
    return _module(
        REG,
        {"SNMPv2-SMI": ("MODULE-IDENTITY", "OBJECT-IDENTITY", "enterprises")},
        [
            _identity("pgwRegMIB", "Where everything of prostar-gateway is registered.", f"{parent} {last}"),
            *nodes,
            _node("pgwModules", "pgwRegMIB 1", "Identities of the other modules."),
            _node("pgwProducts", "pgwRegMIB 2", "Values of sysObjectID."),
            _node("pgwGatewayProduct", "pgwProducts 1", "prostar-gateway, the program."),
        ],
    )


def _conventions(described: Layout) -> str:
    return _module(
        TC,
        {
            "SNMPv2-SMI": ("MODULE-IDENTITY",),
            "SNMPv2-TC": ("TEXTUAL-CONVENTION",),
            REG: ("pgwModules",),
        },
        [
            _identity("pgwTcMIB", "Textual conventions of prostar-gateway.", "pgwModules 1"),
            _TEXT_CONVENTION,
            *(_convention(convention) for convention in described.conventions),
        ],
    )


def _convention(convention: Convention) -> str:
    kind = "INTEGER" if convention.syntax is Syntax.ENUMERATION else "BITS"
    labels = ",\n".join(f"        {name}({number})" for number, name in convention.labels)
    return (
        f"{convention.name} ::= TEXTUAL-CONVENTION\n"
        "    STATUS       current\n"
        f"    DESCRIPTION\n{_text(convention.description)}\n"
        f"    SYNTAX       {kind} {{\n{labels}\n    }}\n"
    )


def _objects(described: Layout) -> str:
    everything = [*(each for group in described.groups for each in group.objects)]
    everything += [each for table in described.tables for each in table.columns]
    everything += described.notify.objects
    used = {each.syntax.value for each in everything if not each.convention} - {Syntax.TEXT, Syntax.TIME_STAMP}
    imports = {
        "SNMPv2-SMI": ("MODULE-IDENTITY", "OBJECT-TYPE", "NOTIFICATION-TYPE", *sorted({*used, "Unsigned32"})),
        "SNMPv2-TC": ("TimeStamp",),
        "SNMPv2-CONF": ("MODULE-COMPLIANCE", "OBJECT-GROUP", "NOTIFICATION-GROUP"),
        REG: ("pgwModules",),
        TC: ("PgwText", *(convention.name for convention in described.conventions)),
    }
    parts = [
        _identity("pgwMIB", "ProStar solar charge controllers behind prostar-gateway. Read-only.", "pgwModules 2"),
        _PARENTS,
    ]
    notify = described.notify
    members: list[tuple[int, ScalarGroup | Table]] = [(each.number, each) for each in (*described.groups, notify)]
    members += [(each.number, each) for each in described.tables]
    groups: list[tuple[int, str, str, Sequence[ObjectType]]] = []
    for number, member in sorted(members, key=lambda pair: pair[0]):
        if isinstance(member, ScalarGroup):
            parts += _scalars(member, "accessible-for-notify" if member is notify else "read-only")
            groups.append((number, f"{member.name}Group", member.description, member.objects))
        else:
            parts += _table(member)
            groups.append((number, f"{member.name}Group", member.description, member.columns))
    parts += [_notification(kind) for kind in notifications.TYPES]
    parts += _conformance(groups)
    return _module(MIB, imports, parts)


def _notification(kind: NotificationType) -> str:
    listed = ",\n".join(f"        {name}" for name in notifications.OBJECTS)
    return (
        f"{kind.name} NOTIFICATION-TYPE\n"
        f"    OBJECTS {{\n{listed}\n    }}\n"
        "    STATUS      current\n"
        f"    DESCRIPTION\n{_text(kind.description)}\n"
        f"    ::= {{ pgwNotifications {kind.number} }}\n"
    )


def _scalars(group: ScalarGroup, access: str) -> Iterator[str]:
    yield f"-- {group.description}\n\n{group.name} OBJECT IDENTIFIER ::= {{ pgwObjects {group.number} }}\n"
    for each in group.objects:
        yield _object(each, group.name, access)


def _table(table: Table) -> Iterator[str]:
    entry = f"{table.name}Entry"
    row = entry[:1].upper() + entry[1:]
    own = table.indexes
    if not own and table.index_of is None:
        about = "Unit id of the device." if table.index.endswith("UnitId") else "Position in the configuration."
        own = (Index(1, table.index, 1, 247 if table.index.endswith("UnitId") else 65535, about),)
    named = ", ".join(([] if table.index_of is None else [table.index]) + [each.name for each in own])
    yield (
        f"{table.name}Table OBJECT-TYPE\n"
        f"    SYNTAX      SEQUENCE OF {row}\n"
        "    MAX-ACCESS  not-accessible\n"
        "    STATUS      current\n"
        f"    DESCRIPTION\n{_text(table.description)}\n"
        f"    ::= {{ pgwObjects {table.number} }}\n"
    )
    yield (
        f"{entry} OBJECT-TYPE\n"
        f"    SYNTAX      {row}\n"
        "    MAX-ACCESS  not-accessible\n"
        "    STATUS      current\n"
        f"    DESCRIPTION\n{_text(f'A row of {table.name}Table.')}\n"
        f"    INDEX       {{ {named} }}\n"
        f"    ::= {{ {table.name}Table 1 }}\n"
    )
    fields = [(each.name, "Unsigned32") for each in own]
    fields += [(each.name, "BITS" if _syntax(each) == "Bits" else _syntax(each)) for each in table.columns]
    yield f"{row} ::= SEQUENCE {{\n" + ",\n".join(f"    {name:<32} {syntax}" for name, syntax in fields) + "\n}\n"
    for index in own:
        yield (
            f"{index.name} OBJECT-TYPE\n"
            f"    SYNTAX      Unsigned32 ({index.least}..{index.most})\n"
            "    MAX-ACCESS  not-accessible\n"
            "    STATUS      current\n"
            f"    DESCRIPTION\n{_text(index.description)}\n"
            f"    ::= {{ {entry} {index.number} }}\n"
        )
    for each in table.columns:
        yield _object(each, entry)


def _object(each: ObjectType, parent: str, access: str = "read-only") -> str:
    units = f'    UNITS       "{_ascii(each.units)}"\n' if each.units else ""
    return (
        f"{each.name} OBJECT-TYPE\n"
        f"    SYNTAX      {_syntax(each)}\n"
        f"{units}"
        f"    MAX-ACCESS  {access}\n"
        "    STATUS      current\n"
        f"    DESCRIPTION\n{_text(each.description)}\n"
        f"    ::= {{ {parent} {each.number} }}\n"
    )


def _conformance(groups: Sequence[tuple[int, str, str, Sequence[ObjectType]]]) -> Iterator[str]:
    yield (
        "pgwGroups      OBJECT IDENTIFIER ::= { pgwConformance 1 }\n"
        "pgwCompliances OBJECT IDENTIFIER ::= { pgwConformance 2 }\n"
    )
    for number, name, about, objects in groups:
        listed = ",\n".join(f"        {each.name}" for each in objects)
        yield (
            f"{name} OBJECT-GROUP\n"
            f"    OBJECTS {{\n{listed}\n    }}\n"
            "    STATUS      current\n"
            f"    DESCRIPTION\n{_text(about)}\n"
            f"    ::= {{ pgwGroups {number} }}\n"
        )
    listed = ",\n".join(f"        {kind.name}" for kind in notifications.TYPES)
    yield (
        "pgwNotificationGroup NOTIFICATION-GROUP\n"
        f"    NOTIFICATIONS {{\n{listed}\n    }}\n"
        "    STATUS      current\n"
        f"    DESCRIPTION\n{_text('What receivers are told.')}\n"
        "    ::= { pgwGroups 1000 }\n"
    )
    mandatory = ",\n".join(f"        {name}" for name in (*(name for _, name, _, _ in groups), "pgwNotificationGroup"))
    yield (
        "pgwCompliance MODULE-COMPLIANCE\n"
        "    STATUS      current\n"
        f"    DESCRIPTION\n{_text('What every gateway serves.')}\n"
        "    MODULE\n"
        f"    MANDATORY-GROUPS {{\n{mandatory}\n    }}\n"
        "    ::= { pgwCompliances 1 }\n"
    )


def _identity(name: str, about: str, parent: str) -> str:
    revisions = "".join(f'    REVISION     "{when}"\n    DESCRIPTION\n{_text(what)}\n' for when, what in REVISIONS)
    return (
        f"{name} MODULE-IDENTITY\n"
        f'    LAST-UPDATED "{REVISIONS[0][0]}"\n'
        '    ORGANIZATION "The prostar-gateway project"\n'
        "    CONTACT-INFO\n"
        f"{_text('The operator of this gateway: see sysContact.')}\n"
        f"    DESCRIPTION\n{_text(about)}\n"
        f"{revisions}"
        f"    ::= {{ {parent} }}\n"
    )


def _node(name: str, parent: str, about: str) -> str:
    return f"{name} OBJECT-IDENTITY\n    STATUS      current\n    DESCRIPTION\n{_text(about)}\n    ::= {{ {parent} }}\n"


def _module(name: str, imports: dict[str, tuple[str, ...]], parts: Iterable[str]) -> str:
    wanted = "\n".join(
        textwrap.fill(", ".join(names), _WIDTH, initial_indent="    ", subsequent_indent="    ")
        + f"\n        FROM {module}"
        for module, names in imports.items()
    )
    return (
        "-- Generated by `prostar-gateway generate`; do not edit.\n\n"
        f"{name} DEFINITIONS ::= BEGIN\n\nIMPORTS\n{wanted};\n\n" + "\n".join(parts) + "\nEND\n"
    )


def _text(words: str) -> str:
    """A quoted, wrapped, pure ASCII text clause."""
    lines = textwrap.wrap(_ascii(words), _WIDTH - 10)
    return textwrap.indent('"' + "\n ".join(lines) + '"', "        ")


def _ascii(words: str) -> str:
    for found, instead in _ASCII.items():
        words = words.replace(found, instead)
    if not words.isascii():
        strange = re.sub(r"[\x00-\x7f]", "", words)
        raise MapError(f"{words!r}: a MIB is written in ASCII; unknown here: {strange}")
    return words
