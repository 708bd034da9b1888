"""Tests of the `vibrocast` command: every subcommand, what it prints, its exit codes, and bad input of every kind."""

import dataclasses
import errno
import json
import os
import re
import shlex
import signal
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import click
import numpy as np
import pytest
import soundfile

from tests.command import OAK, ROOT, answer, fails, run, started, succeeds, titles
from vibrocast import codec, models, textures
from vibrocast.codec.stream import read_stream
from vibrocast.device_protocol.messages import State
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.errors import NO_DEVICE
from vibrocast.host import devices
from vibrocast.host.bench_file import actuator_toml
from vibrocast.host.cli import sections
from vibrocast.host.cli.command_line import main
from vibrocast.host.report import SCHEMA, Report
from vibrocast.output.actuator import ACTUATORS, Codes
from vibrocast.simulated_device.controller import Controller
from vibrocast.simulated_device.pty_port import PtyPort

IMAGE = ROOT / "models" / "mdct-textures" / "mdct-textures.vcmi"
PROFILE = ROOT / "examples" / "leather_profile.csv"
RATE_HZ = 2800


@pytest.fixture
def texture(tmp_path: Path) -> Path:
    """A texture short enough to lie in the controller's buffer before it is played: no busy machine disturbs it."""
    path = tmp_path / "texture.wav"
    samples = np.random.default_rng(3).normal(size=(RATE_HZ // 5, 1))
    textures.save(path, textures.Recording(samples, RATE_HZ, "m/s^2", "texture"))
    return path


@pytest.fixture
def coded(texture: Path, tmp_path: Path) -> Path:
    path = tmp_path / "texture.vct"
    succeeds("encode", texture, path)
    return path


@pytest.fixture
def three_axes(tmp_path: Path) -> Path:
    path, samples = tmp_path / "axes.csv", np.random.default_rng(0).normal(size=(560, 3))
    textures.save(path, textures.Recording(samples, RATE_HZ, "m/s^2", "axes", textures.AXES))
    return path


class Watched:
    """A simulated controller on a pseudo-terminal, and when it began to move its actuator."""

    def __init__(self) -> None:
        self.moved = threading.Event()
        self.port = PtyPort(Controller(on_dac=self._on_dac))
        self.address = f"serial:{self.port.name}"

    def _on_dac(self, codes: Codes) -> None:
        if codes.any():
            self.moved.set()


@pytest.fixture
def watched() -> Iterator[Watched]:
    controller = Watched()
    with controller.port:
        yield controller


def test_play_reports_and_draws(texture: Path, tmp_path: Path) -> None:
    report_path, plot_path = tmp_path / "report.json", tmp_path / "plot.png"
    output = succeeds("play", texture, "--report", report_path, "--plot", plot_path)
    assert "decoded as sent" in output
    assert "\x1b" not in output
    report = json.loads(report_path.read_text())
    assert set(report) == {field.name for field in dataclasses.fields(Report)}
    assert report["decoded_equals_offline"] is True
    assert report["dac_equals_offline"] is True
    assert (report["underruns"], report["lost_packets"], report["reconnects"]) == (0, 0, 0)
    assert report["quality"]["snr_db"] == pytest.approx(14.8, abs=0.2)
    assert report["bits_per_second"] == 8 * report["stream_bytes"] / 0.2
    assert report["bits_per_sample"] == pytest.approx(report["bits_per_second"] / RATE_HZ)
    assert report["wire"]["bytes_sent"] > report["stream_bytes"]
    timing = report["timing"]
    assert timing["end_to_end_ms"] > timing["algorithmic_ms"] + timing["buffered_ms"] > 0
    assert report["device"]["address"] == "sim"
    assert report["actuator"]["name"] == "piezo-stack"
    assert plot_path.stat().st_size > 10_000
    assert "packets          45.7 ms each, only the first can be decoded alone" in output


@pytest.mark.parametrize("missing", [[], ["--device", "serial:/dev/no-such-port"]])
def test_several_controllers_play_at_once_though_one_is_missing(
    missing: list[str], texture: Path, tmp_path: Path
) -> None:
    report_path = tmp_path / "reports.json"
    devices = ["--device", "sim", "--device", "sim-usb", "--device", "sim"]
    result = run("play", texture, *devices, *missing, "--report", report_path)
    assert result.exit_code == (NO_DEVICE if missing else 0), result.output
    lines = [line for line in result.stdout.splitlines() if "DAC as computed yes" in line]
    assert [line.split("  ")[0] for line in lines] == ["sim", "sim-usb", "sim (2)"]
    reports = json.loads(report_path.read_text())
    assert [report["device"]["address"] for report in reports] == ["sim", "sim-usb", "sim", *missing[1:]]
    if missing:
        assert "serial:/dev/no-such-port  FAILED: cannot open" in result.stdout
        assert result.stderr.splitlines()[-1].startswith("error: 1 of 4 controllers"), result.stderr


def test_report_page_explains_every_field() -> None:
    page = (ROOT / "docs" / "reference" / "report.md").read_text()
    missing = [field.name for field in dataclasses.fields(Report) if f"`{field.name}" not in page]
    assert missing == []


@pytest.mark.slow
@pytest.mark.parametrize(("samples", "level", "loops"), [(1, 1.0, 1), (17, 0.5, 1), (500, 0.0, 3), (500, 1.0, 3)])
def test_plays_extremes(samples: int, level: float, loops: int, tmp_path: Path) -> None:
    path = tmp_path / "extreme.wav"
    soundfile.write(path, np.full((samples, 2), level), RATE_HZ, subtype="FLOAT")
    report = answer("play", path, "--unit", "drive", "--loop", loops, "--plot", tmp_path / "plot.svg")
    assert (report["loops"], report["channels"], report["dac_equals_offline"]) == (loops, 2, True)
    assert (report["quality"]["snr_db"] is None) == (level == 0)


def test_plays_a_coded_file(coded: Path, tmp_path: Path) -> None:
    report_path = tmp_path / "report.json"
    output = succeeds("play", coded, "--report", report_path, "--plot", tmp_path / "plot.png")
    assert "each, only the first can be decoded alone" in output
    report = json.loads(report_path.read_text())
    assert report["stream_bytes"] == coded.stat().st_size
    assert report["quality"]["snr_db"] is None
    assert report["decoded_equals_offline"] is True
    longer = tmp_path / "longer.wav"
    textures.save(longer, textures.GENERATORS["rough"](seconds=0.5))
    assert "packets          45.7 ms each, one in 0.23 s can be decoded alone" in succeeds("play", longer)


def test_a_height_profile_is_over_position_unless_a_hand_speed_is_given(tmp_path: Path) -> None:
    assert "DAC as computed" in succeeds("play", PROFILE, "--hand-speed-mm-s", 50)
    assert "the speed of the hand over it" in fails(2, "play", PROFILE)
    out = tmp_path / "out.vct"
    assert "coded over position: " in succeeds("encode", PROFILE, out)
    assert read_stream(out).header.spatial
    assert "coded over position; give --hand" in fails(2, "play", out)
    assert "coded over time at 50 mm/s" in succeeds("encode", PROFILE, out, "--hand-speed-mm-s", 50)
    assert not read_stream(out).header.spatial
    assert "coded over time, not over position" in fails(2, "play", out, "--hand", 5, "--hand-speed-mm-s", 50)
    assert "a stream over time" in fails(2, "encode", PROFILE, out, "--live")
    assert "and no other option" in fails(2, "encode", PROFILE, out, "--unit", "um")


@pytest.mark.parametrize("suffix", [".wav", ".csv", ".npy", ".mat"])
def test_decodes_into_every_format(suffix: str, coded: Path, tmp_path: Path) -> None:
    out = tmp_path / f"out{suffix}"
    told = succeeds("decode", coded, out)
    assert f"at {RATE_HZ} Hz, {'1.0 is 1' if suffix == '.wav' else 'in'} m/s^2" in told
    options: dict[str, Any] = {"rate_hz": RATE_HZ, "unit": "m/s^2"} if suffix == ".npy" else {}
    np.testing.assert_array_equal(textures.load(out, **options).samples, read_stream(coded).decode())
    succeeds("encode", out, tmp_path / "again.vct", *(("--rate-hz", RATE_HZ, "--unit", "g") if options else ()))


def test_a_text_file_is_completed_by_options_and_doubts_are_told(tmp_path: Path) -> None:
    path, out = tmp_path / "log.csv", tmp_path / "out.vct"
    places = np.arange(400)
    noise = np.random.default_rng(4).normal(size=len(places))
    times_ms = np.floor(places / 0.8) + 40 * (places > 200)
    rows = [f"{time:.0f},{value:.4f},87" for time, value in zip(times_ms, noise, strict=True)]
    path.write_text("\n".join(["1,2,3", "Time (ms),Channel A,battery", *rows]))
    assert "pass over lines at the start with --skip-lines" in fails(2, "encode", path, out)
    given = ["encode", path, out, "--skip-lines", 1]
    assert "choose columns by name or number with --columns" in fails(2, *given)
    assert "with `vibrocast encode --columns`" in fails(2, "play", three_columns(tmp_path))
    given += ["--columns", "Channel A", "--unit", "mV", "--rate-hz", 800]
    assert "a gap of" in (told := fails(2, *given)) and "give --resample" in told
    assert "give the sensor's --sensitivity" in fails(2, *given, "--resample")
    assert "'much' is no sensitivity" in fails(2, *given, "--resample", "--sensitivity", "much")
    done = run(*given, "--resample", "--sensitivity", "100mV/g")
    assert done.exit_code == 0
    assert f"note: {path}: column of times 'Time': samples interpolated at 800 Hz" in done.stderr


def three_columns(folder: Path) -> Path:
    path = folder / "three.csv"
    path.write_text("time_s,x_g,battery\n0,1,87\n0.001,2,87\n")
    return path


def test_axes_are_chosen_or_reduced(three_axes: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.vct"
    succeeds("encode", three_axes, out)
    assert read_stream(out).header.channels == 3
    for columns, channels in (("x,y,z", 3), ("z,x", 2), ("dft321", 1), ("norm:3,2,1", 1), ("x", 1), ("2", 1)):
        succeeds("encode", three_axes, out, "--columns", columns)
        assert read_stream(out).header.channels == channels
    assert f"{three_axes}: three axes of one texture; encode it with --columns" in fails(2, "play", three_axes)


def test_encode_to_a_rate_and_at_another_stream_rate(tmp_path: Path) -> None:
    out = tmp_path / "oak.vct"
    succeeds("encode", OAK, out, "--rate-bps", 3000, "--stream-rate-hz", 2000)
    assert 2940 <= 8 * out.stat().st_size / 4 <= 3000
    assert answer("info", out)["rate_hz"] == 2000


def test_encode_live_codes_as_play_does(tmp_path: Path) -> None:
    out = tmp_path / "oak.vct"
    succeeds("encode", OAK, out, "--live")
    live = read_stream(out)
    assert live.packet_samples == 128
    assert answer("play", OAK)["stream_bytes"] == live.size_bytes


def test_lists_the_codecs() -> None:
    listed = succeeds("codecs")
    assert "mdct" in listed
    assert all(name in listed for known in codec.CODECS.values() for name in known.parameters)
    assert set(answer("codecs")) == set(codec.CODECS)


def test_generate(tmp_path: Path) -> None:
    one, again, other = tmp_path / "one.wav", tmp_path / "again.wav", tmp_path / "other.wav"
    for path, seed in ((one, 1), (again, 1), (other, 2)):
        succeeds("generate", "rough", path, "--seed", seed, "--seconds", 0.5, "--hand-speed-mm-s", 80)
    assert one.read_bytes() == again.read_bytes() != other.read_bytes()
    assert textures.load(one).seconds == 0.5


def test_generate_a_height_profile(tmp_path: Path) -> None:
    path = tmp_path / "wood.csv"
    assert "39.9857 mm" in succeeds("generate", "wood", path, "--seconds", 1, "--hand-speed-mm-s", 40)
    assert path.read_text().startswith("position_um,height_um\n0,")
    assert "choose one of grating, ridges" in fails(2, "generate", "taps", tmp_path / "taps.csv")
    assert "drop --speed-variation" in fails(2, "generate", "wood", path, "--speed-variation", 0.3)


def test_devices_and_status() -> None:
    assert "sim-usb" in succeeds("devices")
    assert "piezo-stack" in succeeds("status")
    facts = answer("status", "--device", "sim-usb")
    assert facts["status"]["state"] == "idle"
    assert facts["codecs"] == list(codec.CODECS)


def test_flash_then_play_a_stream_for_that_image(texture: Path, tmp_path: Path, watched: Watched) -> None:
    coded_path = tmp_path / "image.vct"
    assert "model mdct-textures" in succeeds("encode", texture, coded_path, "--model", IMAGE)
    rejection = fails(1, "play", coded_path, "--device", watched.address)
    assert "runs none; upload it first" in rejection
    command = re.search("`vibrocast (flash .*)`", rejection)
    assert command is not None
    assert "confirmed" in succeeds(*command.group(1).split())
    assert "mdct-textures" in succeeds("status", "--device", watched.address)
    assert "DAC as computed" in succeeds("play", coded_path, "--device", watched.address)


def test_a_simulated_controller_is_flashed_with_the_model_that_it_plays(texture: Path) -> None:
    report = answer("play", texture, "--model", "mdct-textures")
    assert (report["codec"], report["model"]) == ("mdct", "mdct-textures")
    assert "confirmed" in report["device"]["model_images"][0]


def test_a_model_of_ones_own_is_named_by_its_file(texture: Path, tmp_path: Path) -> None:
    shipped, own, coded_path = models.find("mdct-textures"), tmp_path / "own.vcmi", tmp_path / "own.vct"
    own.write_bytes(ModelImage(1, "own", "1", "", shipped.tables).pack())
    succeeds("encode", texture, coded_path, "--model", own)
    for command in (("decode", coded_path, tmp_path / "out.wav"), ("play", coded_path)):
        assert "give its folder or its file as --model" in fails(2, *command)
        succeeds(*command, "--model", own)
    assert "not coded for" in fails(2, "decode", coded_path, tmp_path / "out.wav", "--model", "mdct-textures")
    assert answer("info", coded_path)["model"] is None
    assert answer("info", coded_path, "--model", own)["model"] == "own"


def test_models_lists_what_ships() -> None:
    assert re.search(r"mdct-textures +mdct +\d+", succeeds("models"))
    cards = answer("models")
    assert list(cards) == [model.name for model in models.shipped()]
    assert cards["mdct-textures"]["training"]["seed"] == 1


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.slow)])
def test_simulate_cleans_up_when_it_is_killed(number: signal.Signals) -> None:
    process = started("simulate")
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    process.send_signal(number)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 128 + number
    assert errors.strip() == "error: interrupted"
    assert not Path(address.removeprefix("serial:")).parent.exists()


def test_simulate_serves_other_programs_until_interrupted(texture: Path, tmp_path: Path) -> None:
    process = started("simulate", "--actuator", "lra", "--flash-file", tmp_path / "flash.bin")
    try:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        assert address.startswith("serial:/")
        report = answer("play", texture, "--device", address)
        assert report["actuator"]["name"] == "lra"
        assert report["dac_equals_offline"] is True
        succeeds("flash", IMAGE, "--device", address)
    finally:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=20)
    assert process.returncode == 130
    assert errors.strip() == "error: interrupted"
    assert not Path(address.removeprefix("serial:")).exists()
    assert b"mdct-textures" in (tmp_path / "flash.bin").read_bytes()


@pytest.mark.parametrize(
    "number",
    [signal.SIGINT, *(pytest.param(number, marks=pytest.mark.slow) for number in (signal.SIGTERM, signal.SIGHUP))],
)
def test_interrupt_stops_the_actuator_and_leaves_the_port_usable(
    number: signal.Signals, tmp_path: Path, watched: Watched
) -> None:
    path, report_path = tmp_path / "long.wav", tmp_path / "report.json"
    textures.save(path, textures.GENERATORS["rough"](seconds=60.0))
    process = started("play", path, "--device", watched.address, "--snr-db", 5, "--report", report_path)
    assert watched.moved.wait(30)
    process.send_signal(number)
    output, errors = process.communicate(timeout=20)
    assert process.returncode == 128 + number
    assert (output, errors.splitlines()[-1]) == ("", "error: interrupted")
    assert json.loads(report_path.read_text())["error"] == "interrupted"
    with devices.connect(watched.address) as controller:
        assert controller.request_status().state == State.STOPPED


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("dance",), "No such command"),
        (("encode", "{texture}", "{out}", "--rate-bps", 1000, "--snr-db", 10), "exclude each other"),
        (("encode", "{texture}", "{out}", "--rate-bps", -5), "--rate-bps"),
        (("encode", "{texture}", "{out}", "--rate-bps", 1), "cannot be met"),
        (("encode", "{texture}", "{out}.wav"), ".vct"),
        (("encode", "{texture}", "{out}", "--setting", "step"), "NAME=VALUE"),
        (("encode", "{texture}", "{out}", "--setting", "pace=1"), "no parameter pace"),
        (("encode", "{texture}", "{out}", "--setting", "step=coarse"), "step is coarse"),
        (("encode", "{texture}", "{out}", "--setting", "step=1", "--snr-db", 10), "fixes the quality"),
        (("encode", "{texture}", "{out}", "--setting", "step=1", "--setting", "step=2"), "step is given twice"),
        (("encode", "{texture}", "{out}", "--codec", "dct", "--setting", "threshold=Off"), "neither off nor on"),
        (("encode", "{texture}", "{out}", "--codec", "slp", "--touch", 1), "slp cannot shape its error for touch"),
        (("play", "{coded}", "--snr-db", 10), "coded already; drop --snr-db"),
        (("play", "{coded}", "--unit", "g"), "coded already; drop --unit"),
        (("play", "{texture}", "--report", "{folder}/none/out.json"), "does not exist"),
        (("play", "{texture}", "--report", "{texture}"), ".json"),
        (("play", "{texture}", "--plot", "plot.bmp"), ".png"),
        (("play", "{texture}", "--device", "hand"), "`vibrocast devices` lists"),
        (("play", "{texture}", "--device", "serial:/dev/x", "--device", "serial:/dev/x"), "given twice"),
        (("play", "{texture}", "--device", "sim", "--device", "host", "--plot", "a.png"), "for one controller"),
        (("play", "{texture}", "--actuator", "none"), "no actuator of that name"),
        (("play", "{texture}", "--hand", "-3"), "a finite number above 0"),
        (("status", "--device", "serial:"), "serial:PORT"),
        (("status", "--device", "usb:nonsense"), "hexadecimal"),
        (("flash", "{texture}"), "model image"),
        *(
            ((*command, "--device", "sim", "--device", "sim-usb"), "given 2 times")
            for command in (
                ("status",),
                ("live", "rough"),
                ("measure",),
                ("conformance",),
                ("replay", "trace.pcapng"),
            )
        ),
    ],
)
def test_rejects_bad_usage(arguments: tuple[object, ...], told: str, texture: Path, coded: Path) -> None:
    names = {"texture": texture, "coded": coded, "out": texture.with_name("out.vct"), "folder": texture.parent}
    assert told in fails(2, *(str(argument).format(**names) for argument in arguments))
    assert not names["out"].exists()


def test_names_the_controllers_limits_before_encoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wide, coded = tmp_path / "wide.wav", tmp_path / "wide.vct"
    soundfile.write(wide, np.ones((100, 16)), RATE_HZ, subtype="FLOAT")
    succeeds("encode", wide, coded)
    monkeypatch.setattr("vibrocast.host.cli.steps.encode_recording", None)
    for path in (wide, coded):
        assert "16 channels, the controller has 8" in fails(2, "play", path, "--unit", "drive")


@pytest.mark.parametrize("name", ["out.vct", "out.wav"])
def test_says_where_there_is_no_room(
    name: str, texture: Path, coded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> NoReturn:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    monkeypatch.setattr("vibrocast.textures.save", full)
    command = ("encode", texture) if name == "out.vct" else ("decode", coded)
    assert fails(2, *command, tmp_path / name).endswith(
        f"{name}: No space left on device; free some space, or write elsewhere\n"
    )
    assert not (tmp_path / name).exists()


def test_rejects_to_overwrite_what_it_reads_or_to_write_twice(texture: Path, coded: Path, tmp_path: Path) -> None:
    before = texture.read_bytes()
    named_json, linked = tmp_path / "image.json", tmp_path / "linked.json"
    named_json.write_bytes(IMAGE.read_bytes())
    linked.hardlink_to(texture)
    assert "same file" in fails(2, "play", coded, "--model", named_json, "--report", named_json)
    assert "same file" in fails(2, "play", texture, "--report", linked)
    looped = tmp_path / "again.vct"
    looped.symlink_to(texture)
    assert "same file" in fails(2, "encode", texture, looped)
    out = tmp_path / "out.wav"
    out.symlink_to(tmp_path / ".." / tmp_path.name / coded.name)
    assert "same file" in fails(2, "decode", coded, out)
    report_path, plot_path = tmp_path / "out.json", tmp_path / "out.png"
    plot_path.symlink_to(report_path)
    assert "same file" in fails(2, "play", texture, "--report", report_path, "--plot", plot_path)
    assert not report_path.exists()
    assert texture.read_bytes() == before
    assert coded.exists()


@pytest.mark.parametrize("name", ["texture.wav", "pipe"])
def test_rejects_a_flash_file_that_is_none(name: str, texture: Path) -> None:
    path = texture.with_name(name)
    if name == "pipe":
        os.mkfifo(path)
    assert "flash memory" in fails(2, "simulate", "--flash-file", path)


def test_rejects_bad_input(texture: Path, coded: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.vct"
    garbage, truncated, flipped = tmp_path / "garbage.wav", tmp_path / "short.vct", tmp_path / "flipped.vct"
    garbage.write_bytes(bytes(range(256)) * 10)
    truncated.write_bytes(coded.read_bytes()[:-3])
    flipped.write_bytes(coded.read_bytes()[:-9] + b"\x55" + coded.read_bytes()[-8:])
    not_a_number, no_rate, ragged = tmp_path / "nan.wav", tmp_path / "plain.csv", tmp_path / "ragged.csv"
    soundfile.write(not_a_number, np.array([0.0, np.nan]), RATE_HZ, subtype="FLOAT")
    no_rate.write_text("1\n2\n3\n")
    ragged.write_text("1,2\n3\n")
    for path in (tmp_path / "missing.wav", tmp_path, garbage, truncated):
        fails(2, "play", path)
    for path in (flipped, tmp_path, tmp_path / "missing.vct"):
        fails(2, "info", path)
    for path in (flipped, texture):
        fails(2, "decode", path, tmp_path / "out.wav")
    fails(2, "encode", not_a_number, out)
    fails(2, "encode", ragged, out, "--rate-hz", 2800, "--unit", "um")
    assert "does not state its sample rate" in fails(2, "encode", no_rate, out)
    assert "does not state its unit" in fails(2, "encode", no_rate, out, "--rate-hz", 2800)
    for facts in (("--rate-hz", 44_100), ("--unit", "um"), ("--hand-speed-mm-s", 10), ("--stream-rate-hz", 10**9)):
        fails(2, "encode", texture, out, *facts)
    fails(2, "generate", "rough", tmp_path / "out.wav", "--seconds", 1e12)
    assert "no file" in fails(2, "info", "/dev/zero")
    assert "no file" in fails(2, "decode", "/dev/zero", tmp_path / "out.wav")
    assert "no file" in fails(2, "flash", "/dev/zero")
    assert "no file" in fails(2, "encode", texture, out, "--model", "/dev/zero")
    assert "model image" in fails(2, "encode", texture, out, "--model", coded)
    fails(2, "flash", tmp_path / "missing.vcmi")
    assert not out.exists()


def test_fails_on_the_device(texture: Path, tmp_path: Path) -> None:
    assert "vibrocast devices" in fails(3, "play", texture, "--device", f"serial:{tmp_path}/none")
    assert "plug it in" in fails(3, "status", "--device", "usb:dead:beef")


def test_unexpected_errors_are_one_line_and_debug_shows_them(texture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def breaks(*_: object, **__: object) -> None:
        raise ZeroDivisionError("two\nlines")

    monkeypatch.setattr("vibrocast.host.track_player.begin_encoding", breaks)
    result = run("play", texture)
    assert result.exit_code == 1
    assert "unexpected ZeroDivisionError: two lines" in result.stderr
    assert "--debug" in result.stderr
    assert isinstance(run("--debug", "play", texture).exception, ZeroDivisionError)


def test_play_asks_for_the_unit_of_a_file_that_states_none(tmp_path: Path) -> None:
    plain, coded_path = tmp_path / "plain.wav", tmp_path / "plain.vct"
    soundfile.write(plain, 0.1 * np.random.default_rng(0).normal(size=560), RATE_HZ)
    succeeds("encode", plain, coded_path)
    for path in (plain, coded_path):
        assert "pass --unit drive" in fails(2, "play", path)
        assert "re detection threshold" in succeeds("play", path, "--unit", "drive")
    assert "give --full-scale too" in fails(2, "encode", plain, coded_path, "--unit", "g")
    assert "SNR 1" in succeeds("encode", plain, coded_path, "--unit", "g", "--full-scale", 8)


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        ("", "name is missing"),
        ("[[actuators]]\n[[actuators]]", "not one actuator"),
        ('model = "lra"\ncorner_hz = nan', "a number from 2 to 5000, not nan"),
        ('model = "lra"\ncorner = 80', "there is no key corner"),
        ("\0", "not a TOML file"),
    ],
)
def test_a_file_that_describes_no_actuator_is_an_error_of_one_line(
    content: str, cause: str, texture: Path, tmp_path: Path
) -> None:
    path = tmp_path / "actuator.toml"
    path.write_text(content)
    told = fails(2, "play", texture, "--actuator", path)
    assert str(path) in told and cause in told


def test_one_channel_of_eight_that_is_felt_is_enough(tmp_path: Path) -> None:
    path, noise = tmp_path / "eight.wav", np.random.default_rng(0).normal(size=(560, 8))
    for loud, felt in ((1.0, True), (1e-3, False)):
        levels = np.array([1e-3, 0, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, loud])
        textures.save(path, textures.Recording(noise * levels, RATE_HZ, "m/s^2", "eight"))
        told = run("play", path)
        assert told.exit_code == 0 and ("nobody would feel this" in told.stderr) is not felt


def test_level_and_actuator_are_your_own(texture: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('name = "mine"\nmodel = "voice-coil"\ncorner_hz = 80\n')
    loud = succeeds("play", texture, "--actuator", tmp_path / "mine.toml")
    assert re.search(r"touch +peak \+\d+ dB re detection threshold", loud) and "mine follows within 1 dB" in loud
    quiet = run("play", texture, "--gain-db", -80)
    assert "nothing exceeds the detection threshold" in quiet.stdout and "raise --gain-db" in quiet.stderr
    measured = replace(ACTUATORS["lra"], name="measured", corner_hz=161.0)
    (tmp_path / "measured.toml").write_text(actuator_toml(measured, "one") + "channel = 1\n")
    assert "measured follows within 1 dB" in succeeds("play", texture, "--actuator", tmp_path / "measured.toml")


def test_an_actuator_is_shown_and_written_as_c(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('name = "mine"\nmodel = "voice-coil"\ncorner_hz = 80\n')
    assert re.search(r"^corner hz +80$", succeeds("actuator", tmp_path / "mine.toml"), re.MULTILINE)
    assert '.name = "mine",' in succeeds("actuator", tmp_path / "mine.toml", "--c")
    assert "no actuator of that name" in fails(2, "actuator", "yours", "--c")


@pytest.mark.parametrize("name", ["encode", "play", "live", "bench"])
def test_help_lists_options_by_section(name: str) -> None:
    known = (sections.INPUT, sections.CODING, sections.CONTROLLER, sections.PLAYBACK, sections.RUN, sections.OUTPUT)
    found = titles(succeeds(name, "--help"))
    assert len(found) > 2 and set(found) <= {
        f"{title}:" for title in (*known, "Codecs", "Recordings", "Options", "More options", "Examples")
    }


def commands(command: click.Command = main, path: str = "vibrocast") -> Iterator[tuple[str, click.Command]]:
    """Yield every command with the words that call it, those with subcommands first."""
    yield path, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None
            yield from commands(found, f"{path} {name}")


def test_a_scene_needs_few_options() -> None:
    """All commands have at most 165 options without --json; those that everyone uses have at most 19 each."""
    counts = {
        path: sum(isinstance(each, click.Option) and "--json" not in each.opts for each in command.params)
        for path, command in commands()
    }
    del counts["vibrocast flash"]  # another name of `upload`
    assert sum(counts.values()) <= 165
    assert max(counts[f"vibrocast {name}"] for name in ("play", "live", "encode")) <= 19


def test_the_help_of_each_command_has_two_examples_that_it_parses() -> None:
    for path, command in commands():
        if isinstance(command, click.Group) or path == "vibrocast flash":
            continue
        examples = (command.epilog or "").splitlines()
        assert len(examples) == 2, path
        for example in examples:
            words = shlex.split(example.partition(" > ")[0])
            assert example.startswith(f"{path} ") or example == path, example
            command.make_parser(click.Context(command)).parse_args(words[len(path.split()) :])


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["--rate-hz", "-5"], "-5 cannot be used; give a finite number above 0."),
        (["--snr-db", "nan"], "nan cannot be used; give a finite number."),
        (["--snr-db", "much"], "much cannot be used; give a finite number."),
        (["--gain-db", "500"], "500 cannot be used; give a finite number from -400 to 400."),
        (["--loop", "1.5"], "1.5 cannot be used; give a whole number from 0 to 65535."),
    ],
)
def test_an_unusable_number_is_reported_in_one_line(arguments: list[str], error: str, texture: Path) -> None:
    assert fails(2, "play", texture, *arguments) == (
        f"error: Invalid value for '{arguments[0]}': {error} See `main play --help`.\n"
    )


@pytest.mark.usefixtures("simulated_time")
def test_play_tells_what_is_coded_what_is_felt_and_what_the_actuator_follows(tmp_path: Path) -> None:
    report_path = tmp_path / "out.json"
    coded, removed, felt, actuator, weighted = succeeds("play", OAK, "--report", report_path).splitlines()[:5]
    assert re.fullmatch(r"coded +SNR 14\.\d+ dB", coded)
    assert re.fullmatch(r"removed +0\.\d+ % of the energy below 20 Hz", removed)
    assert re.fullmatch(r"felt error +at most \+\d+ dB re threshold, at \d+ Hz; the texture there \+\d+ dB", felt)
    follows = r"piezo-stack follows within 1 dB from 20 to \d+ Hz"
    assert re.fullmatch(rf"actuator +{follows}", actuator)
    assert re.fullmatch(r" +weighted SNR [\d.]+ dB with the codec, [\d.]+ dB without.*", weighted)
    report = json.loads(report_path.read_text())
    skin = report["quality"]["skin"]
    assert skin["snr_db"] == pytest.approx(skin["decoded_snr_db"], abs=0.5)
    assert skin["weighted_snr_db"] == pytest.approx(skin["weighted_decoded_snr_db"], abs=0.3)
    assert skin["playing_snr_db"] > 30 < skin["weighted_playing_snr_db"]
    assert report["quality"]["skin_note"] is None
    assert (report["schema"], report["wire"]["bad_frames"], report["run"]["bench_sha256"]) == (SCHEMA, 0, None)


def test_a_recording_is_coded_for_touch(tmp_path: Path) -> None:
    out, sizes = tmp_path / "oak.vct", {}
    for touch in (0, 0.25, 1):
        assert re.search(r"SNR 1[56]\.\d+ dB", succeeds("encode", OAK, out, "--touch", touch, "--snr-db", 16))
        sizes[touch] = out.stat().st_size
    succeeds("encode", OAK, out, "--snr-db", 16)
    assert sizes[0] < sizes[0.25] == out.stat().st_size < sizes[1]
    assert "felt error" in succeeds("encode", OAK, out, "--touch", 1, "--live", "--rate-bps", 3000)


@pytest.mark.parametrize("options", [("--hand-speed-mm-s", 50), ()], ids=["over time", "over position"])
def test_an_offset_of_heights_changes_no_byte(options: tuple[object, ...], tmp_path: Path) -> None:
    profile, written = textures.surface_profile("rough", seconds=0.3), []
    for name, offset_um in (("flat", 0.0), ("high", 1000.0)):
        path = tmp_path / f"{name}.csv"
        textures.save_profile(path, replace(profile, heights_um=profile.heights_um.round(3) + offset_um))
        assert "removed" not in succeeds("encode", path, tmp_path / "out.vct", *options)
        written.append((tmp_path / "out.vct").read_bytes())
    assert written[0] == written[1]
