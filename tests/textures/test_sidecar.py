"""The sidecar of a WAV file: what it adds, and where it contradicts the file."""

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vibrocast import textures
from vibrocast.textures import Recording, TextureError, sidecar, sound_files

SAMPLES = np.random.default_rng(1).standard_normal((500, 3)) * 5
FACTS = {"unit": "m/s^2", "rate_hz": 1000, "channels": 3, "axes": "xyz"}


def written(folder: Path, axes: str = "xyz", unit: str = "m/s^2") -> Path:
    path = folder / "out.wav"
    writer = sound_files.Writer(path, 1000, SAMPLES.shape[1], unit, axes)
    for start in range(0, len(SAMPLES), 64):
        writer.write(SAMPLES[start : start + 64])
    writer.close()
    return path


def edited(folder: Path, subtype: str = "FLOAT") -> Path:
    """Return a file without a comment, as other programs write it."""
    path = folder / "out.wav"
    soundfile.write(path, SAMPLES / 100 if subtype != "FLOAT" else SAMPLES, 1000, subtype)
    return path


def test_two_axes_are_chosen_by_name(tmp_path: Path) -> None:
    path = tmp_path / "out.wav"
    soundfile.write(path, SAMPLES[:, :2], 1000, "FLOAT")
    facts = {"unit": "m/s^2", "rate_hz": 1000, "channels": 2, "axes": "xz"}
    sidecar.write(sidecar.path_of(path), facts)
    assert textures.load(path, columns="z").samples == pytest.approx(SAMPLES[:, 1:2], rel=1e-6)


def test_a_file_written_in_pieces_states_unit_and_axes(tmp_path: Path) -> None:
    recording = textures.load(written(tmp_path))
    assert recording.samples == pytest.approx(SAMPLES, rel=1e-6)
    assert (recording.rate_hz, recording.unit, recording.axes) == (1000.0, "m/s^2", ("X", "Y", "Z"))
    with pytest.raises(TextureError, match="three axes of one texture"):
        textures.load_for_actuators(written(tmp_path))
    assert textures.load_for_actuators(written(tmp_path), columns="z").samples == pytest.approx(
        SAMPLES[:, 2:], rel=1e-6
    )


def test_a_file_can_be_read_at_any_time_while_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "out.wav"
    writer = sound_files.Writer(path, 1000, 3, "m/s^2", "xyz")
    writer.write(SAMPLES[:100])
    assert len(textures.load(path).samples) == 100
    writer.write(SAMPLES[100:])
    writer.shorten(20)
    assert textures.load(path).samples == pytest.approx(SAMPLES[:20], rel=1e-6)
    writer.close()


def test_axes_survive_saving(tmp_path: Path) -> None:
    path = tmp_path / "saved.wav"
    textures.save(path, Recording(SAMPLES, 1000.0, "m/s^2", "it", ("X", "Y", "Z")), sixteen_bit=True)
    assert textures.load(path).axes == ("X", "Y", "Z")


def test_a_sidecar_stands_in_for_a_lost_comment(tmp_path: Path) -> None:
    path = edited(tmp_path)
    assert textures.load(path).unit == "full scale"
    sidecar.write(sidecar.path_of(path), FACTS)
    recording = textures.load(path)
    assert (recording.unit, recording.axes) == ("m/s^2", ("X", "Y", "Z"))
    assert recording.samples == pytest.approx(SAMPLES, rel=1e-6)


def test_integers_without_a_comment_have_no_size(tmp_path: Path) -> None:
    path = edited(tmp_path, "PCM_16")
    sidecar.write(sidecar.path_of(path), FACTS)
    with pytest.raises(TextureError, match="save it as 32-bit float"):
        textures.load(path)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"unit": "um"}, "has m/s\\^2 as unit, and out.json says um"),
        ({"axes": ""}, "has xyz as axes, and out.json says none"),
        ({"rate_hz": 2000}, "has 1000.0 Hz, and out.json says 2000.0"),
        ({"channels": 2, "axes": "xy"}, "has 3 channels, and out.json says 2"),
        ({"axes": "zz"}, "wrong unit, rate_hz, channels or axes"),
        ({"unit": "furlong"}, "wrong unit"),
        ({"rate_hz": True}, "wrong unit"),
        ({"unit": ["um"]}, "wrong unit"),
    ],
)
def test_a_contradiction_is_an_error(tmp_path: Path, change: dict[str, object], error: str) -> None:
    path = written(tmp_path)
    sidecar.write(sidecar.path_of(path), FACTS | change)
    with pytest.raises(TextureError, match=error):
        textures.load(path)


@pytest.mark.parametrize("content", [b"", b"[1]", b'{"kind": "a tune"}', b"\xff\xfe", b"[" * 100_000, b'{"a": NaN}'])
def test_another_file_of_that_name_counts_for_nothing(tmp_path: Path, content: bytes) -> None:
    path = written(tmp_path)
    sidecar.path_of(path).write_bytes(content)
    assert textures.load(path).unit == "m/s^2"


VALUES = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.lists(st.integers()))


@given(st.dictionaries(st.sampled_from(["unit", "rate_hz", "channels", "axes"]), VALUES))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_sidecar_is_taken_or_rejected(tmp_path: Path, change: dict[str, object]) -> None:
    path = written(tmp_path)
    sidecar.path_of(path).write_text(json.dumps({"kind": sidecar.MARK, **FACTS, **change}))
    try:
        assert textures.load(path).unit == "m/s^2"
    except TextureError:
        return
