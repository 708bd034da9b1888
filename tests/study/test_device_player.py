"""Stimuli on a controller: what is played and logged, a stop before the end, and a pulled cable."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.study.small_study import text_of
from vibrocast.device_protocol.transports import SerialTransport, TransportError
from vibrocast.host import devices
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.simulated_device.controller import Controller as SimulatedController
from vibrocast.simulated_device.pty_port import PtyPort
from vibrocast.simulated_device.serial_port import has_pseudo_terminals
from vibrocast.study import stimuli
from vibrocast.study.device_player import ControllerPlayer, HandPlayer
from vibrocast.study.stimuli import stream_sha256
from vibrocast.study.study_file import Hand, read_study
from vibrocast.study.trials import Stimulus


@pytest.fixture
def player() -> Iterator[ControllerPlayer]:
    with devices.open_session("sim", actuator=PIEZO_STACK) as opened:
        player = ControllerPlayer(opened)
        yield player
        player.close()


def wait_for_rest(player: ControllerPlayer) -> None:
    until_s = time.monotonic() + 20
    while player.playing() is not None and time.monotonic() < until_s:
        time.sleep(0.01)
    assert player.playing() is None
    player.stop()  # and wait for the comparison


def test_each_presentation_is_noted_with_its_stream_and_another_one_or_a_stop_ends_it(
    player: ControllerPlayer, made: tuple[Stimulus, ...]
) -> None:
    for stimulus in made[:2]:
        player.start(stimulus)
        assert player.playing() == stimulus.key
        wait_for_rest(player)
    played = player.take_played()
    assert [each.stimulus for each in played] == [each.key for each in made[:2]]
    assert [each.stream_sha256 for each in played] == [stream_sha256(each.stream) for each in made[:2]]
    assert all(each.underruns == 0 and each.limited == 0 and each.as_computed for each in played)
    assert player.take_played() == []
    player.start(made[0])
    player.switch(made[1])
    assert player.playing() == made[1].key
    player.stop()
    assert player.playing() is None
    assert all(each.as_computed is None for each in player.take_played())


def test_a_stimulus_plays_by_the_position_of_the_hand(made: tuple[Stimulus, ...]) -> None:
    hand = Hand(speed_mm_s=50, stroke_mm=10, plays=True)
    with devices.open_session("sim", actuator=PIEZO_STACK) as opened:
        player = HandPlayer(opened, hand, 0.5)
        player.prepare(made[:1])
        # One stroke a beat of 0.2 s, for 0.5 s.
        times_s, positions_mm = player._movement.times_s, player._movement.positions_mm
        assert np.interp([0, 0.1, 0.2, 0.4], times_s, positions_mm) == pytest.approx([0, 5, 10, 0], abs=0.01)
        assert times_s[-1] == pytest.approx(0.5, abs=0.005)
        # The heights over position are those over time at the hand's speed.
        sent, recording = player._carried[stream_sha256(made[0].stream)].profile(), made[0].stream.recording()
        over_time = recording.samples[:, 0]
        places_mm = np.arange(len(sent.heights_um)) * sent.spacing_um / 1000
        wanted_um = np.interp(places_mm, 50 * np.arange(len(over_time)) / recording.rate_hz, over_time)
        inner = (places_mm > 1) & (places_mm < 14)
        assert np.std((sent.heights_um - wanted_um)[inner]) < 0.1 * np.std(wanted_um)
        player.start(made[0])
        wait_for_rest(player)
        player.start(made[0])
        time.sleep(0.4)
        player.stop()
        whole, stopped = player.take_played()
    assert whole.stimulus == stopped.stimulus == made[0].key
    assert whole.stream_sha256 == stream_sha256(made[0].stream)
    assert whole.seconds > 0.5
    assert whole.as_computed or whole.underruns  # a busy machine lets it run empty
    assert stopped.as_computed is None


def test_a_stream_that_no_controller_decodes_goes_in_another_coding(player: ControllerPlayer, folder: Path) -> None:
    path = folder / "whole.toml"
    whole = 'codec = "dct"\nsetting = { block = "whole", limit_hz = 400 }'
    path.write_text(
        text_of("abx").replace('codec = "mdct"\nsnr_db = 20', whole).replace("seconds = 0.3", "seconds = 0.2")
    )
    study = read_study(path)
    made = [each for each in stimuli.prepare(study, PIEZO_STACK) if each.condition == "fine"]
    player.prepare(made)
    player.start(made[0])
    wait_for_rest(player)
    (played,) = player.take_played()
    assert played.stream_sha256 == stream_sha256(made[0].stream)


@pytest.mark.skipif(not has_pseudo_terminals(), reason="this system has no pseudo-terminals")
def test_a_pulled_cable_is_an_error_and_never_a_hang(made: tuple[Stimulus, ...]) -> None:
    with PtyPort(SimulatedController()) as port, SerialTransport(port.name) as transport:
        player = ControllerPlayer(devices.session_with(Controller(transport), f"serial:{port.name}"))
        player.start(made[0])
        port.unplug()
        with pytest.raises((TransportError, ControllerError)):
            for _ in range(2000):
                player.playing()
                time.sleep(0.01)
        player.stop()
        player.close()
