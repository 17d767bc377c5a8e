"""Read Device Identification (2B/0E) from what was read of the device; Modbus application protocol 6.21.

The device knows only basic stream access (code 01). From its three objects the gateway also answers
individual access (04), and says so: conformity 0x81. Codes 02 and 03 ask for more than there is and
get the basic objects, as 6.21 wants. A stream that starts at an unknown object starts at the first one.
"""

from __future__ import annotations

from collections.abc import Mapping

from gateway.core.policy import READ_DEVICE_IDENTIFICATION
from gateway.devices.model import Identification
from gateway.errors import IllegalDataAddress, IllegalDataValue, IllegalFunction
from gateway.modbus.pdu import IDENTIFICATION_HEADER, MAX_PDU, MORE_FOLLOWS

MEI_TYPE = 0x0E
CONFORMITY = 0x81  # basic, stream and individual access
_INDIVIDUAL = 0x04
_READ_CODES = range(0x01, 0x05)


def identify(pdu: bytes, identification: Identification | None) -> bytes | None:
    """The reply PDU, or None when nothing is known of the device and it has to be asked.

    Raises:
        IllegalFunction: another MEI type than 0E.
        IllegalDataValue: wrong length or read code.
        IllegalDataAddress: individual access to an object that the device does not have.

    """
    if len(pdu) < 2:
        raise IllegalDataValue
    if pdu[1] != MEI_TYPE:
        raise IllegalFunction
    if len(pdu) != 4 or pdu[2] not in _READ_CODES:
        raise IllegalDataValue
    if identification is None:
        return None
    code, wanted = pdu[2], pdu[3]
    texts = (identification.vendor, identification.product, identification.revision)
    objects = {number: text.encode("latin-1", "replace") for number, text in enumerate(texts)}
    if code == _INDIVIDUAL:
        if wanted not in objects:
            raise IllegalDataAddress
        chosen = {wanted: objects[wanted]}
    else:
        start = wanted if wanted in objects else 0
        chosen = {number: text for number, text in objects.items() if number >= start}
    return _reply(code, chosen)


def _reply(code: int, objects: Mapping[int, bytes]) -> bytes:
    """As many objects as one PDU takes, and where to go on when it does not take all."""
    found, count, more, following = b"", 0, 0, 0
    for number, text in objects.items():
        if IDENTIFICATION_HEADER + len(found) + 2 + len(text) > MAX_PDU:
            more, following = MORE_FOLLOWS, number
            break
        found += bytes((number, len(text))) + text
        count += 1
    return bytes((READ_DEVICE_IDENTIFICATION, MEI_TYPE, code, CONFORMITY, more, following, count)) + found
