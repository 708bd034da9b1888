"""Tests of Ctrl-C and a kill while a command computes for long: it ends at once, and leaves no file half written."""

import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.command import started
from vibrocast import models, textures
from vibrocast.codec import Framing
from vibrocast.codec.eva import IDENTIFIER, EvaEncoder
from vibrocast.codec.eva_image import EvaImage
from vibrocast.codec.graphs import HOP, MAX_PACKET_COLUMNS
from vibrocast.codec.stream import image_hash
from vibrocast.device_protocol.coded_stream import StreamHeader, pack_file, renumbered
from vibrocast.device_protocol.model_image import ModelImage

WIDEST = "eva-128-1"
PACKET_SAMPLES = HOP * (MAX_PACKET_COLUMNS // 2)  # a controller takes half the longest packet of a file
PACKETS = 2000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with an hour of noise, and 6 hours of it coded for the widest network in ONNX."""
    folder = tmp_path_factory.mktemp("long")
    noise = textures.from_array(
        0.1 * np.random.default_rng(1).standard_normal(3600 * 2800), 2800, "drive", name="noise"
    )
    textures.save(folder / "hour.wav", noise)
    model = models.find(WIDEST)
    encoder = EvaEncoder([0.3], Framing(PACKET_SAMPLES, 1), model)
    packet = encoder.encode(noise.samples[: 2 * PACKET_SAMPLES])[0]
    image = ModelImage.unpack(model.image)
    graph = (model.path.parent / "synthesis.onnx").read_bytes()
    payload = replace(EvaImage.unpack(image.payload), graph=graph, runtime="onnx", network=None).pack()
    packed = replace(image, payload=payload).pack()
    (folder / "onnx.vcmi").write_bytes(packed)
    samples = (PACKETS - 1) * PACKET_SAMPLES
    header = StreamHeader(IDENTIFIER, 2800, samples, "um", (1.0,), encoder.configuration, image_hash(packed))
    (folder / "long.vct").write_bytes(pack_file(header, [renumbered(packet, number) for number in range(PACKETS)]))
    (folder / "recordings").mkdir()
    (folder / "recordings" / "hour.wav").hardlink_to(folder / "hour.wav")
    return folder


COMMANDS = {
    "decode": ("decode", "long.vct", "out.wav", "--model", "onnx.vcmi"),
    "encode": ("encode", "hour.wav", "out.vct", "--model", WIDEST),
    "play": ("play", "long.vct", "--model", "onnx.vcmi", "--report", "out.json"),
    "bench": ("bench", "recordings", "--out", "out"),
}


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_long_command_ends_when_it_is_interrupted(name: str, number: signal.Signals, folder: Path) -> None:
    before = set(folder.iterdir())
    with started(*COMMANDS[name], folder=folder) as process:
        time.sleep(5)
        assert process.poll() is None
        process.send_signal(number)
        errors = process.communicate(timeout=20)[1]
    assert (process.returncode, errors.splitlines()[-1]) == (128 + number, "error: interrupted")
    left = set(folder.iterdir()) - before
    # A benchmark continues in its folder; a playback keeps its last frames and a report.
    assert {path.name for path in left} <= {"out", "out.json", "out.pcapng"}
