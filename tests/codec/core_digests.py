"""Prints digests of all that the compiled core codes, decodes and renders: python -m tests.codec.core_digests"""

import hashlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.codec.signals import RATE_HZ, edge_signals, texture
from vibrocast import codec, models
from vibrocast.codec.stream import read_stream
from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.output.actuator import ACTUATORS
from vibrocast.output.rendering import render

FOLDER = Path(__file__).parent


def golden_digests() -> dict[str, str]:
    """Return a digest of every golden stream."""
    digests = {}
    for path in sorted(FOLDER.glob("golden_*.vct")):
        image = FOLDER / f"{path.stem.removesuffix('_steered')}.vcmi"
        stream = read_stream(path, image.read_bytes() if image.exists() else None)
        digests[path.stem] = digest(stream.decode_integers().tobytes())
    return digests


def coding_digests() -> dict[str, str]:
    """Return digests of packets and of their samples, by codec and signal, a quarter of the packets lost."""
    generator = np.random.default_rng(1)
    signals = {**edge_signals(), "two channels": texture(2000, 2), "noise": generator.uniform(-1, 1, (2800, 1))}
    methods: dict[str, tuple[str, models.Model | None]] = {
        name: (name, None) for name in ("mdct", "dct", "slp", "parametric")
    }
    for name in ("eva-16-2", "eva-16-7"):
        methods[name] = name.split("-")[0], models.find(name)
    digests = {}
    for method, (codec_name, model) in methods.items():
        for rate_point_set in codec.CODECS[codec_name].rate_point_sets.values():
            setting = rate_point_set.settings[len(rate_point_set.settings) // 2]
            for name, signal in signals.items():
                coded = codec.encode(signal, RATE_HZ, setting, codec=codec_name, unit="um", live=True, model=model)
                decoder = replace(coded, runtime="core").decoder()
                lost = generator.random(len(coded.packets)) < 0.25
                parts = [
                    decoder.conceal() if gone else decoder.decode(packet)
                    for gone, packet in zip(lost, coded.packets, strict=True)
                ]
                whole = b"".join(coded.packets) + b"".join(part.tobytes() for part in parts)
                digests[f"{method}, {setting}, {name}"] = digest(whole)
    return digests


def output_digests() -> dict[str, str]:
    """Return digests of the DAC codes of noise, by actuator."""
    samples = np.random.default_rng(2).integers(-32768, 32768, (2800, 2)).astype(np.int16)
    header = StreamHeader(1, RATE_HZ, None, "m/s^2", (20.0, 1.0), b"")
    return {name: digest(render(header, samples, 0, actuator)[0].tobytes()) for name, actuator in ACTUATORS.items()}


def digest(data: bytes) -> str:
    """Return the beginning of the SHA-256 of some bytes."""
    return hashlib.sha256(data).hexdigest()[:16]


if __name__ == "__main__":
    json.dump(golden_digests() | coding_digests() | output_digests(), sys.stdout)
