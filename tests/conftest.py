"""Settings of every test, and what tests share: signals, streams, and sessions in simulated time."""

import contextlib
import gc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from tests.browser import browser as browser
from tests.sound_server import mortal_sound_server as mortal_sound_server
from tests.sound_server import pulseaudio as pulseaudio
from tests.sound_server import sound_server as sound_server
from tests.sound_server import sound_servers as sound_servers
from vibrocast.codec import Setting, Signal
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import Stream
from vibrocast.host import devices
from vibrocast.host.controller import Controller
from vibrocast.output.actuator import Actuator, Codes
from vibrocast.simulated_device.controller import Controller as SimulatedController
from vibrocast.simulated_device.controller import Settings
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire
from vibrocast.simulated_device.memory_link import MemoryLink, SimulatedTime
from vibrocast.textures import Recording

RATE_HZ = 2800
_SLOW_FIXTURES = {"sound_server", "pulseaudio", "mortal_sound_server", "browser"}

settings.register_profile("all", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("all")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as slow each test that starts a sound server or a browser."""
    for item in items:
        if _SLOW_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)


def pytest_unconfigure() -> None:
    """Keep msgspec's types from the last collection of garbage, in which they may crash (its issue 717)."""
    gc.freeze()


def noise(seconds: float = 1.0, channels: int = 1, rms: float = 1.0, seed: int = 1) -> Signal:
    """Return white noise at RATE_HZ, float64 (samples, channels)."""
    return rms * np.random.default_rng(seed).standard_normal((round(seconds * RATE_HZ), channels))


def texture(samples: Signal, unit: str = "um", rate_hz: float = RATE_HZ) -> Recording:
    """Return samples (n, channels) or (n,) as a recording."""
    return Recording(samples.reshape(len(samples), -1), rate_hz, unit, "texture")


def coded(samples: Signal, unit: str = "um", **setting: float | str) -> Stream:
    """Return samples (n, channels) or (n,) at RATE_HZ as a stream for live playing."""
    chosen: Setting | None = setting or None
    return encode_recording(texture(samples, unit), setting=chosen, live=True).stream


def session(link: MemoryLink) -> Controller:
    """Return the host's session over a link, in the link's time."""
    return Controller(link, link.clock, link.sleep)


def linked(
    settings: Settings | None = None,
    faults: Sequence[Fault] = (),
    seed: int = 0,
    *,
    time: SimulatedTime | None = None,
    on_dac: Callable[[Codes], None] | None = None,
) -> tuple[MemoryLink, Controller]:
    """Return a link to a simulated controller over a wire with faults, and a session; `on_dac` gets the DAC's codes."""
    link = MemoryLink(FaultyWire(SimulatedController(settings, on_dac=on_dac), faults, seed), time=time)
    return link, session(link)


@pytest.fixture
def sim() -> Controller:
    """A session with a simulated controller of the usual settings."""
    return linked()[1]


@pytest.fixture
def simulated_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every address be a simulated controller in simulated time of its own: nothing is late; for one session."""

    @contextlib.contextmanager
    def connect(address: str, runtime: str | None = None, actuator: Actuator | None = None) -> Iterator[Controller]:
        settings = Settings(runtime=runtime)
        if actuator is not None and devices.takes_actuator(address):
            settings = replace(settings, actuator=actuator)
        yield linked(settings)[1]

    monkeypatch.setattr("vibrocast.host.devices.connect", connect)
