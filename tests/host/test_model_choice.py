"""Which model is used where none is named: the smallest that ships and can do what is asked of this signal."""

from pathlib import Path

import numpy as np
import pytest

from tests.cli.test_command_line import fails, succeeds
from tests.export import tiny
from vibrocast import models, textures
from vibrocast.codec import CodecError, TargetUnreachable
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import read_stream


@pytest.fixture(autouse=True)
def shipped(monkeypatch: pytest.MonkeyPatch) -> tuple[models.Model, ...]:
    """Three models: of a single rate, of low rates, of all rates; the images are larger from each to the next."""
    several = (
        tiny.model("core", name="kin-1", lambdas=(100.0,)),
        tiny.model("core", name="low", lambdas=(0.4, 1.0)),
        tiny.model("both", name="all", lambdas=(0.4, 100.0)),
    )
    assert [len(model.image) for model in several] == sorted(len(model.image) for model in several)
    monkeypatch.setattr(models, "shipped", lambda: several)
    return several


def texture() -> textures.Recording:
    return textures.GENERATORS["rough"](seed=5, seconds=0.5)


def chosen(**target: float) -> str | None:
    return encode_recording(texture(), codec_name="eva", **target).stream.model_name  # type: ignore[arg-type]


def test_the_smallest_that_meets_the_snr() -> None:
    assert chosen(snr_db=4) == "low"
    assert chosen(snr_db=15) == "all"
    assert chosen() == "all"


def test_the_smallest_that_meets_the_rate() -> None:
    assert chosen(rate_bps=4000) == "low"


def test_a_setting_is_the_smallest_models() -> None:
    stream = encode_recording(texture(), codec_name="eva", setting={"quality": 1}).stream
    assert stream.model_name == "low"


def test_what_none_can_do_is_rejected_with_what_the_largest_reaches() -> None:
    with pytest.raises(TargetUnreachable, match="an SNR of 60 dB cannot be met; this signal reaches"):
        chosen(snr_db=60)
    with pytest.raises(TargetUnreachable, match="a rate of 10 bit/s cannot be met"):
        chosen(rate_bps=10)


def test_progress_never_falls_from_one_model_to_the_next() -> None:
    told: list[float] = []
    encode_recording(texture(), codec_name="eva", snr_db=15, progress=told.append)
    assert told == sorted(told)
    assert told[0] > 0 and told[-1] <= 1


def test_a_model_that_is_named_is_used(shipped: tuple[models.Model, ...]) -> None:
    single = shipped[0]
    encoding = encode_recording(texture(), model=single)
    assert (encoding.stream.codec_name, encoding.stream.model_name) == ("eva", "kin-1")


def test_without_any_model_the_error_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(models, "shipped", lambda: ())
    with pytest.raises(models.ModelError, match="no model for the codec eva ships"):
        chosen()


def test_streams_find_their_model_again(tmp_path: Path) -> None:
    stream = encode_recording(texture(), codec_name="eva").stream
    stream.save(tmp_path / "rough.vct")
    again = read_stream(tmp_path / "rough.vct")
    assert again.facts()["model"] == "all"
    np.testing.assert_array_equal(again.decode(), stream.decode())


def test_a_stream_of_an_unknown_model_is_named_by_its_hash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = encode_recording(texture(), codec_name="eva").stream
    stream.save(tmp_path / "rough.vct")
    monkeypatch.setattr(models, "shipped", lambda: ())
    with pytest.raises(CodecError, match=f"{stream.header.image_hash.hex()}, which is none of those that ship"):
        read_stream(tmp_path / "rough.vct")


@pytest.mark.parametrize("runtime", [(), ("--runtime", "core"), ("--runtime", "onnx")])
def test_play_on_a_simulated_controller_needs_nothing_else(runtime: tuple[str, ...], tmp_path: Path) -> None:
    path = tmp_path / "rough.wav"
    textures.save(path, texture())
    output = succeeds("play", path, "--codec", "eva", *runtime)
    assert "codec eva, model all" in output
    assert "decoded as sent  yes" in output


def test_commands_name_the_model_that_they_chose(tmp_path: Path) -> None:
    path, coded = tmp_path / "rough.wav", tmp_path / "rough.vct"
    textures.save(path, texture())
    assert "model low" in succeeds("encode", path, coded, "--codec", "eva", "--snr-db", 4)
    assert "low" in succeeds("info", coded)
    assert "runtime core" in fails(2, "decode", coded, tmp_path / "out.wav", "--runtime", "onnx")
    succeeds("decode", coded, tmp_path / "out.wav", "--runtime", "core")
    assert "decoded as sent  yes" in succeeds("play", coded)
