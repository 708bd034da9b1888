"""Which model is used where none is named: of the smallest family that can do what is asked of this signal."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.command import fails, succeeds
from tests.export import tiny
from vibrocast import models, textures
from vibrocast.codec import CODECS, CodecError, TargetUnreachable
from vibrocast.codec.encoding import default_model, encode_recording
from vibrocast.codec.rate_control import RateTarget
from vibrocast.codec.stream import read_stream


@pytest.fixture(autouse=True)
def shipped(monkeypatch: pytest.MonkeyPatch) -> tuple[models.Model, ...]:
    """Two families: of three lambdas and, in larger images, of one that reaches more."""
    several = (
        *(
            tiny.model("core", name=f"low-{number}", lambda_=lambda_)
            for number, lambda_ in enumerate((0.4, 2.0, 10.0), 1)
        ),
        tiny.model("both", name="fine-1", lambda_=1000.0),
    )
    assert [len(model.image) for model in several] == sorted(len(model.image) for model in several)
    monkeypatch.setattr(models, "shipped", lambda: several)
    return several


def texture() -> textures.Recording:
    return textures.GENERATORS["rough"](seed=5, seconds=0.5)


def chosen(**target: float) -> str | None:
    return encode_recording(texture(), codec_name="eva", **target).stream.model_name  # type: ignore[arg-type]


@pytest.mark.parametrize(("snr_db", "names"), [(3, {"low-1"}), (12, {"low-2", "low-3"}), (25, {"fine-1"})])
def test_the_smallest_family_that_meets_the_snr_and_a_member_near_it(snr_db: float, names: set[str]) -> None:
    assert chosen(snr_db=snr_db) in names


def test_of_the_members_around_the_snr_the_one_of_the_fewest_bits(shipped: tuple[models.Model, ...]) -> None:
    best = encode_recording(texture(), codec_name="eva", snr_db=12).stream
    for model in shipped[1:3]:
        assert best.size_bytes <= encode_recording(texture(), model=model, snr_db=12).stream.size_bytes


@pytest.mark.parametrize(("rate_bps", "names"), [(1500, {"low-1"}), (3300, {"low-2", "low-3"}), (30_000, {"low-3"})])
def test_the_smallest_family_that_meets_the_rate_and_a_member_near_it(rate_bps: float, names: set[str]) -> None:
    assert chosen(rate_bps=rate_bps) in names


def test_a_family_that_was_trained_for_touch_comes_last(
    shipped: tuple[models.Model, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It needs more bits at equal SNR, even if its images are the smallest."""
    trained = {"training": {"configuration": {"training": {"distortion": "acceleration"}}}}
    for_touch = [replace(model, card={**model.card, **trained}) for model in shipped[:3]]
    monkeypatch.setattr(models, "shipped", lambda: (*for_touch, shipped[3]))
    assert default_model(CODECS["eva"]).name == "fine-1"
    assert chosen(snr_db=12) == "fine-1"


def test_without_a_target_the_middle_of_the_smallest_family() -> None:
    assert encode_recording(texture(), codec_name="eva", setting={"level": 1}).stream.model_name == "low-2"
    assert default_model(CODECS["eva"]).name == "low-2"


@pytest.mark.parametrize(
    ("target", "names"),
    [
        (RateTarget(constant_rate_bps=2000), {"low-1", "low-2"}),
        (RateTarget(constant_rate_bps=9000), {"low-3"}),
    ],
)
def test_rate_controlled_streams_take_a_member_near_the_target(target: RateTarget, names: set[str]) -> None:
    stream = encode_recording(texture(), target=target, codec_name="eva").stream
    assert stream.model_name in names


def test_an_impossible_target_is_rejected_with_the_best_of_the_largest_family() -> None:
    with pytest.raises(TargetUnreachable, match="an SNR of 60 dB cannot be met; this signal reaches"):
        chosen(snr_db=60)
    with pytest.raises(TargetUnreachable, match="a rate of 10 bit/s cannot be met"):
        chosen(rate_bps=10)


def test_progress_never_falls_from_one_model_to_the_next() -> None:
    told: list[float] = []
    encode_recording(texture(), codec_name="eva", snr_db=25, progress=told.append)
    assert told == sorted(told)
    assert told[0] > 0 and told[-1] <= 1


def test_a_stream_of_an_unknown_model_is_named_by_its_hash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = encode_recording(texture(), codec_name="eva").stream
    stream.save(tmp_path / "rough.vct")
    monkeypatch.setattr(models, "shipped", lambda: ())
    with pytest.raises(CodecError, match=f"{stream.header.image_hash.hex()}, which does not ship"):
        read_stream(tmp_path / "rough.vct")


def test_commands_name_the_model_that_they_chose(tmp_path: Path) -> None:
    path, coded = tmp_path / "rough.wav", tmp_path / "rough.vct"
    textures.save(path, texture())
    assert "model low-" in succeeds("encode", path, coded, "--codec", "eva", "--snr-db", 4)
    assert "low-" in succeeds("info", coded)
    assert "runtime core" in fails(2, "decode", coded, tmp_path / "out.wav", "--runtime", "onnx")
    succeeds("decode", coded, tmp_path / "out.wav", "--runtime", "core")
    assert "decoded as sent  yes" in succeeds("play", coded)
