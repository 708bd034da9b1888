"""Golden streams: what was coded once stays playable, to the last bit. A change here is a new version of the format."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from tests.codec.signals import golden_signal, played
from vibrocast import codec
from vibrocast.codec import Signal
from vibrocast.codec.eva_image import EvaImage
from vibrocast.device_protocol.coded_stream import IMAGE_HASH_BYTES, unpack_file
from vibrocast.device_protocol.model_image import ModelImage, sha256

FOLDER = Path(__file__).parent
GOLDEN = {
    "mdct": (3, "797049c30c7e9a855534db665e140639", 33.54),
    "mdct_steered": (7, "0ef1ef7dfa0771904c1dd5ee2d6e3d66", 28.85),
    "mdct_shaped": (5, "d954907d4796e66ed8d794be858d67fc", 33.25),
    "mdct_rotated": (7, "23bd0d19141f9f2ee5987b80351f7aa8", 27.49),
    "dct_huffman": (6, "7606ed1ececb7ec03e76b163f5b884c9", 27.30),
    "dct_range": (6, "5334e1c94726787e65a1e161e70cbffc", 21.04),
    "dct_steered": (6, "9d789bb5b640a91ef01e2e061d60b5be", 17.56),
    "dct_whole": (1, "f9b0c8ad7c9516d3febc854818f85258", 20.95),
    "slp": (4, "8b1232451a78e00057889c37c32eb322", 22.62),
    "slp_steered": (7, "159d4e879c4c071543fb0c1abd52d41a", 20.78),
    "parametric": (4, "a516e13d6d341f980b20867aaa933532", None),
    "eva_adaptive": (None, "b97e5ec49f8af5c99a5dba4d2ad26e62", None),
    "eva_static": (None, "b97e5ec49f8af5c99a5dba4d2ad26e62", None),
    "eva_adaptive_steered": (None, "3693cb2d8b4f1a55de26c1afc6ca2ee4", None),
    "eva_static_steered": (None, "3693cb2d8b4f1a55de26c1afc6ca2ee4", None),
}
"""Packets, the digest of their samples, and the SNR in dB of the golden signal; None: it says nothing."""


def coded_signal(name: str, samples: int) -> Signal:
    """Return the signal that a stream was coded from."""
    signal = golden_signal(samples)
    if name.startswith("dct"):
        signal[576:, 1] = 0
    if name == "parametric":  # noise, and ridges at every 41 samples
        signal[:, 1] = np.arange(float(samples)) % 41 / 41 - 0.5
    return signal


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_streams_decode_to_the_same_bits(name: str) -> None:
    count, digest, snr_db = GOLDEN[name]
    header, packets = unpack_file((FOLDER / f"golden_{name}.vct").read_bytes())
    payload = None
    if name.startswith("eva"):
        image = (FOLDER / f"golden_{name.removesuffix('_steered')}.vcmi").read_bytes()
        assert header.image_hash == sha256(image)[:IMAGE_HASH_BYTES]
        payload = ModelImage.unpack(image).payload
        assert EvaImage.unpack(payload).prior == name.split("_")[1]
    chosen = codec.codec_by_identifier(header.codec_identifier)
    assert (chosen.name, header.channels) == (name.split("_")[0], 2)
    assert count in (None, len(packets))
    decoder = codec.decoder(header.codec_identifier, header.configuration, 2, payload)
    samples = played(decoder, packets)
    assert hashlib.sha256(samples.astype("<i2").tobytes()).hexdigest()[:32] == digest
    if payload is not None:
        assert np.std(samples) > 50
        return
    assert header.samples is not None
    heard = samples[decoder.delay_samples :][: header.samples] * (np.array(header.gains) / 32768)
    signal = coded_signal(name, header.samples)
    if snr_db is None:
        assert np.mean(heard**2, axis=0) == pytest.approx(np.mean(signal**2, axis=0), rel=0.5)
    else:
        assert codec.snr_db(signal, heard) == pytest.approx(snr_db, abs=0.01)
