"""Model images: round trip, damage, hostile lengths."""

import hashlib
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.device_protocol.model_image import (
    MAX_NUMBER,
    ModelError,
    ModelImage,
    sha256,
    signed_message,
    unsigned,
    with_signature,
)

texts = st.text(max_size=60)
images = st.builds(ModelImage, st.integers(0, 255), texts, texts, texts, st.binary(max_size=500))


@given(images)
def test_round_trip(image: ModelImage) -> None:
    assert ModelImage.unpack(image.pack()) == image


@given(images, st.data())
def test_any_changed_byte_is_noticed(image: ModelImage, data: st.DataObject) -> None:
    packed = bytearray(image.pack())
    packed[data.draw(st.integers(0, len(packed) - 1))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(ModelError):
        ModelImage.unpack(bytes(packed))


@given(images, st.integers(1, MAX_NUMBER), st.binary(min_size=64, max_size=64))
def test_a_signature_stands_behind_the_image_and_keeps_its_identity(
    image: ModelImage, number: int, signature: bytes
) -> None:
    packed = image.pack()
    signed = with_signature(packed, number, signature)
    assert signed == packed + number.to_bytes(4, "little") + signature
    assert ModelImage.unpack(signed) == replace(image, number=number, signature=signature)
    assert ModelImage.unpack(signed).pack() == signed
    assert (unsigned(signed), sha256(signed)) == (packed, sha256(packed))
    assert with_signature(signed, 1, bytes(64)) == with_signature(packed, 1, bytes(64))
    assert signed_message(signed, number) == hashlib.sha256(packed).digest() + number.to_bytes(4, "little")


@given(images, st.data())
def test_cut_or_longer_is_noticed_with_a_signature_and_without(image: ModelImage, data: st.DataObject) -> None:
    packed = image.pack()
    signed = with_signature(packed, 1, bytes(64))
    cut = data.draw(st.integers(0, len(packed) - 1))
    cut_signature = data.draw(st.integers(len(packed) + 1, len(signed) - 1))
    for other in (signed[:cut], signed[:cut_signature], signed + b"\x00", signed + bytes(68)):
        with pytest.raises(ModelError):
            ModelImage.unpack(other)
    with pytest.raises(ModelError, match="instead of"):
        ModelImage.unpack(packed + b"\x00")


@given(st.binary().map(lambda data: b"VCMI\x01" + data))
def test_fuzz_is_rejected(data: bytes) -> None:
    with pytest.raises(ModelError):
        ModelImage.unpack(data)


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (ModelImage(256, "", "", "", b""), "identifier 256"),
        (ModelImage(1, "x" * 256, "", "", b""), "255 bytes"),
        (ModelImage(1, "", "", "", bytes(1 << 24)), "at most"),
    ],
)
def test_values_out_of_range_are_not_packed(image: ModelImage, reason: str) -> None:
    with pytest.raises(ModelError, match=reason):
        image.pack()


def test_other_layout_is_named() -> None:
    packed = bytearray(ModelImage(1, "", "", "", b"").pack())
    packed[4] = 9
    with pytest.raises(ModelError, match="layout 9"):
        ModelImage.unpack(bytes(packed))
