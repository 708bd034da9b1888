"""Transports over a real pseudo-terminal and over a USB device that a small pyusb backend makes up."""

import errno
import fcntl
import os
import select
import termios
import tty
from array import array
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import serial
import usb.backend
import usb.core

from vibrocast.device_protocol.transports import (
    UDEV_RULES,
    SerialTransport,
    ThreadedTransport,
    TransportError,
    UsbTransport,
    open_transport,
    selectable,
    serial_port,
)
from vibrocast.simulated_device.usb_backend import PRODUCT_ID, VENDOR_ID


@pytest.fixture
def pseudo_terminal() -> Iterator[tuple[int, str]]:
    """The controller's end of a pseudo-terminal, and the name of the port."""
    controller, port = os.openpty()
    tty.setraw(port)
    os.set_blocking(controller, False)
    yield controller, os.ttyname(port)
    os.close(port)
    os.close(controller)


EVERY_BYTE = bytes(range(256)) * 4


def test_serial_carries_every_byte_both_ways(pseudo_terminal: tuple[int, str]) -> None:
    controller, port = pseudo_terminal
    with SerialTransport(port) as transport:
        transport.write(EVERY_BYTE)
        assert os.read(controller, 4096) == EVERY_BYTE
        os.write(controller, EVERY_BYTE)
        received = b""
        while len(received) < len(EVERY_BYTE):
            received += transport.read(1.0)
        assert received == EVERY_BYTE


def test_serial_read_without_data_returns_nothing(pseudo_terminal: tuple[int, str]) -> None:
    with SerialTransport(pseudo_terminal[1]) as transport:
        assert transport.read(0) == b""
        assert transport.read(0.01) == b""


def test_serial_reopens(pseudo_terminal: tuple[int, str]) -> None:
    controller, port = pseudo_terminal
    with open_transport(f"serial:{port}") as transport:
        transport.reopen()
        transport.write(b"again")
        assert os.read(controller, 10) == b"again"


def test_serial_port_is_not_shared(pseudo_terminal: tuple[int, str]) -> None:
    with SerialTransport(pseudo_terminal[1]), pytest.raises(TransportError, match="no other program"):
        SerialTransport(pseudo_terminal[1])


def test_serial_port_that_is_not_there() -> None:
    with pytest.raises(TransportError, match="vibrocast devices"):
        open_transport("serial:/dev/no-such-port")


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("serial:/dev/ttyACM0", ("/dev/ttyACM0", 921_600)),
        ("serial:/dev/ttyACM0@115200", ("/dev/ttyACM0", 115_200)),
        ("serial:COM3@57600", ("COM3", 57_600)),
        ("serial:socket://127.0.0.1:7000", ("socket://127.0.0.1:7000", 921_600)),
        ("serial:rfc2217://me@bench:7000", ("rfc2217://me@bench:7000", 921_600)),
        ("serial:rfc2217://bench:7000@9600", ("rfc2217://bench:7000", 9600)),
        ("serial:/dev/serial/by-id/usb-5@left", ("/dev/serial/by-id/usb-5@left", 921_600)),
        ("serial:/dev/tty@5@9600", ("/dev/tty@5", 9600)),
    ],
)
def test_an_address_names_the_port_and_its_baud_rate(address: str, expected: tuple[str, int]) -> None:
    assert serial_port(address) == expected


@pytest.mark.parametrize("baud", ["0", "1199", "20000001"])
def test_a_baud_rate_that_no_port_has_is_rejected(baud: str) -> None:
    with pytest.raises(TransportError, match=f"{baud} is no baud rate; give 1200 to 20000000"):
        open_transport(f"serial:/dev/ttyACM0@{baud}")


def test_the_port_runs_at_the_baud_rate_of_its_address(pseudo_terminal: tuple[int, str]) -> None:
    controller, port = pseudo_terminal
    with open_transport(f"serial:{port}@115200"):
        assert termios.tcgetattr(controller)[4:6] == [termios.B115200, termios.B115200]
    with open_transport(f"serial:{port}"):
        assert termios.tcgetattr(controller)[4:6] == [termios.B921600, termios.B921600]


def test_dtr_and_rts_are_left_alone(pseudo_terminal: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> None:
    controls = []
    control = fcntl.ioctl

    def noted(file: Any, request: int, *arguments: Any) -> Any:
        controls.append(request)
        return control(file, request, *arguments)

    monkeypatch.setattr(fcntl, "ioctl", noted)
    hangs_up = termios.tcgetattr(pseudo_terminal[0])[2] & termios.HUPCL
    with SerialTransport(pseudo_terminal[1]) as transport:
        transport.write(b"x")
        transport.reopen()
    assert not {termios.TIOCMSET, termios.TIOCMBIS, termios.TIOCMBIC} & set(controls)
    assert termios.tcgetattr(pseudo_terminal[0])[2] & termios.HUPCL == hangs_up
    serial.Serial(pseudo_terminal[1]).close()
    assert termios.TIOCMBIS in controls, "pyserial itself sets them, and this test would see it"


def test_unplugged_serial_port_is_an_error_and_not_a_hang() -> None:
    controller, port = os.openpty()
    transport = SerialTransport(os.ttyname(port))
    os.close(port)
    os.close(controller)
    with pytest.raises(TransportError, match="cable"):
        transport.read(1.0)
    with pytest.raises(TransportError, match="cable"):
        transport.write(b"x")
    with pytest.raises(TransportError, match="cannot open"):
        transport.reopen()
    transport.close()


def test_serial_port_that_takes_nothing_is_an_error_and_not_a_hang(
    pseudo_terminal: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vibrocast.device_protocol.transports._WRITE_TIMEOUT_S", 0.05)
    with SerialTransport(pseudo_terminal[1]) as transport, pytest.raises(TransportError, match="took no data"):
        transport.write(bytes(1_000_000))


def test_serial_port_keeps_what_its_controller_does_not_take_at_once(pseudo_terminal: tuple[int, str]) -> None:
    controller, port = pseudo_terminal
    data = bytes(range(256)) * 40
    with SerialTransport(port) as transport:
        written = 0
        while not transport.unsent:
            transport.write(data[:1024])
            written += 1024
        received = b""
        while transport.unsent or len(received) < written:
            received += os.read(controller, 4096)
            assert transport.read(0) == b""
        assert received == (data[:1024] * (written // 1024))


def test_serial_port_without_a_file_is_read_by_pyserial() -> None:
    with SerialTransport("loop://") as transport:
        assert transport.file is None
        assert transport.read(0.01) == b""
        transport.write(EVERY_BYTE)
        received = b""
        while len(received) < len(EVERY_BYTE):
            received += transport.read(1.0)
        assert received == EVERY_BYTE
        threaded = selectable(transport)
        assert isinstance(threaded, ThreadedTransport)
        threaded.close()


def test_serial_port_whose_other_end_closes_is_an_error() -> None:
    controller, port = os.openpty()
    with SerialTransport(os.ttyname(port)) as transport:
        os.close(port)
        os.close(controller)
        with pytest.raises(TransportError, match="broke off"):
            transport.read(1.0)


def descriptor(**fields: int) -> Any:
    """A descriptor as libusb gives it, with the fields that pyusb asks for."""
    return SimpleNamespace(extra_descriptors=array("B"), **fields)


class MadeUpUsb(usb.backend.IBackend):  # type: ignore[misc]
    """One device, 1209:0001, that sends back what it gets; at most 64 bytes a transfer.

    `stalled`: the endpoints that reject every transfer until their halt is cleared.
    """

    def __init__(self, interface_class: int = 0xFF, endpoints: tuple[int, ...] = (0x01, 0x82)) -> None:
        self.interface_class = interface_class
        self.endpoints = endpoints
        self.fault: int | None = None
        self.plugged = True
        self.stalled: set[int] = set()
        self.echo = b""

    def enumerate_devices(self) -> list[str]:
        return ["device"] if self.plugged else []

    def get_device_descriptor(self, device: str) -> Any:
        identity = {"idVendor": 0x1209, "idProduct": 0x0001, "bcdDevice": 0x0100, "bcdUSB": 0x0200}
        strings = {"iManufacturer": 0, "iProduct": 0, "iSerialNumber": 0}
        kind = {"bLength": 18, "bDescriptorType": 1, "bDeviceClass": 0, "bDeviceSubClass": 0, "bDeviceProtocol": 0}
        place = {"bus": 1, "address": 1, "port_number": 1, "port_numbers": None, "speed": 3}
        return descriptor(**identity, **strings, **kind, **place, bMaxPacketSize0=64, bNumConfigurations=1)  # type: ignore[arg-type]

    def get_configuration_descriptor(self, device: str, configuration: int) -> Any:
        if configuration:
            raise IndexError
        fields = {"bLength": 9, "bDescriptorType": 2, "wTotalLength": 32, "bNumInterfaces": 1}
        return descriptor(**fields, bConfigurationValue=1, iConfiguration=0, bmAttributes=0x80, bMaxPower=50)

    def get_interface_descriptor(self, device: str, interface: int, alternate: int, configuration: int) -> Any:
        if interface or alternate or configuration:
            raise IndexError
        fields = {"bLength": 9, "bDescriptorType": 4, "bInterfaceNumber": 0, "bAlternateSetting": 0}
        kind = {"bInterfaceClass": self.interface_class, "bInterfaceSubClass": 0, "bInterfaceProtocol": 0}
        return descriptor(**fields, **kind, bNumEndpoints=len(self.endpoints), iInterface=0)

    def get_endpoint_descriptor(
        self, device: str, endpoint: int, interface: int, alternate: int, configuration: int
    ) -> Any:
        address = self.endpoints[endpoint]
        fields = {"bLength": 7, "bDescriptorType": 5, "bEndpointAddress": address, "bmAttributes": 2}
        return descriptor(**fields, wMaxPacketSize=64, bInterval=0, bRefresh=0, bSynchAddress=0)

    def open_device(self, device: str) -> str:
        self.fail()
        return "handle"

    def close_device(self, handle: str) -> None:
        pass

    def get_configuration(self, handle: str) -> int:
        return 1

    def claim_interface(self, handle: str, interface: int) -> None:
        self.fail()

    def release_interface(self, handle: str, interface: int) -> None:
        self.fail()

    def clear_halt(self, handle: str, endpoint: int) -> None:
        self.fail()
        self.stalled.discard(endpoint)

    def bulk_write(self, handle: str, endpoint: int, interface: int, data: "array[int]", timeout_ms: int) -> int:
        self.fail(endpoint)
        self.echo += bytes(data[:64])
        return min(64, len(data))

    def bulk_read(self, handle: str, endpoint: int, interface: int, buffer: "array[int]", timeout_ms: int) -> int:
        self.fail(endpoint)
        assert timeout_ms > 0, "0 would wait for ever"
        if not self.echo:
            raise usb.core.USBTimeoutError("timed out", errno=errno.ETIMEDOUT)
        piece, self.echo = self.echo[:64], self.echo[64:]
        buffer[: len(piece)] = array("B", piece)
        return len(piece)

    def fail(self, endpoint: int = 0) -> None:
        if self.fault is not None:
            raise usb.core.USBError("made up", errno=self.fault)
        if endpoint in self.stalled:
            raise usb.core.USBError("Pipe error", errno=errno.EPIPE)


def test_usb_carries_every_byte_both_ways() -> None:
    with open_transport("usb:1209:0001", MadeUpUsb()) as transport:
        transport.write(EVERY_BYTE)
        assert b"".join(transport.read(0) for _ in range(len(EVERY_BYTE) // 64)) == EVERY_BYTE
        assert transport.read(0) == b""


def test_threads_give_a_usb_device_a_file_to_wait_for() -> None:
    backend = MadeUpUsb()
    with selectable(open_transport("usb:1209:0001", backend)) as transport:
        assert isinstance(transport, ThreadedTransport)
        for _ in range(2):
            transport.write(EVERY_BYTE)
            received = b""
            while len(received) < len(EVERY_BYTE):
                readable, _, _ = select.select([transport.file], [], [], 10.0)
                assert readable
                received += transport.read(0)
            assert received == EVERY_BYTE
            transport.reopen()
        backend.fault, backend.plugged = errno.ENODEV, False
        with pytest.raises(TransportError, match="cable"):
            while True:
                transport.read(1.0)
        with pytest.raises(TransportError, match="cable"):
            transport.write(b"x")
        with pytest.raises(TransportError, match="plug it in"):
            transport.reopen()
        backend.fault, backend.plugged = None, True
        transport.reopen()


def test_a_transport_that_has_a_file_needs_no_threads(pseudo_terminal: tuple[int, str]) -> None:
    with SerialTransport(pseudo_terminal[1]) as transport:
        assert selectable(transport) is transport


def test_unplugged_usb_device_is_an_error_until_it_is_back() -> None:
    backend = MadeUpUsb()
    transport = UsbTransport(0x1209, 0x0001, backend)
    backend.fault, backend.plugged = errno.ENODEV, False
    with pytest.raises(TransportError, match="cable"):
        transport.read(0)
    with pytest.raises(TransportError, match="cable"):
        transport.write(b"x")
    with pytest.raises(TransportError, match="plug it in"):
        transport.reopen()
    backend.fault, backend.plugged = None, True
    transport.reopen()
    transport.write(b"back")
    assert transport.read(0) == b"back"
    transport.close()
    transport.close()


def test_stalled_usb_endpoints_are_cleared_in_use_and_when_opened() -> None:
    backend = MadeUpUsb()
    backend.stalled = {0x01, 0x82}
    with UsbTransport(0x1209, 0x0001, backend) as transport:
        assert not backend.stalled
        backend.stalled = {0x01, 0x82}
        transport.write(EVERY_BYTE)
        assert transport.read(0) == b""
        assert transport.read(0) == EVERY_BYTE[:64]
        assert not backend.stalled


def test_usb_endpoint_that_stalls_for_ever_is_an_error_and_not_a_hang(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vibrocast.device_protocol.transports._WRITE_TIMEOUT_S", 0.05)
    backend = MadeUpUsb()
    monkeypatch.setattr(backend, "clear_halt", lambda handle, endpoint: None)
    transport = UsbTransport(0x1209, 0x0001, backend)
    backend.stalled = {0x01, 0x82}
    with pytest.raises(TransportError, match="took no data"):
        transport.write(b"x")
    assert transport.read(0) == b""


def test_usb_device_unplugged_while_a_stall_is_cleared_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = MadeUpUsb()
    transport = UsbTransport(0x1209, 0x0001, backend)
    backend.stalled = {0x82}

    def gone(handle: str, endpoint: int) -> None:
        raise usb.core.USBError("made up", errno=errno.ENODEV)

    monkeypatch.setattr(backend, "clear_halt", gone)
    with pytest.raises(TransportError, match="cable"):
        transport.read(0)


def test_usb_device_of_another_user_names_the_remedy() -> None:
    backend = MadeUpUsb()
    backend.fault = errno.EACCES
    with pytest.raises(TransportError, match=r"70-vibrocast\.rules to /etc/udev/rules\.d"):
        UsbTransport(0x1209, 0x0001, backend)
    rules = UDEV_RULES.read_text(encoding="utf-8")
    assert f'ATTR{{idVendor}}=="{VENDOR_ID:04x}", ATTR{{idProduct}}=="{PRODUCT_ID:04x}", TAG+="uaccess"' in rules
    backend.fault = errno.EBUSY
    with pytest.raises(TransportError, match="end the other program"):
        UsbTransport(0x1209, 0x0001, backend)


@pytest.mark.parametrize(
    "backend", [MadeUpUsb(interface_class=3), MadeUpUsb(endpoints=(0x82,)), MadeUpUsb(endpoints=())]
)
def test_usb_device_of_another_kind_is_rejected(backend: MadeUpUsb) -> None:
    with pytest.raises(TransportError, match="is no controller"):
        UsbTransport(0x1209, 0x0001, backend)


@pytest.mark.parametrize("address", ["", "serial:", "usb:", "usb:1209", "usb:xyz:0001", "usb:12090:0001", "tcp:host"])
def test_address_of_no_kind_is_rejected(address: str) -> None:
    with pytest.raises(TransportError, match=r"give serial:PORT\[@BAUD\] or usb:VID:PID"):
        open_transport(address)
