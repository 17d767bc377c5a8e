"""One serial line, three faces: Modbus TCP, SNMP and Prometheus for solar charge controllers."""

__version__ = "0.1.0"
