"""Ways to a controller, behind one small interface: a serial port, or USB bulk endpoints of a vendor interface."""

import errno
import re
import time
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Any, Protocol, Self

import serial
import usb.core
import usb.util

# Fixed for UARTs (8 data bits, no parity, 1 stop bit, no flow control); a USB serial port ignores it.
BAUD = 921_600
VENDOR_INTERFACE_CLASS = 0xFF

_WRITE_TIMEOUT_S = 1.0
# A multiple of every bulk packet size (64 and 512), so that no read can overflow.
_USB_READ_BYTES = 4096
_SOCKET_READ_BYTES = 65_536


class TransportError(OSError):
    """The way to the controller cannot be opened, or broke; the message says what to do."""


class Transport(Protocol):
    """Bytes to and from a controller. Not safe to share between threads."""

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises TransportError if the way is broken or takes nothing for a second."""

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that are there, as soon as there are any; none after `timeout_s`. Raises TransportError."""

    def reopen(self) -> None:
        """Close, and open the same port or device anew. Raises TransportError while it is not there."""

    def close(self) -> None:
        """Release the port; may be called again."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class _Closing(ABC):
    """Makes a transport a context manager that closes itself."""

    @abstractmethod
    def close(self) -> None:
        """Release the port."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class SerialTransport(_Closing):
    """A serial port: a UART, a USB serial port, a pseudo-terminal, or a URL of pyserial, such as socket://HOST:PORT.

    Raises TransportError if it cannot be opened.
    """

    def __init__(self, port: str, baud: int = BAUD) -> None:
        self._port, self._baud = port, baud
        self._is_socket = port.startswith("socket://")
        self._serial = self._open()

    def _open(self) -> Any:
        try:
            # Exclusive: two programs on one port would garble each other's frames.
            return serial.serial_for_url(self._port, self._baud, write_timeout=_WRITE_TIMEOUT_S, exclusive=True)
        except (OSError, ValueError) as error:
            raise TransportError(
                f"cannot open serial port {self._port}: {error}. Check the name (`vibrocast devices` lists the ports), "
                "that no other program uses it and that you may read and write it."
            ) from error

    def _broken(self, error: Exception) -> TransportError:
        return TransportError(
            f"serial port {self._port} broke off ({error}). Check the cable and the controller, and that no other "
            "program uses the port."
        )

    def write(self, data: bytes) -> None:
        try:
            self._serial.write(data)
        except serial.SerialTimeoutException as error:
            raise TransportError(
                f"serial port {self._port} took no data for {_WRITE_TIMEOUT_S:g} s. Is a controller behind it?"
            ) from error
        except OSError as error:
            raise self._broken(error) from error

    def read(self, timeout_s: float) -> bytes:
        try:
            if self._serial.timeout != timeout_s:
                self._serial.timeout = timeout_s
            first: bytes = self._serial.read(1)
            if not first:
                return b""
            waiting: int = self._serial.in_waiting
            if self._is_socket:
                # pyserial tells only that bytes wait, not how many; with this timeout it gives those that do.
                self._serial.timeout, waiting = 0, _SOCKET_READ_BYTES
            rest: bytes = self._serial.read(waiting)
            return first + rest
        except OSError as error:
            raise self._broken(error) from error

    def reopen(self) -> None:
        self.close()
        self._serial = self._open()

    def close(self) -> None:
        self._serial.close()


class UsbTransport(_Closing):
    """The bulk endpoints of a USB device's vendor interface (class 0xFF, one bulk IN and one bulk OUT).

    `backend`: a pyusb backend, such as the simulated device's; None = libusb. Raises TransportError if there is no
    such device.
    """

    def __init__(self, vendor_id: int, product_id: int, backend: Any = None) -> None:
        self._name = f"USB device {vendor_id:04x}:{product_id:04x}"
        self._identifiers = {"idVendor": vendor_id, "idProduct": product_id}
        self._backend = backend or libusb_backend()
        if self._backend is None:
            raise TransportError("no libusb was found: install the package libusb-package again")
        self._open()

    def _open(self) -> None:
        try:
            device = usb.core.find(backend=self._backend, **self._identifiers)
            if device is None:
                raise TransportError(
                    f"there is no {self._name}. Plug it in and check its identifiers (`vibrocast devices` lists them)."
                )
            interface = usb.util.find_descriptor(_configuration(device), bInterfaceClass=VENDOR_INTERFACE_CLASS)
            self._in = interface and _bulk_endpoint(interface, usb.util.ENDPOINT_IN)
            self._out = interface and _bulk_endpoint(interface, usb.util.ENDPOINT_OUT)
            if self._in is None or self._out is None:
                raise TransportError(f"{self._name} lacks a vendor interface with bulk endpoints: no tactor controller")
            usb.util.claim_interface(device, interface)
            # A stall, or the data toggle of a program that ended in the middle, must not outlive what left it there.
            self._in.clear_halt()
            self._out.clear_halt()
        except usb.core.USBError as error:
            hint = (
                "Give your user access to it (a udev rule on Linux)." if error.errno == errno.EACCES else "Replug it."
            )
            raise TransportError(f"{self._name} cannot be opened ({error}). {hint}") from error
        self._device = device

    def _broken(self, error: Exception) -> TransportError:
        return TransportError(f"{self._name} broke off ({error}). Check the cable and the controller.")

    def write(self, data: bytes) -> None:
        deadline = time.monotonic() + _WRITE_TIMEOUT_S
        while data:
            try:
                data = data[self._out.write(data, int(_WRITE_TIMEOUT_S * 1000)) :]
            except usb.core.USBError as error:
                self._clear_stall(self._out, error)
            if data and time.monotonic() > deadline:
                raise TransportError(f"{self._name} took no data for {_WRITE_TIMEOUT_S:g} s. Reset the controller.")

    def read(self, timeout_s: float) -> bytes:
        try:
            # libusb takes 0 as "for ever".
            return bytes(self._in.read(_USB_READ_BYTES, max(1, round(timeout_s * 1000))))
        except usb.core.USBError as error:
            if not isinstance(error, usb.core.USBTimeoutError) and error.errno != errno.ETIMEDOUT:
                self._clear_stall(self._in, error)
            return b""

    def _clear_stall(self, endpoint: Any, error: usb.core.USBError) -> None:
        """Set a stalled endpoint going again; raise TransportError for any other error, or if that fails."""
        if error.errno != errno.EPIPE:
            raise self._broken(error) from error
        try:
            endpoint.clear_halt()
        except usb.core.USBError as failure:
            raise self._broken(failure) from failure

    def reopen(self) -> None:
        self.close()
        self._open()

    def close(self) -> None:
        usb.util.dispose_resources(self._device)


def libusb_backend() -> Any:
    """Return the libusb that this environment brings, as a pyusb backend; None where there is none."""
    import libusb_package

    return libusb_package.get_libusb1_backend()


def open_transport(address: str, usb_backend: Any = None) -> Transport:
    """Open "serial:PORT", as SerialTransport does, or "usb:VID:PID" (hexadecimal). Raises TransportError."""
    kind, _, rest = address.partition(":")
    if kind == "serial" and rest:
        return SerialTransport(rest)
    if kind == "usb" and (match := re.fullmatch("([0-9a-fA-F]{1,4}):([0-9a-fA-F]{1,4})", rest)):
        return UsbTransport(int(match[1], 16), int(match[2], 16), usb_backend)
    raise TransportError(f"{address!r} is no address of a controller: give serial:PORT or usb:VID:PID (hexadecimal)")


def _configuration(device: Any) -> Any:
    try:
        return device.get_active_configuration()
    except usb.core.USBError:  # not configured yet
        device.set_configuration()
        return device.get_active_configuration()


def _bulk_endpoint(interface: Any, direction: int) -> Any:
    return usb.util.find_descriptor(
        interface,
        custom_match=lambda endpoint: (
            usb.util.endpoint_direction(endpoint.bEndpointAddress) == direction
            and usb.util.endpoint_type(endpoint.bmAttributes) == usb.util.ENDPOINT_TYPE_BULK
        ),
    )
