"""SHA-512 and Ed25519 in C: the vectors of RFC 8032, and every change of a signature, a message or a key."""

import hashlib
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from studies.emulated_core import CORES, EmulatedCore
from tests.firmware.native import ffi, native
from vibrocast.firmware.build import build

ROOT = Path(__file__).parents[2]
_DATA = 0x6000_0000
"""Memory of an EmulatedCore."""

ORDER = 2**252 + 27742317777372353535851937790883648493
"""Of the group: RFC 8032, section 5.1."""

VECTORS = {
    "TEST 1": (
        "9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60",
        "d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a",
        "",
        "e5564300c360ac729086e2cc806e828a84877f1eb8e5d974d873e065224901555fb8821590a33bacc61e39701cf9b46bd25bf5f0595bbe24655141438e7a100b",
    ),
    "TEST 2": (
        "4ccd089b28ff96da9db6c346ec114e0f5b8a319f35aba624da8cf6ed4fb8a6fb",
        "3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c",
        "72",
        "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da085ac1e43e15996e458f3613d0f11d8c387b2eaeb4302aeeb00d291612bb0c00",
    ),
    "TEST 3": (
        "c5aa8df43f9f837bedb7442f31dcb7b166d38535076f094b85ce3a2e0b4458f7",
        "fc51cd8e6218a1a38da47ed00230f0580816ed13ba3303ac5deb911548908025",
        "af82",
        "6291d657deec24024827e69c3abe01a30ce548a284743a445e3680d7db5ac3ac18ff9b538d16f290ae67f760984dc6594a7c15e9716ed28dc027beceea1ec40a",
    ),
    "TEST SHA(abc)": (
        "833fe62409237b9d62ec77587520911e9a759cec1d19755b7da901b96dca3d42",
        "ec172b93ad5e563bf4932c70e1245034c35467ef2efd4d64ebf819683467e2bf",
        hashlib.sha512(b"abc").hexdigest(),
        "dc2a4459e7369633a52b1bf277839a00201009a3efbf3ecb69bea2186c26b58909351fc9ac90b3ecfdfbc7c66431e0303dca179c138ac17ad9bef1177331a704",
    ),
}
"""RFC 8032, section 7.1: private key, public key, message, signature."""


def public_key(private_key: bytes) -> bytes:
    key = ffi.new("uint8_t[32]")
    native.vc_ed25519_public_key(private_key, key)
    return bytes(key)


def sign(private_key: bytes, message: bytes) -> bytes:
    signature = ffi.new("uint8_t[64]")
    native.vc_ed25519_sign(private_key, message, len(message), signature)
    return bytes(signature)


def is_right(signature: bytes, key: bytes, message: bytes) -> bool:
    return bool(native.vc_ed25519_check(signature, key, message, len(message)))


@pytest.mark.parametrize("name", VECTORS)
def test_vectors_of_rfc_8032(name: str) -> None:
    private, public, message, signature = map(bytes.fromhex, VECTORS[name])
    assert public_key(private) == public
    assert sign(private, message) == signature
    assert is_right(signature, public, message)


@given(st.lists(st.binary(max_size=300), max_size=4))
def test_sha_512_of_pieces(pieces: list[bytes]) -> None:
    sha512, digest = ffi.new("vc_sha512 *"), ffi.new("uint8_t[64]")
    native.vc_sha512_begin(sha512)
    for piece in pieces:
        native.vc_sha512_add(sha512, piece, len(piece))
    native.vc_sha512_end(sha512, digest)
    assert bytes(digest) == hashlib.sha512(b"".join(pieces)).digest()


def test_every_changed_bit_is_noticed() -> None:
    _, public, message, signature = map(bytes.fromhex, VECTORS["TEST 3"])
    whole = signature + public + message
    for bit in range(8 * len(whole)):
        changed = (int.from_bytes(whole, "little") ^ 1 << bit).to_bytes(len(whole), "little")
        assert not is_right(changed[:64], changed[64:96], changed[96:]), f"bit {bit}"


@given(st.binary(min_size=32, max_size=32), st.binary(min_size=32, max_size=32), st.binary(max_size=200))
def test_another_key_signs_another_signature(private: bytes, other: bytes, message: bytes) -> None:
    signature = sign(private, message)
    assert is_right(signature, public_key(private), message)
    assert is_right(signature, public_key(other), message) == (private == other)


def test_a_second_form_of_a_signature_is_rejected() -> None:
    """S + the order of the group fulfils the same equation; RFC 8032, section 5.1.7 demands S below the order."""
    _, public, message, signature = map(bytes.fromhex, VECTORS["TEST 1"])
    doubled = int.from_bytes(signature[32:], "little") + ORDER
    assert not is_right(signature[:32] + doubled.to_bytes(32, "little"), public, message)


@given(st.binary(min_size=64, max_size=64), st.binary(min_size=32, max_size=32), st.binary(max_size=200))
def test_no_random_signature_is_right(signature: bytes, private: bytes, message: bytes) -> None:
    assert not is_right(signature, public_key(private), message)


@pytest.mark.slow
def test_a_check_costs_as_the_page_states() -> None:
    """To a tenth, as compilers differ."""
    page = (ROOT / "docs" / "how-to" / "sign_models.md").read_text(encoding="utf-8")
    cycles, stack = re.search(r"\| ([\d.]+) million cycles", page), re.search(r"\| (\d+) bytes; other calls", page)
    assert cycles is not None and stack is not None
    private, message = bytes(range(32)), bytes(36)
    core = EmulatedCore(build("stm32f405"), CORES["M4F"])
    core.write(_DATA, sign(private, message) + public_key(private) + message)
    assert core.call("vc_ed25519_check", _DATA, _DATA + 64, _DATA + 96, len(message)) == 1
    assert core.cycles == pytest.approx(float(cycles[1]) * 1e6, rel=0.1)
    assert core.stack_bytes == pytest.approx(int(stack[1]), rel=0.1)
