"""AES in 128-bit CFB (RFC 3826), by cryptography; usm.py says when it is loaded."""

from __future__ import annotations

from cryptography.hazmat.decrepit.ciphers.modes import CFB
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import ECB

BLOCK = 16


class Cfb:
    """AES in 128-bit CFB with one key, for any number of messages.

    Making a cipher costs thirty times what a message costs, so both contexts are kept and each message is put behind
    its initialization vector: a CFB decryptor takes it as the ciphertext before, an encryptor is given the plaintext
    that becomes it. tests/faces/snmp/test_usm.py compares with one cipher a message.
    """

    __slots__ = ("_block", "_decryptor", "_encryptor", "_last")

    def __init__(self, key: bytes) -> None:
        cipher = Cipher(AES(key), CFB(bytes(BLOCK)))
        self._decryptor = cipher.decryptor()
        self._encryptor = cipher.encryptor()
        self._block = Cipher(AES(key), ECB()).encryptor()  # noqa: S305 - single blocks: the building stone of CFB
        self._last = bytes(BLOCK)

    def decrypt(self, vector: bytes, data: bytes) -> bytes:
        """The plaintext of `data`; `vector` has 16 octets."""
        return self._decryptor.update(vector + data + bytes(-len(data) % BLOCK))[BLOCK : BLOCK + len(data)]

    def encrypt(self, vector: bytes, data: bytes) -> bytes:
        """The ciphertext of `data`, of the same length; `vector` has 16 octets."""
        stream = int.from_bytes(self._block.update(self._last), "big")
        lead = (int.from_bytes(vector, "big") ^ stream).to_bytes(BLOCK, "big")
        out = self._encryptor.update(lead + data + bytes(-len(data) % BLOCK))
        self._last = out[-BLOCK:]
        return out[BLOCK : BLOCK + len(data)]


def once(key: bytes, vector: bytes, data: bytes) -> bytes:
    """The ciphertext of `data` by a cipher of its own."""
    return Cipher(AES(key), CFB(vector)).encryptor().update(data)
