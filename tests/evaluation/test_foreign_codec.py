"""A codec of somebody else's, known by CODECS alone, goes through the benchmark, its page and the stability maps."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from vibrocast import codec, textures
from vibrocast.codec import Decoded, Framing, Model, Setting, Signal, SignalFormat, Steering
from vibrocast.codec.interface import varint
from vibrocast.codec.packetwise import PacketwiseEncoder
from vibrocast.evaluation import cells, cost, workers
from vibrocast.evaluation.points import Point, read_rows
from vibrocast.evaluation.stability import maps, signals
from vibrocast.evaluation.stability.trials import Outcome, Trial, attempt
from vibrocast.host.command_line import main
from vibrocast.textures.generate import rough, wood

NAME = "coarse-pcm"
BLOCK = 32


class CoarseEncoder(PacketwiseEncoder):
    """Samples of some bits, a byte each."""

    def __init__(self, setting: Setting, channels: int, framing: Framing) -> None:
        super().__init__(channels, framing, BLOCK, 255)
        self._sent = 0
        self._levels = 2 ** (int(float(str(setting["bits"]))) - 1)
        self.configuration = bytes([self._levels, self.packet_samples // BLOCK])

    def _code_packets(self, samples: Signal) -> list[bytes]:
        whole = np.clip(np.rint(samples * self._levels), -self._levels, self._levels - 1).astype(np.int8)
        packets = np.split(whole, len(whole) // self.packet_samples)
        first, self._sent = self._sent, self._sent + len(packets)
        # The sequence number, and that every packet is a refresh.
        return [varint(2 * number + 1) + packet.tobytes() for number, packet in enumerate(packets, first)]


class CoarseDecoder:
    """Undoes it."""

    delay_samples = 0

    def __init__(self, configuration: bytes, channels: int, tables: bytes | None) -> None:
        self._levels, blocks = configuration
        self.channels, self.packet_samples = channels, blocks * BLOCK

    def decode(self, packet: bytes) -> Decoded:
        whole = (
            np.frombuffer(packet[-self.packet_samples * self.channels :], np.int8)
            .reshape(-1, self.channels)
            .astype(np.int16)
        )
        return np.asarray(whole * (32768 // self._levels), np.int16)

    def conceal(self) -> Decoded:
        return np.zeros((self.packet_samples, self.channels), np.int16)


def make_encoder(
    setting: Setting, signal_format: SignalFormat, framing: Framing, model: Model | None, steering: Steering | None
) -> CoarseEncoder:
    return CoarseEncoder(setting, signal_format.channels, framing)


CODEC = codec.Codec(
    NAME,
    next(number for number in range(1, 16) if number not in {known.identifier for known in codec.CODECS.values()}),
    "samples of a few bits",
    {"bits": codec.Parameter("2 to 7", 6, 2, 7, whole=True)},
    {NAME: tuple({"bits": bits} for bits in range(2, 8))},
    make_encoder,
    CoarseDecoder,
)


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(codec.CODECS, NAME, CODEC)


def here(pieces: Iterator[Any], processes: int) -> Iterator[Any]:
    for key, work in pieces:
        yield key, work()


def test_the_benchmark_takes_it_as_any_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "on_cores", here)
    monkeypatch.setattr(cost, "peak_memory_bytes", lambda codec_name, model: None)
    (tmp_path / "recordings").mkdir()
    textures.save_wav(tmp_path / "recordings" / "rough.wav", rough(0, 0.5))
    textures.save_wav(tmp_path / "recordings" / "wood.wav", wood(1, 0.5))
    arguments = ["bench", str(tmp_path / "recordings"), "--out", str(tmp_path / "out"), "--repeats", "1"]
    result = CliRunner().invoke(main, [*arguments, "--codecs", f"{NAME},slp"])
    assert result.exit_code == 0, result.output
    points = read_rows(tmp_path / "out" / "results" / "points.csv", Point)
    own = [point for point in points if point.codec == NAME]
    assert len(own) == 12 and max(point.snr_db or 0 for point in own) > 20
    page = (tmp_path / "out" / "results.md").read_text()
    assert f"- `{NAME}`: samples of a few bits" in page
    assert any(line.startswith(f"| {NAME} |") for line in page.splitlines())
    assert f"\n{NAME}," in (tmp_path / "out" / "results" / "speeds.csv").read_text()
    assert "decoder not counted" in (tmp_path / "out" / "results" / "costs.csv").read_text()


def test_the_key_of_a_cell_changes_with_its_source(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (method,) = cells.methods([NAME])
    cell = cells.Cell("wood", wood(0, 0.1), method, method.settings[0], 0)
    key = cell.key
    (tmp_path / "edited.py").write_text("# another")
    monkeypatch.setattr(sys.modules[__name__], "__file__", str(tmp_path / "edited.py"))
    assert cell.key != key


def test_the_stability_maps_take_it() -> None:
    (method,) = maps.methods([NAME], ())
    rung = maps.three_rungs(method)["high"]
    made = attempt(
        Trial("signals", NAME, "texture", f"high: {rung.text}", None, lambda: signals.measure(rung, "texture"))
    )
    assert made.outcome is Outcome.HOLDS
