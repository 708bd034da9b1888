"""The controllers under test; a further device is one more entry in DEVICES."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest

from device_protocol.transports import SerialTransport, UsbTransport
from host.conformance.fixtures import *  # noqa: F403
from host.conformance.line import Line
from simulated_device.controller import FLASH_BYTES, Controller, Settings
from simulated_device.cortex_m import CortexM
from simulated_device.device import Device
from simulated_device.firmware import Firmware
from simulated_device.flash import FlashMemory
from simulated_device.memory_link import MemoryLink
from simulated_device.pty_port import PtyPort
from simulated_device.usb_backend import PRODUCT_ID, VENDOR_ID, UsbPort


def in_simulated_time(make: Callable[[FlashMemory], Device]) -> Callable[[], AbstractContextManager[Line]]:
    """Return what opens a line to a controller in this process; its flash outlives a restart."""

    @contextmanager
    def over_memory() -> Iterator[Line]:
        flash = FlashMemory(FLASH_BYTES)
        link = MemoryLink(make(flash))

        def restart() -> None:
            link.controller = make(flash)

        yield Line(link, link.clock, link.sleep, restart)

    return over_memory

# A board with little memory.
SMALL = Settings(channels=2, buffer_samples=2048, capture_samples=2048, watchdog_ms=500)
SMALL_SIZES = {
    "VC_MAX_CHANNELS": 2,
    "VC_BUFFER_PACKETS": 64,
    "VC_BUFFER_BYTES": 8192,
    "VC_MAXIMUM_PAYLOAD_BYTES": 640,
    "VC_RATE_RATIO": 4,
}


@contextmanager
def over_pty() -> Iterator[Line]:
    with PtyPort(Controller()) as port, SerialTransport(port.name) as transport:
        yield Line(transport)


@contextmanager
def over_usb() -> Iterator[Line]:
    with UsbPort(Controller()) as port, UsbTransport(VENDOR_ID, PRODUCT_ID, port) as transport:
        yield Line(transport)


DEVICES: dict[str, Callable[[], AbstractContextManager[Line]]] = {
    "memory": in_simulated_time(lambda flash: Controller(flash=flash)),
    "firmware": in_simulated_time(lambda flash: Firmware(flash=flash)),
    "small-firmware": in_simulated_time(lambda flash: Firmware(SMALL, flash, sizes=SMALL_SIZES)),
    "cortex-m4": in_simulated_time(lambda flash: CortexM("cortex-m4", flash)),
    "cortex-m7": in_simulated_time(lambda flash: CortexM("cortex-m7", flash)),
    "pty": over_pty,
    "usb": over_usb,
}
# In real time, what the way to a controller may spoil; its messages are tried in simulated time.
WAYS = ("pty", "usb")
MODULES_FOR_WAYS = ("test_frames", "test_link", "test_flashing")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what takes long, or tells nothing new."""
    left_out = [item for item in items if isinstance(item, pytest.Function) and not is_worth_it(item)]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if item not in left_out]


def is_worth_it(item: pytest.Function) -> bool:
    device = item.callspec.params.get("line") if hasattr(item, "callspec") else None
    if device not in WAYS:
        return True
    return item.function.__module__.endswith(MODULES_FOR_WAYS) and item.get_closest_marker("long") is None


@pytest.fixture(params=DEVICES)
def line(request: pytest.FixtureRequest) -> Iterator[Line]:
    """A line to each of the devices."""
    with DEVICES[request.param]() as opened:
        yield opened
