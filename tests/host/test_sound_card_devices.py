"""Sound cards as devices: addresses, what reaches the card, and how it comes to rest."""

import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile

import vibrocast
from tests.command import fails, run, started, succeeds
from tests.output.test_sound_card import TRIES, wait_until
from tests.sound_server import HEADPHONES, PAD, Listener, SoundServer, position_of
from vibrocast import extras
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host import bench_file, devices
from vibrocast.output.actuator import LRA, VOICE_COIL, Actuator, Codes, Samples
from vibrocast.output.rendering import render

VOLTS = 2.5
ADDRESS = f"audio:{PAD}:3,4@{VOLTS}"


def short_stream(seconds: float = 0.12) -> vibrocast.Stream:
    noise = np.random.default_rng(0).standard_normal((round(2800 * seconds), 2))
    return vibrocast.encode(10 * noise, 2800, "m/s^2", random_access=True)


def rendered(stream: vibrocast.Stream, actuator: Actuator, rate_hz: int, volts: float) -> Codes:
    driven = devices.on_sound_card(actuator, rate_hz, volts)
    codes, _ = render(stream.header, stream.decode_integers(), stream.delay_samples, driven)
    return codes


@pytest.mark.parametrize(
    ("address", "error"),
    [
        (f"audio:{PAD}", "which actuator is behind the sound card; name one by `actuator`"),
        ("audio:", "names no sound card"),
        (f"audio:{PAD}@much", "@much is no voltage; give the volts"),
        (f"audio:{PAD}@0", "@0 is no voltage"),
        (f"audio:{PAD}@nan", "@nan is no voltage"),
        ("audio:Piano", "no sound card for playback matches 'Piano'; there are"),
        (f"audio:{PAD}:5", "has 4 channels, and channel 5 was asked for"),
        (f"audio:{PAD}:0", "counted from 1"),
        (f"audio:{PAD}:1,1", "give different ones"),
        (f"audio:{PAD}:1,2,3,4,5,6,7,8,9", "at most 8"),
    ],
)
def test_wrong_addresses_are_rejected(pulseaudio: SoundServer, address: str, error: str) -> None:
    actuator = None if "actuator" in error else VOICE_COIL
    with pytest.raises(TransportError) as caught, devices.connect(address, actuator=actuator):
        pass
    assert error in str(caught.value)


def test_without_the_extra_the_error_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda module: None)
    with (
        pytest.raises(extras.MissingExtraError, match=r"install the extra \[audio\]"),
        devices.connect("audio:default", actuator=VOICE_COIL),
    ):
        pass
    assert "[audio]" in devices.available()["audio:CARD"]


def test_cards_are_listed(pulseaudio: SoundServer) -> None:
    assert devices.available()[f"audio:{HEADPHONES}"].startswith("sound card, PulseAudio, 2 channels, 44100 Hz")
    assert f"audio:{PAD} " in succeeds("devices")


def test_an_actuator_that_no_card_can_drive_is_rejected(pulseaudio: SoundServer) -> None:
    with (
        pytest.raises(TransportError, match="no controller can drive this actuator at 48000 Hz"),
        devices.connect(ADDRESS, actuator=replace(LRA, quality=300.0)),
    ):
        pass


def test_the_card_plays_what_is_rendered(sound_server: SoundServer) -> None:
    stream = short_stream()
    expected = rendered(stream, VOICE_COIL, 48_000, VOLTS)
    for _ in range(TRIES):
        with vibrocast.connect(ADDRESS, actuator="voice-coil") as connection, Listener(PAD) as listener:
            report = connection.play(stream)
        heard = listener.heard()
        at = position_of(expected, heard[:, 2:])
        if at is not None:
            break
    assert at is not None
    assert not heard[:, :2].any()
    heard[at : at + len(expected)] = 0
    assert not heard.any()
    assert report.dac_equals_offline and report.decoded_equals_offline
    card = report.sound_card
    assert card is not None
    assert (card.name, card.channels, card.rate_hz, card.full_scale_volts) == (PAD, (3, 4), 48_000, VOLTS)
    assert (report.timing.end_to_end_ms or 0.0) > card.latency_ms > 0


def test_without_volts_the_actuators_own_are_full_scale(pulseaudio: SoundServer) -> None:
    with vibrocast.connect(f"audio:{HEADPHONES}", actuator="lra") as connection:
        status = connection.status()
    assert status["sound_card"]["full_scale_volts"] == LRA.volts / 2
    assert status["sound_card"]["channels"] == (1, 2)
    assert status["actuator"]["dac_rate_hz"] == 44_100


def test_a_bench_plays_on_a_card_with_its_actuator(pulseaudio: SoundServer, tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(
        f'[[controllers]]\nname = "pad"\naddress = "{ADDRESS}"\n[[actuators]]\nmodel = "voice-coil"\n', "utf-8"
    )
    bench = bench_file.read_bench(path)
    with bench_file.connect(bench, bench.first) as session:
        assert session.driven == session.skin == devices.on_sound_card(VOICE_COIL, 48_000, VOLTS)


@pytest.mark.parametrize("arguments", [["live", "wood", "--seconds", "0.5", "--playout-delay-ms", "300"], ["status"]])
def test_commands_run_on_a_card(pulseaudio: SoundServer, arguments: list[str]) -> None:
    assert PAD in succeeds(*arguments, "--device", ADDRESS, "--actuator", "voice-coil")


def test_a_profile_is_played_on_a_card_under_a_hand(pulseaudio: SoundServer, tmp_path: Path) -> None:
    profile = tmp_path / "profile.csv"
    succeeds("generate", "wood", profile)
    arguments = ["--hand", "10", "--hand-speed-mm-s", "40", "--device", ADDRESS, "--actuator", "voice-coil"]
    for _ in range(TRIES):  # a busy machine may render a position late
        result = run("play", profile, *arguments)
        if result.exit_code == 0:
            break
    assert result.exit_code == 0, result.output
    assert "sound card" in result.output


def test_an_actuator_is_for_those_that_take_one() -> None:
    told = fails(2, "status", "--device", "host", "--actuator", "lra")
    assert "host has its actuator compiled in; drop --actuator" in told


def playing(tmp_path: Path) -> subprocess.Popen[str]:
    """Return the command that plays for long, after it has begun to."""
    file = tmp_path / "long.vct"
    short_stream(20.0).save(file)
    return started("play", file, "--device", ADDRESS, "--actuator", "voice-coil")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_program_leaves_the_card_at_rest(
    pulseaudio: SoundServer, tmp_path: Path, number: signal.Signals
) -> None:
    step_limit = devices.on_sound_card(VOICE_COIL, 48_000, VOLTS).code_step_limit
    for tries_left in reversed(range(TRIES)):
        try:
            heard = heard_until_interrupted(tmp_path, number)
        except TransportError:  # the listener has lost the server, or does not find it on a busy machine
            if not tries_left:
                raise
            continue
        end = int(np.flatnonzero(heard.any(axis=1))[-1]) + 2
        steps = np.abs(np.diff(heard[end - 2000 : end], axis=0))
        if steps.max() <= step_limit:
            return
    pytest.fail("it came to rest on no ramp")


def heard_until_interrupted(tmp_path: Path, number: signal.Signals) -> Samples:
    """Return what a program played until a signal ended it, and silence came. Raises as the listener."""
    with playing(tmp_path) as program, Listener(PAD) as listener:
        try:
            wait_until(lambda: bool(np.abs(listener.newest(0.2)).max(initial=0) > 0))
            program.send_signal(number)
            assert program.wait(20) == 128 + number
            wait_until(lambda: not listener.newest(0.2).any())
        finally:
            program.kill()
    return listener.heard()


def test_a_killed_program_leaves_silence(pulseaudio: SoundServer, tmp_path: Path) -> None:
    with playing(tmp_path) as program, Listener(PAD) as listener:
        wait_until(lambda: bool(np.abs(listener.newest(0.2)).max(initial=0) > 0))
        program.kill()
        program.wait(20)
        wait_until(lambda: not listener.newest(0.2).any())


def test_a_lost_card_ends_the_program_with_its_reason(mortal_sound_server: SoundServer, tmp_path: Path) -> None:
    with playing(tmp_path) as program:
        with Listener(PAD) as listener:
            wait_until(lambda: bool(np.abs(listener.newest(0.2)).max(initial=0) > 0))
        mortal_sound_server.remove(PAD)
        _, errors = program.communicate(timeout=30)
    assert program.returncode == 3
    assert f"error: the sound card '{PAD}' is gone; it was unplugged" in errors


def test_render_writes_what_a_card_plays(tmp_path: Path) -> None:
    stream, out = short_stream(), tmp_path / "drive.wav"
    stream.save(tmp_path / "short.vct")
    options = ("--actuator", "voice-coil", "--dac-rate-hz", 44_100, "--full-scale-volts", 2.5, "--gain-db", -6)
    assert "1.0 is 2.5 V at voice-coil" in succeeds("render", tmp_path / "short.vct", out, *options)
    written, rate_hz = soundfile.read(out, dtype="int16", always_2d=True)
    assert rate_hz == 44_100
    assert np.array_equal(written, rendered(stream.with_gain(-6), VOICE_COIL, 44_100, 2.5))
    assert soundfile.SoundFile(out).comment.endswith("; drive of voice-coil, 1.0 is 2.5 V")
    assert vibrocast.load(out).unit == "full scale"
