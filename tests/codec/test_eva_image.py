"""The payload of EVA's model images: what is packed is unpacked, and any other bytes are rejected."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.codec.eva_models import random_image
from vibrocast.codec import CodecError
from vibrocast.codec.eva_image import PRIOR_KINDS, EvaImage, PriorKind, with_runtime

PACKED = random_image(1).pack()


@given(st.integers(0, 99), st.integers(1, 128), st.integers(1, 128), st.sampled_from(PRIOR_KINDS))
@settings(max_examples=15)
def test_what_is_packed_is_unpacked(seed: int, width: int, latents: int, prior: PriorKind) -> None:
    image = random_image(seed, width, latents, prior)
    packed = replace(image, graph=b"a graph", runtime="onnx").pack()
    read = EvaImage.unpack(packed)
    assert (read.width, read.latents, read.prior) == (width, latents, prior)
    np.testing.assert_array_equal(read.probabilities, image.probabilities)
    assert read.pack() == packed
    assert read.network is not None and image.network is not None
    for found, expected in zip(read.network.convolutions, image.network.convolutions, strict=True):
        np.testing.assert_array_equal(found.weights, expected.weights)


@given(st.integers(0, len(PACKED)), st.binary(max_size=40))
@settings(max_examples=60)
def test_shortened_and_lengthened_payloads_are_rejected(length: int, tail: bytes) -> None:
    if PACKED[:length] + tail != PACKED:
        with pytest.raises(CodecError):
            EvaImage.unpack(PACKED[:length] + tail)


@given(st.dictionaries(st.integers(0, len(PACKED) - 1), st.integers(0, 255), min_size=1, max_size=4))
def test_damaged_payloads_are_rejected_or_read(damage: dict[int, int]) -> None:
    damaged = bytearray(PACKED)
    for position, byte in damage.items():
        damaged[position] = byte
    with suppress(CodecError):
        assert EvaImage.unpack(bytes(damaged)).pack() == damaged


def test_a_runtime_without_what_it_needs_is_rejected() -> None:
    with pytest.raises(CodecError, match="no ONNX graph"):
        with_runtime(PACKED, "onnx")
    graph_only = replace(EvaImage.unpack(PACKED), network=None, graph=b"a graph", runtime="onnx").pack()
    with pytest.raises(CodecError, match="no integer network"):
        with_runtime(graph_only, "core")
    with pytest.raises(CodecError, match="there is no runtime"):
        with_runtime(PACKED, "abacus")
    both = replace(EvaImage.unpack(PACKED), graph=b"a graph").pack()
    assert EvaImage.unpack(with_runtime(both, "onnx")).runtime == "onnx"
    with pytest.raises(CodecError, match="damaged"):
        replace(EvaImage.unpack(PACKED), fraction_bits=np.full(EvaImage.unpack(PACKED).latents, 15, np.uint8)).pack()


@pytest.mark.parametrize("payload", [b"\x01" + PACKED[1:], b"\x01", b"\x03" + PACKED[1:]])
def test_another_layout_is_named_whatever_follows(payload: bytes) -> None:
    with pytest.raises(CodecError, match=f"layout {payload[0]}, and this version reads layout 2"):
        EvaImage.unpack(payload)
