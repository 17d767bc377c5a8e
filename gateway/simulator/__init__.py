"""Simulated controllers on real ptys or in virtual time: the demo, the tests and the chaos are built on it.

`device` and `oracle` are the controllers, `line` the wire in virtual time, `pty` the wire as a real
serial port, `layout` a whole site. Only `plugin` (pytest fixtures) knows pytest.
"""
