"""Keys, authenticators and ciphertexts against pysnmp's keys, hmac, and ciphers of `cryptography` used once."""

from __future__ import annotations

import hashlib
import hmac
import warnings
from typing import Any

import pytest
from cryptography.hazmat.decrepit.ciphers.modes import CFB
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from hypothesis import given
from hypothesis import strategies as st
from pyasn1.type import univ

from gateway.faces.snmp import usm
from gateway.faces.snmp.cfb import Cfb
from gateway.faces.snmp.usm import Auth, LocalUser, Mac, Priv
from tests.faces.snmp.poller import credentials

ENGINE_ID = bytes.fromhex("80007ed9050102030405060708")


@pytest.fixture(scope="module")
def reference() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pysnmp imports ciphers that `cryptography` has moved
        from pysnmp.proto.secmod.rfc3414 import localkey
    return localkey


@pytest.mark.parametrize("auth", list(Auth))
@pytest.mark.parametrize("phrase", [b"maplesyrup", b"eight888", "Übergröße ☀".encode(), b"x" * 1000])
def test_keys_are_those_of_pysnmp(reference: Any, auth: Auth, phrase: bytes) -> None:
    digest = getattr(hashlib, auth.digest)
    key = usm.password_to_key(auth, phrase)
    assert key == bytes(reference.hash_passphrase(phrase, digest))
    assert usm.localized(auth, key, ENGINE_ID) == bytes(
        reference.localize_key(key, univ.OctetString(ENGINE_ID), digest)
    )
    assert len(key) == auth.key_size


@pytest.mark.parametrize("auth", list(Auth))
@given(messages=st.lists(st.binary(max_size=300), max_size=5))
def test_authenticators_are_hmac_cut_to_size(auth: Auth, messages: list[bytes]) -> None:
    key = bytes(range(auth.key_size))
    mac = Mac(auth, key)
    for message in messages:
        assert mac.of(message) == hmac.digest(key, message, auth.digest)[: auth.mac_size]


@pytest.mark.parametrize("priv", list(Priv))
@given(
    messages=st.lists(
        st.tuples(st.booleans(), st.binary(min_size=16, max_size=16), st.binary(max_size=200)), max_size=8
    )
)
def test_any_sequence_of_messages_is_ciphered_as_by_one_cipher_each(
    priv: Priv, messages: list[tuple[bool, bytes, bytes]]
) -> None:
    key = bytes(range(priv.key_size))
    kept = Cfb(key)
    for encrypt, vector, data in messages:
        once = Cipher(AES(key), CFB(vector))
        if encrypt:
            assert kept.encrypt(vector, data) == once.encryptor().update(data)
        else:
            assert kept.decrypt(vector, data) == once.decryptor().update(data)


def test_the_aes_128_vector_of_nist_sp_800_38a() -> None:
    key, vector = bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c"), bytes(range(16))
    plain = bytes.fromhex("6bc1bee22e409f96e93d7e117393172aae2d8a571e03ac9c9eb76fac45af8e51")
    cipher = bytes.fromhex("3b3fd92eb72dad20333449f8e83cfb4ac8a64537a0b3a93fcde3cdad9f1ce58b")
    kept = Cfb(key)
    for _ in range(2):
        assert kept.encrypt(vector, plain) == cipher
        assert kept.decrypt(vector, cipher) == plain


def test_salts_do_not_repeat() -> None:
    user = LocalUser(credentials(), ENGINE_ID)
    user._salt = (1 << 64) - 2
    salts = [user.salt() for _ in range(1000)]
    assert len(set(salts)) == 1000
    assert {len(salt) for salt in salts} == {8}


def test_a_user_whose_library_lies_is_not_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Mac, "of", lambda self, message: bytes(self.size))
    with pytest.raises(RuntimeError, match="SHA-256 is not usable"):
        LocalUser(credentials(), ENGINE_ID)
    monkeypatch.undo()
    monkeypatch.setattr(Cfb, "encrypt", lambda self, vector, data: data)
    with pytest.raises(RuntimeError, match="AES-128 is not usable"):
        LocalUser(credentials(), ENGINE_ID)


def test_a_user_shows_no_secret() -> None:
    made = credentials(phrases=("sesame sesame", "open open open"))
    shown = repr(made) + repr(LocalUser(made, ENGINE_ID)) + str(made)
    assert "sesame" not in shown
    assert "open open" not in shown
