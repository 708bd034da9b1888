"""The controller behind a real pseudo-terminal and as a USB device: plugged, unplugged, opened and closed."""

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import usb.core

from device_protocol.messages import Status
from device_protocol.transports import SerialTransport, TransportError, UsbTransport
from host.controller import Controller as Host
from simulated_device.controller import Controller
from simulated_device.memory_link import FaultyLine
from simulated_device.pty_port import PtyPort
from simulated_device.usb_backend import ENDPOINT_IN, ENDPOINT_OUT, PRODUCT_ID, VENDOR_ID, UsbPort


@pytest.fixture
def pty_port() -> Iterator[PtyPort]:
    with PtyPort(Controller()) as port:
        yield port


@pytest.fixture
def usb_port() -> Iterator[UsbPort]:
    with UsbPort(Controller()) as port:
        yield port


def find(port: UsbPort) -> usb.core.Device:
    return usb.core.find(backend=port, idVendor=VENDOR_ID, idProduct=PRODUCT_ID)


def test_pty_survives_hosts_that_open_and_close_it(pty_port: PtyPort) -> None:
    for _ in range(3):
        with Host(SerialTransport(pty_port.name)) as host:
            assert isinstance(host.request_status(), Status)


def test_pty_survives_a_host_that_never_reads_and_garbage(pty_port: PtyPort) -> None:
    rude = os.open(pty_port.name, os.O_RDWR | os.O_NOCTTY)
    for _ in range(200):
        os.write(rude, os.urandom(300) + b"\0")
    os.close(rude)
    with Host(SerialTransport(pty_port.name)) as host:
        assert host.request_status().bad_frames > 0


def test_pty_unplugged_breaks_the_transport_and_comes_back_under_the_same_name(pty_port: PtyPort) -> None:
    with Host(SerialTransport(pty_port.name)) as host:
        pty_port.unplug()
        assert not Path(pty_port.name).exists()
        with pytest.raises(TransportError):
            host.request_status()
        with pytest.raises(TransportError):
            host.reconnect(0.0)
        pty_port.plug()
        host.reconnect(5.0)
        assert isinstance(host.request_status(), Status)


def test_pty_leaves_nothing_behind() -> None:
    with PtyPort(Controller()) as port:
        name = Path(port.name)
        assert name.exists()
    assert not name.parent.exists()
    port.close()


def test_usb_device_is_found_and_talks(usb_port: UsbPort) -> None:
    device = find(usb_port)
    assert device.idVendor == VENDOR_ID
    assert len(list(usb.core.find(backend=usb_port, find_all=True))) == 1
    with Host(UsbTransport(VENDOR_ID, PRODUCT_ID, usb_port)) as host:
        assert isinstance(host.request_status(), Status)


def test_usb_descriptors_out_of_range_raise_index_error(usb_port: UsbPort) -> None:
    with pytest.raises(IndexError):
        usb_port.get_configuration_descriptor("controller", 1)
    with pytest.raises(IndexError):
        usb_port.get_interface_descriptor("controller", 1, 0, 0)
    with pytest.raises(IndexError):
        usb_port.get_endpoint_descriptor("controller", 2, 0, 0, 0)


def test_usb_errors_are_those_of_libusb(usb_port: UsbPort) -> None:
    device = find(usb_port)
    device.set_configuration()
    with pytest.raises(usb.core.USBTimeoutError) as timed_out:
        device.read(ENDPOINT_IN, 64, 10)
    assert timed_out.value.errno == errno.ETIMEDOUT
    with pytest.raises(usb.core.USBError) as stalled:
        device.ctrl_transfer(0xC0, 1, 0, 0, 4)
    assert stalled.value.errno == errno.EPIPE
    usb_port.unplug()
    with pytest.raises(usb.core.USBError) as gone:
        device.write(ENDPOINT_OUT, b"x", 10)
    assert gone.value.errno == errno.ENODEV
    assert find(usb_port) is None


def test_usb_handle_from_before_the_pull_stays_dead_and_a_new_one_works(usb_port: UsbPort) -> None:
    device = find(usb_port)
    device.set_configuration()
    with Host(UsbTransport(VENDOR_ID, PRODUCT_ID, usb_port)) as host:
        usb_port.unplug()
        with pytest.raises(TransportError):
            host.request_status()
        usb_port.plug()
        with pytest.raises(usb.core.USBError):
            device.write(ENDPOINT_OUT, b"x", 10)
        host.reconnect(5.0)
        assert isinstance(host.request_status(), Status)


def test_faulty_line_gives_the_same_faults_for_the_same_seed() -> None:
    data = b"".join(bytes([number, 1, 2, 3]) + b"\0" for number in range(1, 200))
    results = {FaultyLine(seed, lost=0.1, flipped=0.1, doubled=0.1, swapped=0.1).carry(data) for seed in (1, 1, 2)}
    assert len(results) == 2
    assert FaultyLine().carry(data[:7]) + FaultyLine().carry(b"") == data[:5]
    assert FaultyLine(lost=1.0).carry(data) == b""
