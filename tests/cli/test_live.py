"""`vibrocast live`: a generated texture, and raw samples from standard input."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from studies.faulty_bench import Misreading, at_half_gain
from vibrocast.errors import LIMIT_MISSED
from vibrocast.host import live_watch
from vibrocast.host.cli.command_line import main
from vibrocast.simulated_device.controller import Controller
from vibrocast.simulated_device.faulty_link import FaultyDirection
from vibrocast.simulated_device.serial_port import serial_port


def run(*arguments: str, data: bytes = b"") -> Result:
    return CliRunner().invoke(main, ["live", *arguments], input=data)


def test_a_generated_texture_is_streamed() -> None:
    result = run("rough", "--seconds", "0.3", "--playout-delay-ms", "300")
    assert result.exit_code == 0, result.output
    assert re.search(r"^underruns 0, lost packets 0 of \d+, damaged frames 0 there, 0 back$", result.output, re.M)


@pytest.mark.parametrize(
    ("source", "line"),
    [
        (["rough", "--seconds", "0.3"], r"streaming \d+ % 0\.\d of 0\.3 s  \d+\.\d\d kbit/s  underruns \d+"),
        (["-", "--unit", "um"], r"streaming 0\.\d s  \d+\.\d\d kbit/s  underruns \d+"),
    ],
)
def test_progress_has_a_percentage_where_the_end_is_known(
    source: list[str], line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vibrocast.progress.LINE_INTERVAL_S", 0.0)
    result = run(*source, "--playout-delay-ms", "300", data=bytes(2 * 800))
    assert result.exit_code == 0, result.output
    lines = result.stderr.splitlines()
    assert all(re.fullmatch(line, each) for each in lines if each.startswith("streaming"))
    last = re.search(r" (\d\.\d) ", lines[-1])
    assert last is not None and float(last[1]) == 0.3


@pytest.mark.parametrize(("name", "kind"), [("int16", "<i2"), ("float32", "<f4")])
def test_raw_samples_are_streamed_to_their_end(name: str, kind: str) -> None:
    samples = (0.2 * np.random.default_rng(1).standard_normal((800, 2)) * (32768 if name == "int16" else 1)).astype(
        kind
    )
    data = samples.tobytes() + b"\0"  # half a sample at the end is no sample
    given = ("--format", name, "--channels", "2", "--unit", "um", "--full-scale", "20", "--playout-delay-ms", "300")
    result = run("-", *given, data=data)
    assert result.exit_code == 0, result.output


def test_raw_samples_are_coded_for_touch() -> None:
    data = (3000 * np.random.default_rng(1).standard_normal(800)).astype("<i2").tobytes()
    given = ("-", "--unit", "m/s^2", "--full-scale", "20", "--playout-delay-ms", "300")
    assert run(*given, "--touch", "1", data=data).exit_code == 0
    rejected = run(*given, "--touch", "1", "--codec", "slp", data=data)
    assert rejected.exit_code == 2
    assert "slp cannot shape its error for touch" in rejected.output


def test_low_delay_means_blocks_of_2_ms(tmp_path: Path) -> None:
    report = tmp_path / "live.json"
    given = ("rough", "--seconds", "0.3", "--low-delay", "--report", str(report))
    result = run(*given, "--playout-delay-ms", "300")
    assert result.exit_code == 0, result.output
    assert json.loads(report.read_text())["packets"] == pytest.approx(0.3 * 8000 / 16, abs=2)
    assert run(*given, "--constant-rate-bps", "8000").exit_code == 2


def test_a_source_without_a_sample_is_rejected() -> None:
    result = run("-", "--unit", "drive")
    assert result.exit_code == 2
    assert "ended before its first sample" in result.output


def test_the_unit_of_raw_samples_is_asked_for() -> None:
    result = run("-")
    assert result.exit_code == 2
    assert "missing --unit" in result.output


def test_a_recording_that_is_piped_in_is_rejected() -> None:
    result = run("-", "--unit", "g", data=bytes(2 * 2800 * 120))
    assert result.exit_code == 2
    assert "the source is not live" in result.output


def test_samples_that_are_no_numbers_are_rejected() -> None:
    result = run("-", "--unit", "m/s^2", "--format", "float32", data=np.full(800, np.nan, "<f4").tobytes())
    assert result.exit_code == 2
    assert "NaN" in result.output


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["--model", "eva-16-4"], ["--codec", "eva"], ["--model", "mdct-textures"]])
def test_a_model_is_flashed_and_streamed_with(arguments: list[str]) -> None:
    result = run("rough", "--seconds", "0.3", "--playout-delay-ms", "300", *arguments)
    assert result.exit_code == 0, result.output
    assert re.search(r"^underruns 0, lost packets 0 of \d+, damaged frames 0 there, 0 back$", result.output, re.M)


def test_a_model_of_another_codec_is_rejected() -> None:
    result = run("rough", "--model", "eva-16-4", "--codec", "dct")
    assert result.exit_code == 2
    assert "is not for the codec dct" in result.output


def test_a_rate_is_streamed_and_reported(tmp_path: Path) -> None:
    report = tmp_path / "live.json"
    arguments = ["--constant-rate-bps", "4000", "--playout-delay-ms", "300", "--report", str(report)]
    result = run("rough", "--seconds", "0.6", *arguments)
    assert result.exit_code == 0, result.output
    figures = json.loads(report.read_text())
    assert figures["payload_bits_per_second"] < figures["wire_bits_per_second"]
    assert figures["playout_delay_ms"] == 300
    assert figures["underruns"] == figures["dropped_packets"] == 0


@pytest.mark.parametrize(
    ("arguments", "exit_code", "told"),
    [
        (["--constant-rate-bps", "300", "--packet-ms", "20"], 2, "cannot be held"),
        (["--constant-rate-bps", "20"], 2, "choose 264 bit/s or more"),
        (["--constant-rate-bps", "50", "--packet-ms", "20000"], 1, "choose shorter packets with --packet-ms"),
    ],
)
def test_a_rate_out_of_reach_is_rejected(arguments: list[str], exit_code: int, told: str) -> None:
    result = run("rough", *arguments)
    assert result.exit_code == exit_code
    assert told in result.output


def bench_file(folder: Path, address: str, limits: str = "") -> str:
    """Write a bench file with a controller named "it" and return its name."""
    path = folder / "bench.toml"
    path.write_text(f'[[controllers]]\nname = "it"\naddress = "{address}"\n[limits]\n{limits}\n')
    return str(path)


class Damaged(Controller):
    """A controller behind a wire that damages one in ten frames to it."""

    def __init__(self) -> None:
        super().__init__()
        self._wire = FaultyDirection(3, flipped=0.1)

    def receive(self, data: bytes, now_us: int) -> None:
        super().receive(self._wire.carry(data), now_us)


def test_lost_packets_and_damaged_frames_fail_and_are_named(tmp_path: Path) -> None:
    report = tmp_path / "live.json"
    with serial_port(Damaged()) as port:
        result = run("rough", "--seconds", "2", "--device", f"serial:{port.name}", "--report", str(report))
    written = json.loads(report.read_text())
    assert written["lost_packets"] > 0.01 * written["packets"]
    assert written["bad_frames"] > 0
    assert result.exit_code == LIMIT_MISSED
    assert "warning: frames were damaged on the wire; check cable" in result.output
    assert re.search(r"error: limits missed: live: lost_percent = [\d.]+, max_lost_percent = 1;", result.output)


def test_a_bench_file_gives_controller_and_limits(tmp_path: Path) -> None:
    with serial_port(Damaged()) as port:
        bench = bench_file(tmp_path, f"serial:{port.name}", "max_lost_percent = 100\nmax_bad_frames = 0")
        result = run("rough", "--seconds", "1", "--bench", bench, "--device", "it")
    assert result.exit_code == LIMIT_MISSED
    assert re.search(r"error: limits missed: live: bad_frames = \d+, max_bad_frames = 0;", result.output)
    assert (
        run("rough", "--seconds", "0.5", "--bench", bench_file(tmp_path, "sim", "max_lost_percent = 100")).exit_code
        == 0
    )


def test_minutes_are_counted_and_an_interrupted_stream_leaves_its_report(tmp_path: Path) -> None:
    report = tmp_path / "live.json"
    assert run("rough", "--seconds", "0.5", "--playout-delay-ms", "300", "--report", str(report)).exit_code == 0
    (minute,) = json.loads(report.read_text())["minutes"]
    assert (minute["packets"], minute["cause"]) == (88, None)
    assert 0 < minute["margin_ms"] <= 310 and minute["host_late_ms"] >= 0 and minute["host_jitter_ms"] >= 0

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vibrocast.host.live_watch.Watch.note", interrupted)
        assert run("rough", "--seconds", "30", "--report", str(report)).exit_code == 130
    cut = json.loads(report.read_text())
    assert 0 < cut["seconds"] < 30 and cut["snr_db"] is None


@pytest.mark.parametrize("options", [(), ("--capped-rate-bps", "6000", "--snr-db", "12")])
def test_the_quality_of_the_codec_stands_next_to_that_at_the_skin(tmp_path: Path, options: tuple[str, ...]) -> None:
    report = tmp_path / "live.json"
    result = run("wood", "--seconds", "1.5", "--playout-delay-ms", "300", "--report", str(report), *options)
    assert result.exit_code == 0, result.output
    quality = json.loads(report.read_text())
    assert quality["skin"]["weighted_snr_db"] > quality["skin"]["snr_db"]
    weighted = f"weighted SNR {quality['skin']['weighted_snr_db']:.1f} dB"
    assert f"SNR {quality['snr_db']:.2f} dB; at the skin, by models, {weighted} with the codec" in result.output


def test_a_limit_at_the_skin_is_judged(tmp_path: Path) -> None:
    bench = bench_file(tmp_path, "sim", "min_snr_db = 40\nmax_lost_percent = 100")
    result = run("rough", "--seconds", "1.5", "--playout-delay-ms", "300", "--bench", bench)
    assert result.exit_code == LIMIT_MISSED
    assert re.search(r"live: snr_db = [\d.]+, min_snr_db = 40", result.output)


def test_the_times_of_a_stream_are_judged(tmp_path: Path) -> None:
    bench = bench_file(tmp_path, "sim", "max_latency_ms = 1\nmax_lost_percent = 100")
    result = run("rough", "--seconds", "1.5", "--playout-delay-ms", "300", "--bench", bench)
    assert result.exit_code == LIMIT_MISSED
    assert "limits missed: live: latency_ms" in result.output


@pytest.mark.parametrize("limit", ["max_latency_ms = 1000", "min_snr_db = -10", "min_gain = 0"])
def test_a_figure_that_a_short_stream_does_not_show_misses_its_limit(tmp_path: Path, limit: str) -> None:
    bench = bench_file(tmp_path, "sim", f"{limit}\nmax_lost_percent = 100")
    result = run("rough", "--seconds", "0.2", "--bench", bench)
    assert result.exit_code == LIMIT_MISSED
    assert f"{limit.split(' ')[0][4:]} is not known, {limit};" in result.output


def test_a_controller_that_plays_something_else_fails(tmp_path: Path) -> None:
    with serial_port(Misreading(Controller, at_half_gain)) as port:
        bench = bench_file(tmp_path, f"serial:{port.name}", "max_gain = 1.1\nmax_lost_percent = 100")
        result = run("rough", "--seconds", "1", "--playout-delay-ms", "300", "--bench", bench)
    assert result.exit_code == 1
    assert "decoded as sent yes, DAC as computed NO" in result.output
    assert "played something else than was sent" in result.output


@pytest.mark.parametrize(
    ("counts", "cause"),
    [
        ({}, None),
        ({"bad_frames": 3}, None),
        ({"lost_packets": 1, "host_late_ms": 2.0}, "wire"),
        ({"lost_packets": 1, "host_late_ms": 8.0}, "host"),
        ({"lost_packets": 1, "host_late_ms": 8.0, "bad_frames": 1}, "wire"),
        ({"underruns": 1, "output_gaps": 1, "host_late_ms": 8.0}, "device"),
        ({"restarts": 1}, "wire"),
    ],
)
def test_a_minute_names_what_made_it_lose_something(counts: dict[str, float], cause: str | None) -> None:
    assert live_watch.cause(live_watch.Minute(0.0, **counts), playout_delay_ms=10.0) == cause  # type: ignore[arg-type]
