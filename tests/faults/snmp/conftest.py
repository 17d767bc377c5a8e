"""The rows of the SNMP face use the site in memory and the agent of its own tests."""

from __future__ import annotations

from tests.faces.snmp.conftest import agent, ask, clock, device_map, make_agent, mib_path, modbus_stats, settings, site

__all__ = ["agent", "ask", "clock", "device_map", "make_agent", "mib_path", "modbus_stats", "settings", "site"]
