"""The package of a checkpoint: its files, the parts of an image, families."""

from dataclasses import replace

import numpy as np
import pytest

from tests.export import tiny
from vibrocast import textures
from vibrocast.codec import CodecError
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.eva_image import PRIOR_KINDS, EvaImage, PriorKind
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.export.package import Contents


@pytest.mark.parametrize(
    "contents", [pytest.param("core", marks=pytest.mark.slow), pytest.param("onnx", marks=pytest.mark.slow), "both"]
)
def test_an_image_holds_the_requested_parts(contents: Contents) -> None:
    package, both = tiny.package(contents), EvaImage.unpack(tiny.model("both").tables)
    image = EvaImage.unpack(ModelImage.unpack(package.image).payload)
    assert (image.network is not None, bool(image.graph)) == (contents != "onnx", contents != "core")
    assert image.runtime == ("onnx" if contents == "onnx" else "core")
    np.testing.assert_array_equal(image.probabilities, both.probabilities)
    assert (package.full == package.image) == (contents == "both")


@pytest.mark.parametrize(("contents", "missing"), [("core", "onnx"), ("onnx", "core")])
def test_a_runtime_that_an_image_does_not_have_is_rejected(contents: Contents, missing: str) -> None:
    with pytest.raises(CodecError, match=f"runtime {contents}"):
        encoding = encode_recording(
            textures.GENERATORS["rough"](5, 0.3), setting={"level": 1.0}, model=tiny.model(contents)
        )
        replace(encoding.stream, runtime=missing).decode()


@pytest.mark.parametrize("prior", PRIOR_KINDS)
def test_the_prior_of_an_image_is_the_requested_one(prior: PriorKind) -> None:
    assert EvaImage.unpack(tiny.model("core", prior=prior).tables).prior == prior
