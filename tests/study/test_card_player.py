"""Stimuli on a sound card: a card that is lost, and a whole run of a study."""

import csv
import json
import time
from pathlib import Path

import pytest

from tests.command import succeeds
from tests.sound_server import PAD, SoundServer
from tests.study.small_study import text_of
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host import devices
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.study.device_player import CardPlayer
from vibrocast.study.trials import Stimulus

ADDRESS = f"audio:{PAD}:3,4"


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
    succeeds(*arguments, data=given.encode())
    with (out / "participant_001" / "results.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 4
    events = [json.loads(line) for line in (out / "participant_001" / "log.jsonl").read_text().splitlines()]
    assert sum(event["event"] == "played" for event in events) == 12
