"""The SNMP face."""
