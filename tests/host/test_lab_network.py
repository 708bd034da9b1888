"""OSC messages that control a player, and LSL markers that tell when a texture is felt."""

import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import pytest
from pythonosc.osc_message import OscMessage
from pythonosc.osc_message_builder import build_msg

from tests.conftest import linked, noise, texture
from vibrocast import textures
from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import InputError
from vibrocast.host.devices import session_with
from vibrocast.host.lab_network import Markers, OscServer, files_by_name
from vibrocast.host.track_player import Event, TrackOptions, TrackPlayer

os.environ.setdefault("LSLAPICFG", str(Path(__file__).with_name("lsl.cfg")))  # liblsl reads it when it is loaded


class Client:
    """Sends OSC messages to a server in a thread of its own."""

    def __init__(self, folder: Path, timeout_s: float = 0.0) -> None:
        self.events: list[Event] = []
        session = session_with(linked()[1], "memory")
        self._server = OscServer(
            session, folder, ("127.0.0.1", 0), TrackOptions(), timeout_s=timeout_s, tell=self.events.append
        )
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._server.serve, args=(self._ended.is_set,))
        self._thread.start()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(20)

    def send(self, address: str, *values: object) -> None:
        self.send_bytes(build_msg(address, list(values)).dgram)

    def send_bytes(self, data: bytes) -> None:
        self._socket.sendto(data, ("127.0.0.1", self._server.port))

    def answer(self) -> tuple[str, str]:
        message = OscMessage(self._socket.recv(4096))
        return message.address, message.params[0]

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._socket.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("oak", "wood/ash", "wood/elm"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        textures.save(tmp_path / f"{name}.wav", texture(noise(0.5, rms=2.0)))
    textures.save(tmp_path / "oak.csv", texture(noise(0.5)))
    return tmp_path


@pytest.fixture
def client(folder: Path) -> Iterator[Client]:
    client = Client(folder)
    yield client
    client.close()


def test_files_go_by_their_paths_in_the_folder(folder: Path) -> None:
    assert sorted(files_by_name(folder)) == [
        "oak.csv",
        "oak.wav",
        "wood/ash",
        "wood/ash.wav",
        "wood/elm",
        "wood/elm.wav",
    ]


def test_a_file_plays_to_its_end_and_another_one_after_it(client: Client) -> None:
    for name in ("oak.wav", "wood/ash"):
        client.send("/play", name)
        assert client.answer() == ("/track", Path(name).with_suffix(".wav").name)
        assert client.answer()[0] == "/ended"


def test_a_file_plays_without_end_until_stop_at_the_level_set_before(client: Client) -> None:
    client.send("/gain_db", -6.0)
    client.send("/play", "wood/elm", 0)
    assert client.answer() == ("/track", "elm.wav")
    while not any(event.kind == "pass" for event in client.events):
        time.sleep(0.01)
    client.send("/pause")
    client.send("/resume")
    client.send("/stop")
    assert client.answer() == ("/ended", "elm.wav")
    assert client.events[-1].gain_db == -6


def test_a_client_that_falls_silent_leaves_no_texture_behind(folder: Path) -> None:
    client = Client(folder, timeout_s=0.2)
    client.send("/play", "oak.wav", 0)
    told: list[str] = []
    while "/error" not in told:
        told.append(client.answer()[0])
    assert told[-2:] == ["/ended", "/error"]  # a busy machine may be silent before the track has begun
    client.close()


@pytest.mark.parametrize(
    ("address", "values", "error"),
    [
        ("/play", ("../oak.wav",), "'../oak.wav' is not in the folder; it holds"),
        ("/play", ("oak.wav", -1), "LOOPS is a whole number"),
        ("/play", ("oak.wav", 2.5), "LOOPS is a whole number"),
        ("/play", (), "/play with 0 values is no message; send /play NAME"),
        ("/gain_db", (float("nan"),), "/gain_db with 1 values is no message"),
        ("/gain_db", ("loud",), "/gain_db with 1 values is no message"),
        ("/fly", (), "/fly with 0 values is no message"),
    ],
)
def test_a_wrong_message_is_answered(client: Client, address: str, values: tuple[object, ...], error: str) -> None:
    client.send(address, *values)
    told = client.answer()
    assert told[0] == "/error" and error in told[1]


def test_damaged_messages_change_nothing(client: Client) -> None:
    for data in (b"", b"/", b"/play", b"/play\0\0\0,s\0\0", b"#bundle\0" + b"\xff" * 40, b"\xff" * 300):
        client.send_bytes(data)
    client.send("/play", "wood/ash")
    while (told := client.answer())[0] == "/error":
        pass
    assert told == ("/track", "ash.wav")


def test_a_controller_that_is_lost_ends_the_server(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(steps: object) -> NoReturn:
        raise TransportError("the cable is out")

    controller = linked()[1]
    monkeypatch.setattr(controller, "run", lost)
    server = OscServer(session_with(controller, "memory"), folder, ("127.0.0.1", 0), TrackOptions())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.sendto(build_msg("/play", ["oak.wav", 0]).dgram, ("127.0.0.1", server.port))
        with pytest.raises(TransportError, match="the cable is out"):
            server.serve()


def test_a_folder_without_a_track_and_a_port_in_use_are_rejected(folder: Path, tmp_path: Path) -> None:
    session = session_with(linked()[1], "memory")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"oak\.wav: not a folder"):
        OscServer(session, folder / "oak.wav", ("127.0.0.1", 0), TrackOptions())
    with pytest.raises(InputError, match="no recordings"):
        OscServer(session, tmp_path / "empty", ("127.0.0.1", 0), TrackOptions())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match="no OSC server can listen there"):
            OscServer(session, folder, taken.getsockname(), TrackOptions())


def test_markers_reach_an_inlet_with_the_times_at_the_skin(folder: Path) -> None:
    import pylsl

    markers = Markers("memory")
    (found,) = pylsl.resolve_byprop("name", "vibrocast", timeout=20)
    inlet = pylsl.StreamInlet(found)
    inlet.open_stream(timeout=20)
    events: list[Event] = []
    earliest: list[float] = []

    def tell(event: Event) -> None:
        if event.kind in ("track", "pass", "ended"):
            events.append(event)
            earliest.append(pylsl.local_clock() - time.time())
        markers.tell(event)

    player = TrackPlayer(session_with(linked()[1], "memory"), [folder / "oak.wav"], TrackOptions(loops=2), tell=tell)
    player._session.controller.run(player.steps())
    texts = ["start oak.wav", "loop oak.wav", "stop oak.wav"]
    for event, offset_s, text in zip(events, earliest, texts, strict=True):
        samples, stamp_s = inlet.pull_sample(timeout=20)
        felt_s = event.skin_s - (0.0 if event.kind == "ended" else event.position_s)
        assert samples == [text]
        assert stamp_s == pytest.approx(felt_s + offset_s, abs=0.1)
