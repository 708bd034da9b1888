"""The learned codec on the controller: decoded in C or by ONNX Runtime, and images that cannot be used."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.conftest import linked
from tests.export import tiny
from vibrocast import codec, models, textures
from vibrocast.codec import eva
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.eva_image import EvaImage, with_runtime
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import SlotState
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.export.eva import Eva, EvaShape
from vibrocast.export.graphs import graphs_of
from vibrocast.host import player
from vibrocast.host.controller import Controller as Host
from vibrocast.host.controller import ControllerError
from vibrocast.host.uploader import flash, running
from vibrocast.simulated_device.controller import Settings


def session(runtime: str | None = None) -> Host:
    return linked(Settings(runtime=runtime))[1]


def streamed(model: models.Model, channels: int = 1) -> Stream:
    samples = np.hstack([textures.GENERATORS["rough"](seed, 0.5).samples for seed in range(channels)])
    recording = textures.Recording(samples, 2800, "m/s^2", "rough")
    return encode_recording(recording, setting={"level": 1.0}, model=model, live=True).stream


def played(host: Host, stream: Stream) -> codec.Decoded:
    """Return what a controller decodes of a stream."""
    result = player.play(host, stream, player.PlaybackSettings(capture=True))
    assert result.decoded is not None
    return result.decoded


@pytest.mark.parametrize("preferred", codec.RUNTIMES)
@pytest.mark.parametrize("runtime", [None, *codec.RUNTIMES])
def test_a_stream_decodes_as_offline_by_the_runtime_of_the_image_or_of_the_setting(
    runtime: str | None, preferred: str
) -> None:
    tables = with_runtime(tiny.model().tables, preferred)
    model = replace(tiny.model(), image=ModelImage(eva.IDENTIFIER, "both", "1", "", tables).pack())
    host = session(runtime)
    flash(host, model.image)
    stream = streamed(model, channels=2)
    by_core, by_onnx = (replace(stream, runtime=each).decode_integers() for each in codec.RUNTIMES)
    assert not np.array_equal(by_core, by_onnx)
    expected = by_onnx if (runtime or preferred) == "onnx" else by_core
    np.testing.assert_array_equal(played(host, stream), expected)


@pytest.mark.parametrize(("contents", "runtime"), [("core", "onnx"), ("onnx", "core")])
def test_a_runtime_that_the_image_does_not_have_is_rejected(contents: str, runtime: str) -> None:
    model = tiny.model("core" if contents == "core" else "onnx")
    host = session(runtime)
    flash(host, model.image)
    with pytest.raises(ControllerError, match=f"runtime {contents}"):
        played(host, streamed(model))


def test_the_setting_leaves_codecs_without_a_choice_alone() -> None:
    recording = textures.GENERATORS["rough"](0, 0.5)
    stream = encode_recording(recording, setting={"step": 0.5}, live=True).stream
    np.testing.assert_array_equal(played(session("onnx"), stream), stream.decode_integers())


def graph_of(latents: int) -> bytes:
    torch.manual_seed(3)
    return graphs_of(Eva(EvaShape(16, latents)), [64]).synthesis


def with_graph(graph: bytes) -> bytes:
    return replace(EvaImage.unpack(tiny.model().tables), graph=graph).pack()


# Decoders in C never look at it.


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (lambda: tiny.model().tables[:-1], "damaged"),
        (lambda: b"\x01" + tiny.model().tables[1:], "layout 1"),
        (lambda: with_graph(b"not ONNX"), "does not write"),
        (lambda: with_graph(tiny.model().analysis), "does not turn latents into signal"),
        (lambda: with_graph(graph_of(24)), "ONNX graph"),
    ],
)
def test_images_that_cannot_be_used_are_rejected_and_the_old_one_plays(
    payload: Callable[[], bytes], reason: str
) -> None:
    model, host = tiny.model(), session()
    flash(host, model.image)
    bad = ModelImage(model.codec_identifier, "bad", "1", "", payload()).pack()
    with pytest.raises(ControllerError, match=reason):
        flash(host, bad)
    host.open_session()
    assert [image.state for image in host.description.images] == [SlotState.CONFIRMED, SlotState.EMPTY]
    still = running(host)
    assert still is not None and still.name == "tiny"
    stream = streamed(model)
    np.testing.assert_array_equal(played(host, stream), stream.decode_integers())
