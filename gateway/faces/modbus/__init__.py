"""The Modbus TCP face."""
