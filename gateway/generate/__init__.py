"""From the map: MIB, metric list and register documentation."""
