"""North: Modbus TCP, SNMP and HTTP, all served from snapshots."""
