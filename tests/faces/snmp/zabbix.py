"""How Zabbix reads an EMC-1: what its templates for the ProStar MPPT and the TriStar MPPT do with the answers.

- Floats are texts, taken as numbers; one that is none makes its item unsupported.
- Amp-hours are multiplied by 0.1.
- An octet string that is not printable comes as hexadecimal octets with blanks between. The template takes the blanks
  out, reads one number of it, and tests bit after bit from 0x80000000 downwards against its list of names. So two
  octets can never show one of the first sixteen faults.
- State enumerations are compared by number.
"""

from __future__ import annotations

import re
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


# The template for the TriStar MPPT: OIDs are 1.3.6.1.4.1.33333.2.N.0. Its integers are multiplied, most of them are cut
# after two decimals by an expression that takes no minus sign, and its scripts read bit fields as above.

TRISTAR_MULTIPLIERS = {
    **dict.fromkeys((30, 34, 35, 36, 45), 0.005493164063),
    **dict.fromkeys((31, 42), 0.00244140625),
    **dict.fromkeys((33, 44), 0.1098632813),
    50: 0.1,
    **dict.fromkeys((46, 48, 49, 52), 1.0),
}
TRISTAR_CUT = frozenset({30, 31, 33, 34, 35, 36, 42, 44, 45})


def tristar_value(number: int, text: str) -> float | None:
    """The value of one of its items; None when it becomes unsupported."""
    value = int(text) * TRISTAR_MULTIPLIERS[number]
    if number not in TRISTAR_CUT:
        return value
    cut = re.match(r"^(\d+)(\.\d{1,2})?", f"{value:.6f}")
    return None if cut is None else float(cut[0])
