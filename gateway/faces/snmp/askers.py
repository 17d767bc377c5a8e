"""SNMPv3 messages of askers that are known, opened without being taken apart.

What stands between the message id and the authenticator (msgMaxSize to user name and the size of the authenticator) is
the same in all messages that an asker sends within a second. Rules:

1. Such a stretch is known when a message with it was read whole and passed every check. It fixes flags, security model,
   engine id, boots, time and user, so these are right again; the time is compared with the clock again.
2. Every octet outside of it is looked at: lengths, version and tags here, then authenticator and ciphertext as always.
   What is unexpected is no error here but left to the long way.
3. Stretches are bounded by MOST_ASKERS, the longest known forgotten first: an asker makes a new one each second.
"""

from __future__ import annotations

import hmac

from gateway.faces.snmp import v3, wire
from gateway.faces.snmp.usm import LocalUser

MOST_ASKERS = 256
_SALT_HEAD = b"\x04\x08"
_VERSION_AND_TAG = b"\x02\x01\x03\x30"


class Asker:
    """A known stretch: whose it is, when it was said, and how much room the asker leaves for a reply."""

    __slots__ = ("flags", "header_rest", "room", "time", "user", "vector")

    def __init__(self, user: LocalUser, message: v3.Message, room: int, header_rest: int) -> None:
        self.user = user
        self.time = message.time
        self.flags = message.flags
        self.vector = v3.vector(message.boots, message.time, b"")  # the first half of one
        self.room = room
        self.header_rest = header_rest  # octets of the stretch that belong to msgGlobalData


class Askers:
    """The known stretches of the users of one engine."""

    def __init__(self) -> None:
        self._known: dict[bytes, Asker] = {}
        self._mac_sizes: tuple[int, ...] = ()

    def learn(self, message: v3.Message, user: LocalUser, room: int) -> None:
        """Learn from a message that passed every check."""
        data = message.data
        at = 2 if data[1] < 0x80 else data[1] - 0x7E
        header_end = at + 5 + data[at + 4]
        id_end = at + 7 + data[at + 6]
        size = user.mac.size
        if header_end + 2 + data[header_end + 1] - 10 - size != message.mac_at or data[at + 3] != 0x30:
            return  # lengths in more octets than needed: nobody sends them
        stretch = data[id_end : message.mac_at]
        if stretch not in self._known and len(self._known) >= MOST_ASKERS:
            del self._known[next(iter(self._known))]
        self._known[stretch] = Asker(user, message, room, header_end - id_end)
        if size not in self._mac_sizes:
            self._mac_sizes = (*self._mac_sizes, size)

    def open(self, data: bytes) -> tuple[Asker, bytes, bytes] | None:
        """The asker, the encoded message id and the decrypted scoped PDU; None when the long way has to look.

        The caller compares the asker's time with the clock.
        """
        try:
            at = 2 if data[1] < 0x80 else data[1] - 0x7E
            id_size = data[at + 6]
            id_end = at + 7 + id_size
            header_end = at + 5 + data[at + 4]
            end = header_end + 2 + data[header_end + 1]
            asker = None
            for size in self._mac_sizes:
                mac_at = end - 10 - size
                asker = self._known.get(data[id_end:mac_at])
                if asker is not None:
                    break
            else:
                return None
            body = end + (2 if data[end + 1] < 0x80 else data[end + 1] - 0x7E)
            if (
                asker.header_rest != header_end - id_end
                or asker.user.mac.size != size
                or data[at : at + 4] != _VERSION_AND_TAG
                or data[at + 5] != 0x02
                or not 1 <= id_size <= 4
                or data[at + 7] & 0x80
            ):
                return None
        except IndexError:
            return None
        whole = len(data)
        if (
            data[:at] != wire.head(0x30, whole - at)
            or data[end:body] != wire.head(0x04, whole - body)
            or data[end - 10 : end - 8] != _SALT_HEAD
        ):
            return None
        user = asker.user
        mac = user.mac
        rest = end - 10
        if not hmac.compare_digest(mac.of(data[:mac_at] + mac.blank + data[rest:]), data[mac_at:rest]):
            return None
        return asker, data[at + 5 : id_end], user.cfb.decrypt(asker.vector + data[end - 8 : end], data[body:])
