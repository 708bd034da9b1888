"""The controllers under test: those of this project, or the one that --vibrocast-device names."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest

from tests.firmware.native import load
from vibrocast.harness.boards.cortex_m import CortexM
from vibrocast.harness.conformance.fixtures import *  # noqa: F403
from vibrocast.harness.conformance.tapped_link import TappedLink
from vibrocast.host import devices
from vibrocast.simulated_device.controller import FLASH_BYTES, Controller, Settings
from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.flash import FlashMemory
from vibrocast.simulated_device.memory_link import MemoryLink

# A board with little memory.
SMALL_SIZES = {
    "VC_CHANNELS": 2,
    "VC_MAX_CHANNELS": 2,
    "VC_BUFFER_SAMPLES": 2048,
    "VC_CAPTURE_SAMPLES": 2048,
    "VC_BUFFER_PACKETS": 64,
    "VC_BUFFER_BYTES": 8192,
    "VC_MAX_PAYLOAD_BYTES": 640,
    "VC_RATE_RATIO": 4,
}


def in_simulated_time(make: Callable[[FlashMemory], Device]) -> Callable[[], AbstractContextManager[TappedLink]]:
    """Return what opens a link to a controller in this process; its flash outlives a restart."""

    @contextmanager
    def over_memory() -> Iterator[TappedLink]:
        flash = FlashMemory(FLASH_BYTES)
        link = MemoryLink(make(flash))

        def restart() -> None:
            link.controller = make(flash)

        yield TappedLink(link, link.clock, link.sleep, restart)

    return over_memory


def at(address: str) -> Callable[[], AbstractContextManager[TappedLink]]:
    """Return what opens a link to the controller at an address."""

    @contextmanager
    def over_its_way() -> Iterator[TappedLink]:
        with devices.reach(address) as transport:
            yield TappedLink(transport)

    return over_its_way


DEVICES: dict[str, Callable[[], AbstractContextManager[TappedLink]]] = {
    "memory": in_simulated_time(lambda flash: Controller(flash=flash)),
    "small": in_simulated_time(
        lambda flash: Controller(Settings(watchdog_ms=500), flash, firmware=load(**SMALL_SIZES))
    ),
    "cortex-m4": in_simulated_time(lambda flash: CortexM("cortex-m4", flash)),
    "cortex-m7": in_simulated_time(lambda flash: CortexM("cortex-m7", flash)),
    "sim": at("sim"),
    "sim-usb": at("sim-usb"),
    "host": at("host"),
}
# In real time, only what the way to a controller may spoil; and on a second processor, only what it computes.
MODULES = {
    **dict.fromkeys(("sim", "sim-usb", "host"), ("test_frames", "test_link", "test_flashing")),
    "cortex-m7": ("test_streams", "test_playing", "test_flashing"),
}
# The modules that are not slow; on the other devices none is.
QUICK_MODULES = {
    "sim": ("test_frames", "test_flashing"),
    "host": ("test_frames",),
    **dict.fromkeys(("sim-usb", "cortex-m4", "cortex-m7"), ()),
}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each test on the devices that it can tell apart, or on the one that --vibrocast-device names."""
    if "link" not in metafunc.fixturenames:
        return
    named = metafunc.config.getoption("vibrocast_device")
    long = any(metafunc.definition.iter_markers("long"))
    module = metafunc.function.__module__.rpartition(".")[2]
    names = [name for name in DEVICES if name not in MODULES or (module in MODULES[name] and not long)]
    slow = [name for name in names if name in QUICK_MODULES and module not in QUICK_MODULES[name]]
    marked = [pytest.param(name, marks=[pytest.mark.slow] if name in slow else []) for name in names]
    metafunc.parametrize("link", named or marked, indirect=True)


@pytest.fixture
def link(request: pytest.FixtureRequest) -> Iterator[TappedLink]:
    """A link to a device."""
    with DEVICES.get(request.param, at(request.param))() as opened:
        yield opened
