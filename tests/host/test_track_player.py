"""Lists of tracks: what is found, the order, commands, tracks that cannot be played, several controllers in step."""

import contextlib
import socket
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import sleep

import numpy as np
import pytest

from tests.conftest import linked, noise, texture
from vibrocast import textures
from vibrocast.codec import Signal
from vibrocast.codec.encoding import begin_encoding, encode_recording
from vibrocast.device_protocol.messages import State
from vibrocast.errors import InputError
from vibrocast.host.cli.controls import KEYS, Control, _commands
from vibrocast.host.devices import session_with
from vibrocast.host.event_loop import run_all
from vibrocast.host.track_player import (
    WORDS,
    Command,
    Event,
    Group,
    Remote,
    Source,
    TrackOptions,
    TrackPlayer,
    command_of,
    play_list,
    tracks_of,
)
from vibrocast.output.actuator import Codes
from vibrocast.simulated_device.memory_link import SimulatedTime
from vibrocast.textures.recording import Recording

Do = Callable[[Event, Remote], None]


def played(
    sources: list[Source], do: Do = lambda event, remote: None, options: TrackOptions | None = None
) -> tuple[list[Event], TrackPlayer, Codes]:
    """Play in simulated time, with commands by `do`; return events, the player and the codes of the first channel."""
    codes: list[Codes] = [np.zeros((1, 1), np.int16)]
    controller = linked(on_dac=codes.append)[1]
    remote, events = Remote(), list[Event]()

    def tell(event: Event) -> None:
        events.append(event)
        do(event, remote)

    player = TrackPlayer(
        session_with(controller, "memory"), sources, options or TrackOptions(), remote=remote, tell=tell
    )
    controller.run(player.steps())
    return events, player, np.concatenate([part[:, :1] for part in codes])


def once(kind: str, at_s: float, command: str, track: str = "") -> Do:
    """Return what gives a command, once, when a track of that name is at a time."""
    given: list[str] = []

    def do(event: Event, remote: Remote) -> None:
        if not given and event.kind == kind and event.position_s >= at_s and track in event.track:
            given.append(command)
            remote.send(command_of(command))

    return do


def begun(events: list[Event]) -> list[str]:
    return [event.track for event in events if event.kind == "track"]


def named(name: str, samples: Signal) -> Recording:
    return replace(texture(samples), name=name)


def recordings(tmp_path: Path) -> list[Path]:
    """Return a WAV file at 2800 Hz, one at 8000 Hz in two channels, and a stream."""
    paths = [tmp_path / name for name in ("a.wav", "b.wav", "c.vct")]
    textures.save(paths[0], texture(noise(0.5, rms=2.0)))
    textures.save(paths[1], Recording(np.tile(np.sin(np.arange(4000) / 9.0)[:, None], 2), 8000.0, "um", "b"))
    encode_recording(texture(noise(0.5, rms=3.0))).stream.save(paths[2])
    return paths


def test_tracks_are_found_in_files_folders_and_lists(tmp_path: Path) -> None:
    paths = recordings(tmp_path)
    list_path = tmp_path / "list.m3u"
    list_path.write_text("\ufeff#EXTM3U\nc.vct\n\n#EXTINF:1,A\na.wav\nnot there.wav\n", encoding="utf-8")
    assert tracks_of([tmp_path]) == paths
    assert tracks_of([list_path, paths[1]]) == [paths[2], paths[0], tmp_path / "not there.wav", paths[1]]
    (tmp_path / "empty").mkdir()
    list_path.write_text("# nothing\n")
    for wrong in (tmp_path / "empty", list_path):
        with pytest.raises(InputError):
            tracks_of([wrong])


def test_a_list_plays_in_order_and_goes_on_behind_a_track_that_cannot_be_played(tmp_path: Path) -> None:
    first, second, third = recordings(tmp_path)
    events, player, _ = played([first, tmp_path / "none.wav", second, third])
    assert begun(events) == ["a.wav", "b.wav", "c.vct"]
    assert [track.name for track, _ in player.played] == ["a.wav", "b.wav", "c.vct"]
    assert all(result.underruns == result.lost_packets == 0 for _, result in player.played)
    assert list(player.failures) == ["none.wav"] and "no such file" in str(player.failures["none.wav"])
    assert [event.kind for event in events if event.kind in ("failed", "ended")] == ["failed", "ended"]
    assert events[-1].kind == "ended"


def test_a_track_that_the_controller_rejects_is_named() -> None:
    learned = encode_recording(texture(noise(0.3)), codec_name="eva", snr_db=8.0).stream
    sources: list[Source] = [named("a", noise(0.3)), learned, named("b", noise(0.3))]
    events, player, _ = played(sources)
    assert begun(events) == ["a", "b"]
    assert "upload it first" in str(player.failures["stream"])


def test_tracks_of_one_format_follow_without_a_gap() -> None:
    sources: list[Source] = [named(name, noise(1.0, rms=rms)) for name, rms in (("a", 2.0), ("b", 3.0))]

    def let_it_open(event: Event, remote: Remote) -> None:
        sleep(0.01)  # simulated time runs faster than the thread that opens the next track

    events, player, codes = played(sources, let_it_open)
    assert begun(events) == ["a", "b"] and [result.underruns for _, result in player.played] == [0, 0]
    moving = np.flatnonzero(codes)
    assert np.max(np.diff(moving)) < 5, "zeros in the noise, and no more"


def test_a_list_repeats_and_ends_where_no_track_can_be_played(tmp_path: Path) -> None:
    first, second, _ = recordings(tmp_path)
    events, _, _ = played([first, second], options=TrackOptions(loops=2))
    assert begun(events) == ["a.wav", "b.wav"] * 2
    events, _, _ = played([tmp_path / "x.wav", tmp_path / "y.wav"], options=TrackOptions(loops=0))
    assert not begun(events)


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("next", ["a", "b"]),
        ("previous", ["a", "a", "b"]),
        ("seek 9", ["a", "b"]),
        ("seek -0.2", ["a", "a", "b"]),
        ("stop", ["a"]),
    ],
)
def test_commands_change_the_place(command: str, expected: list[str]) -> None:
    sources: list[Source] = [named("a", noise(1.0, rms=2.0)), named("b", noise(0.3, rms=2.0))]
    events, player, codes = played(sources, once("position", 0.4, command))
    assert begun(events) == expected
    assert all(result.state == State.FINISHED for _, result in player.played)
    assert codes[-1] == 0, "the output is at rest"


def test_a_seek_goes_to_the_packet_that_can_be_decoded_before_it_also_of_a_file_with_one() -> None:
    whole = texture(noise(2.0, rms=2.0))
    for source in (whole, encode_recording(whole).stream):
        events, _, _ = played([source], once("position", 0.3, "seek 1"))
        later = [event for event in events if event.kind == "track"][1]
        assert 1.0 < later.position_s < 1.45


def test_pause_rests_and_a_gain_is_heard() -> None:
    source = texture(np.sin(np.arange(2800) / 3.0))
    _, _, loud = played([source])
    events, _, codes = played([source], once("position", 0.4, "gain -20"))
    assert [event.gain_db for event in events if event.kind == "gain"] == [-20.0]
    rms = [float(np.sqrt(np.mean(np.square(each[len(each) // 2 : -300].astype(float))))) for each in (loud, codes)]
    assert rms[1] == pytest.approx(rms[0] / 10, rel=0.05)

    def pause(event: Event, remote: Remote) -> None:
        if event.kind == "position" and 0.4 < event.position_s < 0.6 and not event.gain_db:
            remote.send(Command("pause"))
            remote.send(Command("gain", 1.0))
        elif event.kind == "paused":
            remote.send(Command("resume"))

    kinds = [event.kind for event in played([source], pause)[0] if event.kind in ("paused", "resumed", "ended")]
    assert kinds == ["paused", "resumed", "ended"]


def test_a_part_of_each_track_plays(tmp_path: Path) -> None:
    options = TrackOptions(from_s=0.1, to_s=0.3)
    events, player, _ = played([*recordings(tmp_path)], options=options)
    assert [round(track.seconds, 3) for track, _ in player.played] == [0.2, 0.2, 0.2] and len(begun(events)) == 3
    with pytest.raises(InputError, match="nothing is between"):
        raise played([texture(noise(0.1))], options=options)[1].failures["texture"]


def test_controllers_begin_a_track_at_one_time_and_wait_for_none_that_fails() -> None:
    time = SimulatedTime(step_us=100)
    began_us: dict[str, int] = {}

    def on_dac(name: str, codes: Codes) -> None:
        if np.any(codes):
            began_us.setdefault(name, time.now_us)

    links = {name: linked(time=time, on_dac=partial(on_dac, name))[1] for name in ("left", "right")}
    sessions = {name: session_with(controller, name) for name, controller in links.items()}
    results = play_list(sessions, [texture(noise(0.3, rms=2.0))], TrackOptions())
    assert all(not isinstance(each, Exception) and each.playback is not None for each in results.values())
    assert abs(began_us["left"] - began_us["right"]) <= 1000
    group = Group(2)
    player = TrackPlayer(sessions["left"], [texture(noise(0.3, rms=2.0))], TrackOptions(), group=group)
    group.leave()
    assert not isinstance(run_all({"left": (links["left"], player.steps())})["left"], Exception)
    assert len(player.played) == 1


def test_a_beginning_has_nearly_the_quality_of_the_whole() -> None:
    recording = textures.GENERATORS["wood"](seed=1, seconds=15.0)
    growing = begin_encoding(recording)
    assert growing.packets[3] == growing.packets[:4][3]
    encoding = growing.finished()
    snr_db = encoding.quality.snr_db
    assert snr_db is not None and abs(snr_db - 14.8) < 0.6
    assert encoding.stream.samples == 42_000 and len(encoding.stream.packets) == len(growing.packets)


@pytest.mark.parametrize("word", WORDS)
def test_every_word_is_a_command(word: str) -> None:
    line = f"{word} -1.5" if word in ("seek", "gain") else word
    assert command_of(f" {line}\r\n") == Command(word, -1.5 if word in ("seek", "gain") else 0.0)
    for wrong in (f"{word} x", f"{word}1", f"{word} inf", f"{word} nan"):
        with pytest.raises(InputError):
            command_of(wrong)


def test_keys_are_commands() -> None:
    assert list(_commands("".join(KEYS) + "x\x1b")) == list(KEYS.values())


def test_a_socket_takes_commands_and_tells_events_and_errors(tmp_path: Path) -> None:
    remote = Remote()
    commands = remote.commands()
    control = Control(tmp_path / "control", remote)
    with pytest.raises(InputError, match="no control socket"):
        Control(tmp_path / "control", remote)
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(tmp_path / "control"))
        client.sendall(b"fly\nseek 2\n")
        lines = client.makefile()
        assert "there is no command 'fly'" in lines.readline()
        control.tell(Event("track", "a.wav"))
        assert '"track": "a.wav"' in lines.readline()
        assert commands.get(timeout=60.0) == Command("seek", 2.0)
    control.close()
    assert not (tmp_path / "control").exists()


def test_a_client_that_does_not_read_holds_nobody_up_and_is_dropped(tmp_path: Path) -> None:
    control = Control(tmp_path / "control", Remote())
    with contextlib.closing(control), socket.socket(socket.AF_UNIX) as client:
        client.settimeout(60.0)
        client.connect(str(tmp_path / "control"))
        client.sendall(b"fly\n")
        assert client.recv(1) == b"{"
        for _ in range(5000):
            control.tell(Event("position", "a.wav"))
        while client.recv(1 << 16):
            pass
