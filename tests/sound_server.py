"""A private sound server for tests: PulseAudio, or PipeWire behind its PulseAudio interface, with sinks of silence."""

import contextlib
import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Self

import numpy as np
import pytest
from numpy.typing import NDArray

from vibrocast.device_protocol.transports import TransportError
from vibrocast.output import sound_card
from vibrocast.output.actuator import Codes, Samples

PAD, HEADPHONES = "Gamepad", "Headphones"
"""Sinks: one as of a gamepad, with four channels at 48 kHz in int16; one with two at 44.1 kHz in float32."""
_SINKS = {
    PAD: "sink_name=pad rate=48000 channels=4 format=s16le",
    HEADPHONES: "sink_name=headphones rate=44100 channels=2 format=float32le",
}
_START_S = 20.0
_PACKAGES = {"pulseaudio": "pulseaudio", "pactl": "pulseaudio-utils"}
_PIPEWIRE_PACKAGES = {
    **{name: name for name in ("pipewire", "wireplumber", "pipewire-pulse")},
    "dbus-run-session": "dbus-daemon",
    "pactl": "pulseaudio-utils",
}
_PULSEAUDIO = "pulseaudio -n --daemonize=no --exit-idle-time=-1 --use-pid-file=no --no-cpu-limit"
_PIPEWIRE = "pipewire & sleep 0.5; wireplumber & pipewire-pulse & wait"


class SoundServer:
    """A running server. `environment`: the variables by which a program finds it."""

    def __init__(self, kind: str) -> None:
        missing = {
            package
            for program, package in (_PACKAGES if kind == "PulseAudio" else _PIPEWIRE_PACKAGES).items()
            if shutil.which(program) is None
        }
        if missing:
            pytest.skip(f"no {kind}; install the Debian packages {' '.join(sorted(missing))}")
        self._folder = tempfile.mkdtemp(prefix="vibrocast-sound-")
        socket = Path(self._folder) / ("native" if kind == "PulseAudio" else "pulse/native")
        folders = dict.fromkeys(("XDG_RUNTIME_DIR", "HOME"), self._folder)
        self.environment = {**folders, "PULSE_SERVER": f"unix:{socket}"}
        command = ["dbus-run-session", "--", "sh", "-c", _PIPEWIRE]
        if kind == "PulseAudio":
            command = [*_PULSEAUDIO.split(), "-L", f"module-native-protocol-unix socket={socket} auth-anonymous=1"]
        # A group of processes of its own, which ends as a whole.
        self._process = subprocess.Popen(
            command,
            env=os.environ | self.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._sinks: dict[str, str] = {}
        try:
            for sink in _SINKS:
                self.add(sink)
        except BaseException:
            self.stop()
            raise

    @property
    def has_ended(self) -> bool:
        """Whether the server runs no more."""
        return self._process.poll() is not None

    def add(self, sink: str) -> None:
        """Plug a sink in, as soon as the server answers."""
        arguments = [*_SINKS[sink].split(), f"sink_properties=device.description={sink}"]
        until_s = time.monotonic() + _START_S
        while True:
            loaded = self._control("load-module", "module-null-sink", *arguments)
            if loaded.returncode == 0:
                self._sinks[sink] = loaded.stdout.strip()
                return
            if time.monotonic() > until_s:
                raise AssertionError(f"the sound server does not start: {loaded.stderr}")
            time.sleep(0.2)

    def remove(self, sink: str) -> None:
        """Unplug a sink."""
        assert self._control("unload-module", self._sinks.pop(sink)).returncode == 0

    def _control(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        environment = os.environ | self.environment
        return subprocess.run(["pactl", *arguments], env=environment, capture_output=True, text=True, timeout=_START_S)

    def stop(self) -> None:
        """Kill the server; may be called again."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, 9)
        self._process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)


@pytest.fixture(scope="session")
def sound_servers() -> Iterator[Callable[[str], SoundServer]]:
    """Servers by kind, each started once in this process."""
    running: dict[str, SoundServer] = {}

    def server(kind: str) -> SoundServer:
        if kind not in running or running[kind].has_ended:  # under load, a server may end by itself
            running[kind] = SoundServer(kind)
        return running[kind]

    yield server
    for each in running.values():
        each.stop()


def _found(server: SoundServer, monkeypatch: pytest.MonkeyPatch) -> SoundServer:
    pytest.importorskip("miniaudio", reason="no miniaudio; install the extra [audio]")
    for name, value in server.environment.items():
        if name != "HOME":
            monkeypatch.setenv(name, value)
    return server


@pytest.fixture
def pulseaudio(sound_servers: Callable[[str], SoundServer], monkeypatch: pytest.MonkeyPatch) -> SoundServer:
    """PulseAudio, which this process and its children find."""
    return _found(sound_servers("PulseAudio"), monkeypatch)


@pytest.fixture(params=["PulseAudio", "PipeWire"])
def sound_server(
    request: pytest.FixtureRequest, sound_servers: Callable[[str], SoundServer], monkeypatch: pytest.MonkeyPatch
) -> SoundServer:
    """Each of the servers, which this process and its children find."""
    return _found(sound_servers(request.param), monkeypatch)


@pytest.fixture
def mortal_sound_server(monkeypatch: pytest.MonkeyPatch) -> Iterator[SoundServer]:
    """PulseAudio for one test alone, which may kill it."""
    server = SoundServer("PulseAudio")
    try:
        yield _found(server, monkeypatch)
    finally:
        server.stop()


class Listener:
    """Records all channels of a sink from its monitor, from when samples come until the end of the block."""

    def __init__(self, sink: str) -> None:
        card = sound_card.find(f"Monitor of {sink}", recording=True)
        self._capture = sound_card.Capture(card, range(1, card.channels + 1))
        self._blocks: list[NDArray[np.float32]] = []
        self._ending = threading.Event()
        self._failure: TransportError | None = None
        self._thread = threading.Thread(target=self._listen)

    def __enter__(self) -> Self:
        self._capture.wait_for_begin()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        time.sleep(0.3)  # samples under way arrive
        self._ending.set()
        self._thread.join()
        self._capture.close()

    def _listen(self) -> None:
        try:
            while not self._ending.is_set():
                self._blocks.append(self._capture.read(0.1))
        except TransportError as failure:  # it heard nothing more: `newest` and `heard` raise it
            self._failure = failure

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    @property
    def overruns(self) -> int:
        """How often samples were lost."""
        return self._capture.overruns

    def newest(self, seconds: float) -> Samples:
        """Return the last part of the samples heard. Raises DeviceGone if it hears no more."""
        self._check()
        blocks = self._blocks[-200:]
        samples = np.concatenate(blocks) if blocks else np.zeros((0, 1))
        return samples[-round(seconds * self._capture.rate_hz) :].astype(np.float64)

    def heard(self) -> Samples:
        """Return what was played in codes, float64 (n, channels), which are whole where nothing scales or dithers.

        Raises DeviceGone if it heard no more at some time.
        """
        self._check()
        return np.concatenate(self._blocks).astype(np.float64) * 32768


def position_of(codes: Codes, heard: Samples) -> int | None:
    """Return the frame of `heard` (n, channels) from which on it equals `codes` (m, channels); None if none is."""
    at = int(np.argmax(np.abs(codes.astype(np.int64)).max(axis=1)))
    for candidate in np.flatnonzero((heard == codes[at]).all(axis=1)) - at:
        if candidate >= 0 and np.array_equal(heard[candidate : candidate + len(codes)], codes):
            return int(candidate)
    return None
