"""How Zabbix reads an EMC-1: what its template for the ProStar MPPT does with the answers.

- Floats are texts, taken as numbers; one that is none makes its item unsupported.
- Amp-hours are multiplied by 0.1.
- An octet string that is not printable comes as hexadecimal octets with blanks between. The template takes the blanks
  out, reads one number of it, and tests bit after bit from 0x80000000 downwards against its list of names. So two
  octets can never show one of the first sixteen faults.
- State enumerations are compared by number.
"""

from __future__ import annotations

from collections.abc import Sequence

AH_MULTIPLIER = 0.1


def octets(value: bytes) -> str:
    """An octet string as the SNMP poller hands it to preprocessing."""
    printable = all(0x20 <= octet < 0x7F for octet in value)
    return value.decode() if printable else " ".join(f"{octet:02X}" for octet in value)


def flags(text: str, names: Sequence[str]) -> list[str]:
    """The names that the template's script finds."""
    number = int(text.replace(" ", ""), 16)
    return [name for position, name in enumerate(names) if number & (1 << 31 >> position)]


def number(text: str) -> float | None:
    """The value of a numeric item; None when it becomes unsupported."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if value == value else None  # noqa: PLR0124 - NaN, which Zabbix does not store
