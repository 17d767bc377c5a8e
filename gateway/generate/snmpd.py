"""The lines for the host's own agent, by which it hands the gateway's tree on."""

from __future__ import annotations

from gateway.faces.snmp.entity import ENTITY_MIB, ENTITY_SENSOR_MIB
from gateway.faces.snmp.settings import DEFAULT_ROOT, Oid

PATH = "deploy/nms/snmpd.conf"

_TEXT = """\
# Made by `prostar-gateway generate`. Do not edit.
# The gateway behind the host's own SNMP agent (net-snmp's snmpd), which keeps port 161: add these lines to
# /etc/snmp/snmpd.conf and restart snmpd. Whoever may read the host then reads the gateway too, by the same credentials.
#
# The gateway needs a community for this machine alone; give it in both places:
#
#   [[snmp.community]]
#   name = "CHANGE-ME"
#   source = ["127.0.0.1/32"]
#
# An access view of snmpd that names subtrees has to name these too. Debian's own is one:
#
#   view systemonly included .{root}
#   view systemonly included .{entity}
#   view systemonly included .{sensors}

# snmp.enterprise_root
proxy -v 2c -c CHANGE-ME 127.0.0.1:1161 .{root}

# ENTITY-MIB and ENTITY-SENSOR-MIB, by which LibreNMS graphs volts, amperes, watts and degrees.
proxy -v 2c -c CHANGE-ME 127.0.0.1:1161 .{entity}
proxy -v 2c -c CHANGE-ME 127.0.0.1:1161 .{sensors}
"""


def snmpd_outputs(root: Oid = DEFAULT_ROOT) -> dict[str, str]:
    """The lines, by path from the repository; `root` as for the MIB."""
    named = {"root": root, "entity": ENTITY_MIB, "sensors": ENTITY_SENSOR_MIB}
    return {PATH: _TEXT.format(**{name: ".".join(map(str, oid)) for name, oid in named.items()})}
