"""Stimuli on a sound card: the codes that come back, switching without a gap, and a whole run of a study."""

import csv
import json
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from tests.output.test_sound_card import TRIES, wait_until
from tests.sound_server import PAD, Listener, SoundServer, position_of
from tests.study.small_study import stimuli_of, text_of
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host import devices
from vibrocast.host.cli.command_line import main
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.output.rendering import render
from vibrocast.study.device_player import CardPlayer
from vibrocast.study.stimuli import stream_sha256
from vibrocast.study.trials import Stimulus

ADDRESS = f"audio:{PAD}:3,4"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Stimulus, ...]:
    return stimuli_of("abx", tmp_path_factory.mktemp("study"))


def test_a_stimulus_comes_back_as_it_was_rendered(sound_server: SoundServer, made: tuple[Stimulus, ...]) -> None:
    card, channels, actuator = devices.sound_card_of(ADDRESS, PIEZO_STACK)
    stimulus = made[0]
    stream = stimulus.stream
    codes, _ = render(
        stream.header, stream.decode_integers(), stream.decoder().delay_samples, actuator, loops=stimulus.loops
    )
    for _ in range(TRIES):  # a busy machine may let the card starve
        player = CardPlayer(card, channels, actuator)
        player.prepare(made)
        with Listener(PAD) as listener:
            player.start(stimulus)
            assert player.playing() == stimulus.key
            wait_until(lambda player=player: player.playing() is None)  # type: ignore[misc]
            (played,) = player.take_played()
            player.close()  # the end is played all the same
        heard = listener.heard()
        if position_of(np.repeat(codes, 2, axis=1), heard[:, 2:]) is not None:
            break
    else:
        raise AssertionError("never came back whole")
    assert not heard[:, :2].any(), "the other channels are silent"
    assert played.stream_sha256 == stream_sha256(stream)
    assert played.seconds == len(codes) / actuator.dac_rate_hz


def test_another_stimulus_goes_on_at_the_same_place(sound_server: SoundServer, made: tuple[Stimulus, ...]) -> None:
    card, channels, actuator = devices.sound_card_of(ADDRESS, PIEZO_STACK)
    player = CardPlayer(card, channels, actuator)
    player.prepare(made)
    player.start(made[0])
    time.sleep(0.05)
    player.switch(made[1])
    assert player.playing() == made[1].key
    wait_until(lambda: player.playing() is None)
    first, second = player.take_played()
    assert (first.stimulus, second.stimulus) == (made[0].key, made[1].key)
    whole_s = made[0].seconds
    assert first.seconds + second.seconds == pytest.approx(whole_s, abs=0.05), "nothing is played twice or left out"
    player.close()


def test_a_lost_card_is_an_error(mortal_sound_server: SoundServer, made: tuple[Stimulus, ...]) -> None:
    card, channels, actuator = devices.sound_card_of(ADDRESS, PIEZO_STACK)
    player = CardPlayer(card, channels, actuator)
    player.start(made[0])
    mortal_sound_server.stop()
    with pytest.raises(TransportError):
        for _ in range(2000):
            player.playing()
            player.start(made[0])
            time.sleep(0.01)
    player.stop()
    player.close()


def test_a_participant_takes_part_on_a_sound_card(pulseaudio: SoundServer, tmp_path: Path) -> None:
    path, out = tmp_path / "abx.toml", tmp_path / "out"
    path.write_text(text_of("abx"))
    arguments = ["study", "run", path, "--participant", "1", "--terminal", "--device", ADDRESS, "--out", out]
    given = "\n\n" + "p A\np B\np X\n1\n" * 4
    result = CliRunner().invoke(main, list(map(str, arguments)), input=given)
    assert result.exit_code == 0, result.stderr
    with (out / "participant_001" / "results.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 4
    events = [json.loads(line) for line in (out / "participant_001" / "log.jsonl").read_text().splitlines()]
    assert sum(event["event"] == "played" for event in events) == 12
