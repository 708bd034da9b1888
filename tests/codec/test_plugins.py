"""Codecs of other packages: the example that ships, and those that fail."""

import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.command import run
from vibrocast import codec, textures
from vibrocast.codec import CodecError, plugins, registry
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import read_stream

EXAMPLE = Path(__file__).parents[2] / "examples" / "codec_plugin"
SIGNAL = np.random.default_rng(0).normal(0, 0.2, (3000, 2))


class Broken:
    name, summary, block_samples, qualities = "broken", "returns too little", 16, (1.0, 2.0)

    def encode(self, samples: Any, quality: float) -> bytes:
        if quality == 1:
            raise RuntimeError("no room")
        return b"1"

    def decode(self, data: bytes, samples: int, channels: int, quality: float) -> Any:
        return np.zeros(3)


@pytest.fixture
def haar(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the example, and packages that cannot be used, look installed."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    found = {
        "haar": "vibrocast_haar:Haar",
        "mdct": "vibrocast_haar:Haar",
        "absent": "no_such_module:Codec",
        "empty": "builtins:dict",
        "broken": f"{__name__}:Broken",
    }
    points = EntryPoints(EntryPoint(name, value, plugins.GROUP) for name, value in found.items())
    monkeypatch.setattr(plugins, "entry_points", lambda group: points.select(group=group))
    monkeypatch.setattr(registry, "CODECS", registry.Codecs())
    monkeypatch.setattr(codec, "CODECS", registry.CODECS)


@pytest.mark.usefixtures("haar")
def test_the_example_codes_to_an_snr_and_its_stream_is_read_again(tmp_path: Path) -> None:
    recording = textures.Recording(SIGNAL, 2800.0, "m/s^2", "noise")
    encoding = encode_recording(recording, codec_name="haar", snr_db=20.0)
    assert encoding.quality.snr_db == pytest.approx(20, abs=0.5)
    encoding.stream.save(tmp_path / "noise.vct")
    stream = read_stream(tmp_path / "noise.vct")
    assert stream.codec_name == "haar"
    np.testing.assert_array_equal(stream.decode(), encoding.stream.decode())


@pytest.mark.usefixtures("haar")
def test_packages_that_cannot_be_used_leave_the_others_alone() -> None:
    assert {"haar", "broken", *codec.BUILT_IN} == set(codec.CODECS)
    assert set(codec.CODECS.failures) == {"mdct", "absent", "empty"}
    assert codec.CODECS["mdct"] is codec.BUILT_IN["mdct"]
    with pytest.raises(CodecError, match="absent cannot be loaded: no_such_module:Codec: ModuleNotFoundError"):
        codec.codec_by_name("absent")


@pytest.mark.usefixtures("haar")
@pytest.mark.parametrize(("quality", "message"), [(1, "broken failed: RuntimeError: no room"), (2, "did not return")])
def test_a_codec_that_fails_is_named(quality: float, message: str) -> None:
    with pytest.raises(CodecError, match=message):
        codec.encode(SIGNAL, 2800, {"quality": quality}, codec="broken").decode()


@pytest.mark.usefixtures("haar")
def test_damaged_packets_and_configurations_raise() -> None:
    coded = codec.encode(SIGNAL, 2800, {"quality": 6}, codec="haar")
    decoder = codec.decoder(plugins.IDENTIFIER, coded.header.configuration, 2)
    for packet in (b"", b"\xff", b"\x01", coded.packets[0][:-40], b"\x01" + bytes(40)):
        with pytest.raises(CodecError):
            decoder.decode(packet)
    for configuration in (
        b"",
        b"\x04haar",
        coded.header.configuration[:-1],
        b"\x04hoar" + coded.header.configuration[5:],
    ):
        with pytest.raises(CodecError):
            codec.decoder(plugins.IDENTIFIER, configuration, 2)


@pytest.mark.usefixtures("haar")
def test_a_lost_packet_fades_out() -> None:
    coded = codec.encode(SIGNAL, 2800, {"quality": 6}, codec="haar", live=True)
    decoder = codec.decoder(plugins.IDENTIFIER, coded.header.configuration, 2)
    last = decoder.decode(coded.packets[0])
    np.testing.assert_array_equal(decoder.conceal()[0], last[-1])
    assert not np.any(decoder.conceal())


def test_without_the_package_the_stream_names_its_codec(haar: None, monkeypatch: pytest.MonkeyPatch) -> None:
    coded = codec.encode(SIGNAL, 2800, {"quality": 6}, codec="haar")
    monkeypatch.setattr(plugins, "entry_points", lambda group: EntryPoints())
    monkeypatch.setattr(registry, "CODECS", registry.Codecs())
    with pytest.raises(CodecError, match="needs the codec 'haar'; install the package"):
        codec.decoder(plugins.IDENTIFIER, coded.header.configuration, 2)
    sys.modules.pop("vibrocast_haar", None)


@pytest.mark.usefixtures("haar")
def test_the_list_of_codecs_names_those_that_cannot_be_loaded() -> None:
    listed = run("codecs")
    assert "haar  " in listed.stdout
    assert "warning: the codec absent cannot be loaded: no_such_module:Codec: ModuleNotFoundError" in listed.stderr
