"""Model images: round trip, damage, hostile lengths."""

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.device_protocol.model_image import ModelImage, ModelImageError, sha256

texts = st.text(max_size=60)
images = st.builds(ModelImage, st.integers(0, 255), texts, texts, texts, st.binary(max_size=500))


@given(images)
def test_round_trip(image: ModelImage) -> None:
    assert ModelImage.unpack(image.pack()) == image


@given(images, st.data())
def test_any_changed_byte_is_noticed(image: ModelImage, data: st.DataObject) -> None:
    packed = bytearray(image.pack())
    packed[data.draw(st.integers(0, len(packed) - 1))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(ModelImageError):
        ModelImage.unpack(bytes(packed))


@given(images, st.data())
def test_cut_or_longer_is_noticed(image: ModelImage, data: st.DataObject) -> None:
    packed = image.pack()
    with pytest.raises(ModelImageError):
        ModelImage.unpack(packed[: data.draw(st.integers(0, len(packed) - 1))])
    with pytest.raises(ModelImageError, match="instead of"):
        ModelImage.unpack(packed + b"\x00")


@given(st.binary().map(lambda data: b"VCMI\x01" + data))
def test_fuzz_is_rejected(data: bytes) -> None:
    with pytest.raises(ModelImageError):
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
    with pytest.raises(ModelImageError, match=reason):
        image.pack()


def test_other_layout_is_named() -> None:
    packed = bytearray(ModelImage(1, "", "", "", b"").pack())
    packed[4] = 9
    with pytest.raises(ModelImageError, match="layout 9"):
        ModelImage.unpack(bytes(packed))


def test_identity_is_the_sha256_of_all_bytes() -> None:
    packed = ModelImage(1, "oak", "1", "", b"tables").pack()
    assert sha256(packed) == hashlib.sha256(packed).digest()
