"""What programs of net-snmp print beside what they are asked for."""

from __future__ import annotations


def without_new_folders(output: str) -> str:
    """The output without the lines about the folders that net-snmp makes when a user first runs one of its programs."""
    return "".join(line for line in output.splitlines(keepends=True) if not line.startswith("Created directory: "))
