"""The controllers under test, each with a host's session to it; a further device is one more entry in DEVICES."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest

from device_protocol.transports import SerialTransport, UsbTransport
from host.controller import Controller as Host
from simulated_device.controller import Controller
from simulated_device.memory_link import MemoryLink
from simulated_device.pty_port import PtyPort
from simulated_device.usb_backend import PRODUCT_ID, VENDOR_ID, UsbPort


@contextmanager
def over_memory() -> Iterator[Host]:
    link = MemoryLink(Controller())
    yield Host(link, link.clock, link.sleep)


@contextmanager
def over_pty() -> Iterator[Host]:
    with PtyPort(Controller()) as port, Host(SerialTransport(port.name)) as session:
        yield session


@contextmanager
def over_usb() -> Iterator[Host]:
    with UsbPort(Controller()) as port, Host(UsbTransport(VENDOR_ID, PRODUCT_ID, port)) as session:
        yield session


DEVICES: dict[str, Callable[[], AbstractContextManager[Host]]] = {
    "memory": over_memory,
    "pty": over_pty,
    "usb": over_usb,
}


@pytest.fixture(params=DEVICES)
def session(request: pytest.FixtureRequest) -> Iterator[Host]:
    """A host's session with each of the devices."""
    with DEVICES[request.param]() as opened:
        yield opened
