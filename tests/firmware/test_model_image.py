"""Model images in C against device_protocol/model_image.py: the same of any bytes."""

import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.device_protocol.test_model_image import images
from tests.firmware.native import ffi, native, piece_bytes, rejection_text
from vibrocast.device_protocol.model_image import MAX_NUMBER, ModelError, ModelImage, unsigned, with_signature


def check_read_as_in_python(data: bytes) -> None:
    image, rejection, memory = ffi.new("vc_model_image *"), ffi.new("vc_rejection *"), ffi.new("uint8_t[]", data)
    code = native.vc_model_image_read(image, memory, len(data), rejection)
    assert native.vc_model_image_unsigned_bytes(memory, len(data)) == len(unsigned(data))
    try:
        expected = ModelImage.unpack(data)
    except ModelError:
        assert code == rejection.code == native.VC_IMAGE_REJECTED
        assert rejection_text(rejection)
    else:
        name, version, hardware = (piece_bytes(text).decode() for text in (image.name, image.version, image.hardware))
        assert code == 0
        signature = bytes(ffi.buffer(image.signature, 64)) if image.signature else b""
        payload = piece_bytes(image.payload)
        assert ModelImage(image.codec, name, version, hardware, payload, image.number, signature) == expected


def with_crc(data: bytes) -> bytes:
    return data + zlib.crc32(data).to_bytes(4, "little")


@given(images, st.integers(0, MAX_NUMBER), st.binary(min_size=64, max_size=64))
def test_reads_every_image(image: ModelImage, number: int, signature: bytes) -> None:
    check_read_as_in_python(image.pack())
    check_read_as_in_python(with_signature(image.pack(), number, signature))


@given(images, st.data())
def test_reads_or_rejects_damaged_images_as_python(image: ModelImage, data: st.DataObject) -> None:
    packed = bytearray(image.pack())
    place = data.draw(st.integers(0, len(packed) - 1))
    check_read_as_in_python(bytes(packed[:place]))
    check_read_as_in_python(bytes(packed) + data.draw(st.binary(max_size=4)))
    packed[place] = data.draw(st.integers(0, 255))
    check_read_as_in_python(bytes(packed))
    check_read_as_in_python(with_crc(bytes(packed[:-4])))
    check_read_as_in_python(bytes(packed) + bytes(68))


@pytest.mark.parametrize("lengths", ["ff" * 7, "ff" * 3 + "00" * 4, "00" * 3 + "ff" * 4, "000000" + "afffffff"])
def test_lengths_that_overflow_32_bits_are_rejected(lengths: str) -> None:
    for size in (0, 4, 68, 72, 85, 1000):
        check_read_as_in_python(b"VCMI\x01\x01" + bytes.fromhex(lengths) + bytes(size))


@given(st.binary(max_size=60))
def test_reads_or_rejects_any_bytes_as_python(data: bytes) -> None:
    for start in (b"", b"VCMI\x01", b"VCMI\x01\x01\x02\x01\x03\x05\0\0\0"):
        check_read_as_in_python(start + data)
        check_read_as_in_python(with_crc(start + data))
