"""What is known of a controller that no map describes, or that has not yet said which one does.

It has no points, so nothing of it is shown and nothing of it can be written. Its registers and coils are there to be
read by whoever knows them: every read goes to the device, which says itself what it does not have.
"""

from __future__ import annotations

from types import MappingProxyType

from gateway.devices.model import DeviceMap, IdentityRules, Space

AUTO = "auto"
"""In a configuration instead of a model: Read Device Identification tells it."""

UNKNOWN = DeviceMap(
    model="unknown",
    title="Unknown model",
    document="",
    functions=MappingProxyType({1: Space.COILS, 2: Space.COILS, 3: Space.REGISTERS, 4: Space.REGISTERS}),
    write_functions=MappingProxyType({}),
    extents=(),
    reserved=(),
    points=(),
    enumerations=MappingProxyType({}),
    bit_tables=MappingProxyType({}),
    log=None,
    identity=IdentityRules((), (), "", None, 0),
)
