"""A simulated USB device with a controller in it, as a backend for pyusb."""

import array
import errno
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.real_time import PERIOD_S, RealTimePort

# The identifiers that pid.codes reserves for tests: no real product has them.
VENDOR_ID = 0x1209
PRODUCT_ID = 0x0001
ENDPOINT_OUT = 0x01
ENDPOINT_IN = 0x81
MAXIMUM_PACKET_BYTES = 64

_CONFIGURATION = 1
_BULK = 0x02
_VENDOR_CLASS = 0xFF
_GET_DESCRIPTOR, _STRING = 6, 3
_ENGLISH = bytes((0x09, 0x04))  # the only language of the strings
_SERIAL_NUMBER = 3


class _Descriptor(SimpleNamespace):
    """The fields of a descriptor; missing ones are 0."""

    def __getattr__(self, name: str) -> int:
        return 0


class UsbPort(RealTimePort, usb.backend.IBackend):  # type: ignore[misc]
    """A bus with one device: a controller behind a vendor interface with one bulk IN and one bulk OUT endpoint.

    Pass it to `usb.core.find(backend=...)`. Its errors are libusb's: timeout 110, stall 32, no device 19; IndexError
    for a missing descriptor. A handle counts how often the cable had been pulled before it was opened.
    `serial_number`: in the device descriptor; empty = none.
    """

    def __init__(self, controller: Device, serial_number: str = "") -> None:
        super().__init__(controller)
        self._strings = {_SERIAL_NUMBER: serial_number} if serial_number else {}
        self._plugged = True
        self._pulled = 0
        self._configuration = 0
        self._halted: set[int] = set()
        self._busy_until_s = 0.0

    def plug(self) -> None:
        """Plug the device in again."""
        self._plugged = True

    def unplug(self) -> None:
        """Pull the cable. The controller runs on."""
        with self._lock:
            self._plugged = False
            self._pulled += 1
            self._configuration = 0
            self._halted.clear()
            self._pending = b""

    def stall(self) -> None:
        """Halt both bulk endpoints: each stalls until `clear_halt` or a reset."""
        self._halted = {ENDPOINT_IN, ENDPOINT_OUT}

    def keep_busy(self, seconds: float) -> None:
        """Neither take nor give data for `seconds`: transfers wait, and time out. The controller runs on."""
        self._busy_until_s = time.monotonic() + seconds

    def _wait(self) -> bytes:
        self._closing.wait(PERIOD_S)
        return b""

    def enumerate_devices(self) -> Iterator[str]:
        """Yield the devices on the bus."""
        if self._plugged:
            yield "controller"

    def get_parent(self, device: str) -> None:
        """Return the hub: none."""

    def get_device_descriptor(self, device: str) -> _Descriptor:
        """Return the device descriptor (USB 2.0, 9.6.1)."""
        return _Descriptor(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x0200,
            bMaxPacketSize0=64,
            idVendor=VENDOR_ID,
            idProduct=PRODUCT_ID,
            bcdDevice=0x0100,
            iSerialNumber=max(self._strings, default=0),
            bNumConfigurations=1,
            address=1,
            bus=1,
            port_number=1,
            port_numbers=(1,),
            speed=2,
        )

    def get_configuration_descriptor(self, device: str, configuration: int) -> _Descriptor:
        """Return the configuration descriptor (USB 2.0, 9.6.3)."""
        _only_first(configuration)
        return _Descriptor(
            bLength=9,
            bDescriptorType=2,
            wTotalLength=32,
            bNumInterfaces=1,
            bConfigurationValue=_CONFIGURATION,
            bmAttributes=0x80,
            bMaxPower=250,
            extra_descriptors=[],
        )

    def get_interface_descriptor(self, device: str, interface: int, alternate: int, configuration: int) -> _Descriptor:
        """Return the interface descriptor (USB 2.0, 9.6.5)."""
        _only_first(interface, alternate, configuration)
        return _Descriptor(
            bLength=9,
            bDescriptorType=4,
            bNumEndpoints=2,
            bInterfaceClass=_VENDOR_CLASS,
            extra_descriptors=[],
        )

    def get_endpoint_descriptor(
        self, device: str, endpoint: int, interface: int, alternate: int, configuration: int
    ) -> _Descriptor:
        """Return an endpoint descriptor (USB 2.0, 9.6.6)."""
        _only_first(interface, alternate, configuration)
        return _Descriptor(
            bLength=7,
            bDescriptorType=5,
            bEndpointAddress=(ENDPOINT_OUT, ENDPOINT_IN)[endpoint],
            bmAttributes=_BULK,
            wMaxPacketSize=MAXIMUM_PACKET_BYTES,
            extra_descriptors=[],
        )

    def open_device(self, device: str) -> int:
        """Return a handle."""
        self._need_device(self._pulled)
        return self._pulled

    def close_device(self, handle: int) -> None:
        """Forget a handle."""

    def set_configuration(self, handle: int, value: int) -> None:
        """Choose the configuration of this value."""
        self._need_device(handle)
        self._configuration = value

    def get_configuration(self, handle: int) -> int:
        """Return the value of the chosen configuration, 0 = none yet."""
        self._need_device(handle)
        return self._configuration

    def set_interface_altsetting(self, handle: int, interface: int, alternate: int) -> None:
        """Choose an alternate setting: there is one."""
        self._need_device(handle)
        _only_first(interface, alternate)

    def claim_interface(self, handle: int, interface: int) -> None:
        """Take the interface."""
        self._need_device(handle)
        _only_first(interface)

    def release_interface(self, handle: int, interface: int) -> None:
        """Give the interface back."""
        self._need_device(handle)

    def is_kernel_driver_active(self, handle: int, interface: int) -> bool:
        """Return whether a kernel driver holds the interface: never."""
        return False

    def clear_halt(self, handle: int, endpoint: int) -> None:
        """End a stall of an endpoint."""
        self._need_device(handle)
        self._halted.discard(endpoint)

    def reset_device(self, handle: int) -> None:
        """Reset the device's USB side."""
        self._need_device(handle)
        self._halted.clear()

    def ctrl_transfer(
        self, handle: int, request_type: int, request: int, value: int, index: int, data: Any, timeout_ms: int
    ) -> int:
        """Fill `data` with a string descriptor (USB 2.0, 9.6.7); stall at any other request. Return its length."""
        self._need_device(handle)
        kind, number = divmod(value, 256)
        if (request_type, request, kind) == (0x80, _GET_DESCRIPTOR, _STRING) and (
            number == 0 or number in self._strings
        ):
            text = self._strings[number].encode("utf-16-le") if number else _ENGLISH
            descriptor = bytes((2 + len(text), _STRING)) + text
            data[: len(descriptor)] = array.array("B", descriptor[: len(data)])
            return min(len(descriptor), len(data))
        raise usb.core.USBError("Pipe error", None, errno.EPIPE)

    def bulk_write(self, handle: int, endpoint: int, interface: int, data: Any, timeout_ms: int) -> int:
        """Send bytes to the controller; return their number."""
        deadline_s = time.monotonic() + timeout_ms / 1000
        self._need_endpoint(handle, endpoint, ENDPOINT_OUT)
        while time.monotonic() < self._busy_until_s:
            self._wait_for_endpoint(timeout_ms, deadline_s)
            self._need_endpoint(handle, endpoint, ENDPOINT_OUT)
        self._exchange(bytes(data))
        return len(data)

    def bulk_read(self, handle: int, endpoint: int, interface: int, buffer: Any, timeout_ms: int) -> int:
        """Fill `buffer` with bytes from the controller; return their number. A timeout of 0 waits for ever."""
        deadline_s = time.monotonic() + timeout_ms / 1000
        while True:
            self._need_endpoint(handle, endpoint, ENDPOINT_IN)
            taken = b""
            if time.monotonic() >= self._busy_until_s:
                with self._lock:
                    if not self._pending:
                        self._pending = self._controller.transmit()
                    taken, self._pending = self._pending[: len(buffer)], self._pending[len(buffer) :]
            if taken:
                buffer[: len(taken)] = array.array("B", taken)
                return len(taken)
            self._wait_for_endpoint(timeout_ms, deadline_s)

    def _wait_for_endpoint(self, timeout_ms: int, deadline_s: float) -> None:
        if timeout_ms and time.monotonic() >= deadline_s:
            raise usb.core.USBTimeoutError("Operation timed out", None, errno.ETIMEDOUT)
        self._closing.wait(PERIOD_S / 5)

    def _need_endpoint(self, handle: int, endpoint: int, wanted: int) -> None:
        self._need_device(handle)
        if endpoint != wanted or endpoint in self._halted:
            raise usb.core.USBError("Pipe error", None, errno.EPIPE)

    def _need_device(self, handle: int) -> None:
        if not self._plugged or handle != self._pulled or self._closing.is_set():
            raise usb.core.USBError("No such device (it may have been disconnected)", None, errno.ENODEV)


def _only_first(*indices: int) -> None:
    if any(indices):
        raise IndexError("there is only one descriptor of each kind")
