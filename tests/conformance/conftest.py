"""The controllers under test; a further device is one more entry in DEVICES."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest

from device_protocol.transports import SerialTransport, UsbTransport
from host.conformance.fixtures import *  # noqa: F403
from host.conformance.line import Line
from simulated_device.controller import Controller
from simulated_device.memory_link import MemoryLink
from simulated_device.pty_port import PtyPort
from simulated_device.usb_backend import PRODUCT_ID, VENDOR_ID, UsbPort


@contextmanager
def over_memory() -> Iterator[Line]:
    link = MemoryLink(Controller())
    yield Line(link, link.clock, link.sleep)


@contextmanager
def over_pty() -> Iterator[Line]:
    with PtyPort(Controller()) as port, SerialTransport(port.name) as transport:
        yield Line(transport)


@contextmanager
def over_usb() -> Iterator[Line]:
    with UsbPort(Controller()) as port, UsbTransport(VENDOR_ID, PRODUCT_ID, port) as transport:
        yield Line(transport)


DEVICES: dict[str, Callable[[], AbstractContextManager[Line]]] = {
    "memory": over_memory,
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
