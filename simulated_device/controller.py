"""The simulated controller: firmware/src/controller in this process, with a clock, flash and an actuator in Python."""

from collections.abc import Callable
from dataclasses import dataclass
from threading import Event
from typing import Any

import numpy as np

from vibrocast import extras
from vibrocast.device_protocol.model_image import SIGNED_MESSAGE_BYTES
from vibrocast.firmware import keys, native_core
from vibrocast.output.actuator import PIEZO_STACK, Actuator, Codes
from vibrocast.output.rendering import actuator_structure
from vibrocast.simulated_device.callbacks import Callbacks
from vibrocast.simulated_device.decoders import PythonDecoders
from vibrocast.simulated_device.flash import FlashMemory, FlashPort

BUILD = "simulated controller 0.1.0"
FLASH_BYTES = 2056 * 1024  # two sectors of state, two slots of 1 MiB

_MAX_READ_BYTES = 1 << 14


@dataclass(frozen=True)
class Settings:
    """The kind of controller.

    `drift_ppm`: how much faster than true time its clock runs. `runtime`: the one of codec.RUNTIMES that decodes models
    which leave the choice; None = as the image says. `position_sensor`: returns the position of the hand, in nm, at the
    controller's time, in us; None = the host sends it. The other numbers are the limits in the response to Hello:
    `channels` at most 16; `buffer_samples`, `capture_samples` and `profile_samples` (of a height profile, of all
    channels together) at most these. `public_key`: of Ed25519, 32 bytes; model images need its signature, which the
    extra [keys] verifies, None = they need none. `serial_number`: at most 31 bytes, empty = none.
    """

    actuator: Actuator = PIEZO_STACK
    hardware: str = "simulated"
    serial_number: str = ""
    drift_ppm: int = 0
    runtime: str | None = None
    channels: int = 8
    buffer_samples: int = 1 << 15
    capture_samples: int = 1 << 19
    watchdog_ms: int = 2000
    profile_samples: int = 1 << 16
    position_sensor: Callable[[int], int] | None = None
    public_key: bytes | None = None


class Controller:
    """A simulated controller.

    Call `receive` with bytes from the host, and `advance` every few milliseconds. Both take a clock in microseconds
    that never goes back. Send the bytes that `transmit` returns. `on_dac` is called with each run of codes int16 (n,
    channels) as they go to the DAC. No bytes from the host raise an exception; memory does not grow with time or with
    their number.

    `flash`: None = a blank one that lasts as long as this object. Exceptions of the flash (PowerCut), of `on_dac` and
    of the position sensor pass through the method that was called; the controller is then without power. `firmware`:
    declarations (FFI) and functions of a build with other sizes, None = the installed one. `output_fault`: while it is
    set, the output reports a fault. Raises ValueError for settings that no controller can have, and MissingExtraError.
    """

    def __init__(
        self,
        settings: Settings | None = None,
        flash: FlashMemory | None = None,
        on_dac: Callable[[Codes], None] | None = None,
        firmware: tuple[Any, Any] | None = None,
    ) -> None:
        self.settings = settings or Settings()
        ffi, self._library = firmware or (native_core.ffi, native_core.library())
        self._callbacks = Callbacks(ffi)
        self._decoders = PythonDecoders(ffi, self._library, self.settings.runtime, self._callbacks)
        self.memory_bytes: int = self._library.vc_controller_size()
        # Pages that nobody writes take no memory.
        self._memory = np.zeros(-(-self.memory_bytes // 8), np.int64)
        self._profile = np.zeros(-(-self._library.vc_controller_profile_size() // 8), np.int64)
        self._controller = ffi.cast("vc_controller *", self._memory.ctypes.data)
        self._sent = bytearray(_MAX_READ_BYTES)
        self._sent_pointer = ffi.from_buffer(self._sent)
        self._origin_us: int | None = None
        self._time_us = 0
        flash_port = FlashPort(ffi, flash or FlashMemory(FLASH_BYTES), self._callbacks)
        fields = self._settings_fields(ffi)
        made = ffi.new("vc_controller_settings *", fields)
        play = self._callbacks.make("void(void *, const int16_t *, uint32_t, unsigned, uint64_t)", _play(ffi, on_dac))
        self.output_fault = fault = Event()
        failed = self._callbacks.make("int(void *)", lambda context: fault.is_set(), 0)
        dac = ffi.new("vc_dac_port *", {"play": play, "has_failed": failed})
        self._kept = flash_port, fields, made, play, failed, dac
        status = self._library.vc_controller_init(self._controller, made, flash_port.pointer, dac, self._time_us)
        self._callbacks.pass_on()
        if status:
            reason: Any = ffi.string(self._library.vc_status_text(status))
            raise ValueError(reason.decode())

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host."""
        behind = self._library.vc_controller_receive(self._controller, data, len(data), self._clock(now_us))
        self._catch_up(behind)

    def advance(self, now_us: int) -> None:
        """Play the samples that are due, and run the watchdog."""
        self._catch_up(self._library.vc_controller_advance(self._controller, self._clock(now_us)))

    def _catch_up(self, behind: int) -> None:
        """Let the controller take turns until no work is left, as its time does not pass meanwhile."""
        while behind and not self._callbacks.raised:
            behind = self._library.vc_controller_advance(self._controller, self._time_us)
        self._callbacks.pass_on()

    def transmit(self) -> bytes:
        """Return the bytes to send to the host, once."""
        moved = self._library.vc_controller_transmit(self._controller, self._sent_pointer, len(self._sent))
        return bytes(self._sent[:moved])

    def _clock(self, now_us: int) -> int:
        """Return the controller's own time, which drifts."""
        if self._origin_us is None:
            self._origin_us = now_us
        true_us = now_us - self._origin_us
        self._time_us = max(self._time_us, true_us + true_us * self.settings.drift_ppm // 1_000_000)
        return self._time_us

    def _settings_fields(self, ffi: Any) -> dict[str, Any]:
        """Return the fields of vc_controller_settings, which point to memory that must be kept."""
        settings = self.settings
        self._actuator = actuator_structure(settings.actuator)
        limits = settings.channels, settings.buffer_samples, settings.capture_samples, settings.profile_samples
        fields = {
            "build": ffi.new("char[]", BUILD.encode()),
            "hardware": ffi.new("char[]", settings.hardware.encode()),
            "actuator": ffi.cast("vc_actuator *", int(native_core.ffi.cast("uintptr_t", self._actuator))),
            "watchdog_ms": settings.watchdog_ms,
            "profile": ffi.cast("vc_profile *", self._profile.ctypes.data),
            "sizes": ffi.new("vc_sizes *", limits),
            "callbacks": self._decoders.pointer,
        }
        if settings.serial_number:
            fields["serial_number"] = ffi.new("char[]", settings.serial_number.encode())
        if settings.public_key is not None:
            fields["public_key"] = ffi.new("uint8_t[32]", settings.public_key)
            fields["verify_signature"] = signature_verifier(ffi, self._callbacks)
        if settings.position_sensor is not None:
            read = settings.position_sensor
            fields["position"] = self._callbacks.make("vc_position_sensor", lambda context, now_us: read(now_us), 0)
        return fields


def signature_verifier(ffi: Any, callbacks: Callbacks) -> Any:
    """Return a vc_signature_verifier, settings.h, by the package cryptography. Raises MissingExtraError."""
    extras.require("keys", "cryptography")

    def verify(context: Any, public_key: Any, signature: Any, message: Any) -> bool:
        parts = (signature, keys.SIGNATURE_BYTES), (public_key, keys.KEY_BYTES), (message, SIGNED_MESSAGE_BYTES)
        return keys.is_signed(*(bytes(ffi.buffer(part, length)) for part, length in parts))

    return callbacks.make("vc_signature_verifier", verify, 0)


def _play(ffi: Any, on_dac: Callable[[Codes], None] | None) -> Callable[..., None]:
    """Return the function of vc_dac_port that passes codes to `on_dac`."""

    def hand_on(context: Any, codes: Any, samples: int, channels: int, due_us: int) -> None:
        if on_dac is not None:
            on_dac(np.frombuffer(ffi.buffer(codes, 2 * samples * channels), np.int16).reshape(-1, channels).copy())

    return hand_on
