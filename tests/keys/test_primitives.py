"""Cryptographic primitives of libraries, against published vectors."""

from __future__ import annotations

import hashlib

import pytest
from argon2.low_level import Type, core as argon2_core, ffi as argon2_ffi, hash_secret_raw, lib as argon2_lib
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.ciphers.algorithms import ChaCha20
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand


def test_argon2id_rfc_9106_section_5_3() -> None:
    """With the secret and the associated data of the vector, through the library's low-level interface."""
    buffers = [bytes([value]) * size for value, size in ((1, 32), (2, 16), (3, 8), (4, 12))]
    password, salt, secret, associated = (argon2_ffi.new("uint8_t[]", data) for data in buffers)
    out = argon2_ffi.new("uint8_t[]", 32)
    null = argon2_ffi.NULL
    context = argon2_ffi.new(
        "argon2_context *",
        {
            "version": 0x13,
            "out": out,
            "outlen": 32,
            "pwd": password,
            "pwdlen": 32,
            "salt": salt,
            "saltlen": 16,
            "secret": secret,
            "secretlen": 8,
            "ad": associated,
            "adlen": 12,
            "t_cost": 3,
            "m_cost": 32,
            "lanes": 4,
            "threads": 4,
            "allocate_cbk": null,
            "free_cbk": null,
            "flags": argon2_lib.ARGON2_DEFAULT_FLAGS,
        },
    )
    assert argon2_core(context, Type.ID.value) == argon2_lib.ARGON2_OK
    expected = "0d640df58d78766c08c037a34a8b53c9d01ef0452d75b65eb52520e96b01e659"
    assert bytes(argon2_ffi.buffer(out)).hex() == expected


def test_argon2id_reference_implementation() -> None:
    """From the test suite of the reference implementation (phc-winner-argon2, test.c, version 0x13)."""
    got = hash_secret_raw(b"password", b"somesalt", 2, 65536, 1, 32, Type.ID)
    assert got.hex() == "09316115d5cf24ed5a15a31a3ba326e5cf32edc24702987c02b6566f61913cf7"


def test_hkdf_expand_rfc_5869_case_1() -> None:
    prk = bytes.fromhex("077709362c2e32df0ddc3f0dc47bba6390b6c73bb50f9c3122ec844ad7c2b3e5")
    okm = "3cb25f25faacd57a90434f64d0362f2a2d2d0a90cf1a5a4c5db02d56ecc4c5bf34007208d5b887185865"
    assert HKDFExpand(SHA256(), 42, bytes.fromhex("f0f1f2f3f4f5f6f7f8f9")).derive(prk).hex() == okm


def test_chacha20_poly1305_rfc_8439_section_2_8_2() -> None:
    key, nonce = bytes(range(0x80, 0xA0)), bytes.fromhex("070000004041424344454647")
    associated = bytes.fromhex("50515253c0c1c2c3c4c5c6c7")
    text = (
        b"Ladies and Gentlemen of the class of '99: If I could offer you only one tip for the future, "
        b"sunscreen would be it."
    )
    sealed = ChaCha20Poly1305(key).encrypt(nonce, text, associated)
    assert sealed[-16:].hex() == "1ae10b594f09e26a7e902ecbd0600691"
    assert sealed[:16].hex() == "d31a8d34648e60db7b86afbc53ef7ec2"
    for forged in (sealed[:-1], sealed[:-1] + b"\0", bytes([sealed[0] ^ 1]) + sealed[1:], b""):
        with pytest.raises((InvalidTag, ValueError)):
            ChaCha20Poly1305(key).decrypt(nonce, forged, associated)
    with pytest.raises(InvalidTag):
        ChaCha20Poly1305(key).decrypt(nonce, sealed, associated + b"\0")


def test_chacha20_rfc_8439_section_2_4_2() -> None:
    cipher = Cipher(ChaCha20(bytes(range(32)), bytes.fromhex("01000000000000000000004a00000000")), mode=None)
    stream = cipher.encryptor().update(b"Ladies and Gentl")
    assert stream.hex() == "6e2e359a2568f98041ba0728dd0d6981"


def test_blake2b_rfc_7693_appendix_a() -> None:
    expected = (
        "ba80a53f981c4d0d6a2797b69f12f6e94c212f14685ac4b74b12bb6fdbffa2d1"
        "7d87c5392aab792dc252d5de4533cc9518d38aa8dbf1925ab92386edd4009923"
    )
    assert hashlib.blake2b(b"abc").hexdigest() == expected
