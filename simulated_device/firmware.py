"""The controller's firmware in C, in this process: bytes and time in, bytes and DAC codes out, as for any device."""

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from cffi import FFI

from vibrocast.firmware.build import build
from vibrocast.output.actuator import Codes
from vibrocast.output.actuator_constants import constants
from vibrocast.simulated_device.controller import FLASH_BYTES, Settings
from vibrocast.simulated_device.flash import SLOTS, FlashMemory

BUILD = "vibrocast firmware 0.1.0"
_LONGEST_READ_BYTES = 1 << 16


@cache
def _loaded(path: Path) -> tuple[Any, Any]:
    """Load a build of the firmware; return its declarations (FFI) and its functions, those of controller.h."""
    ffi = FFI()
    ffi.cdef(path.with_suffix(".cdef").read_text())
    return ffi, ffi.dlopen(str(path))


class Firmware:
    """A tactor controller, as simulated_device.controller.Controller is one: see there.

    Its sizes are compiled in: those of the settings, and further `sizes` of firmware/controller/sizes.h, are built on
    demand and kept (firmware.build). Raises ValueError for a runtime other than the integer core, the one that it has,
    and firmware.build.BuildError. A PowerCut of the flash passes through the method that was called; the controller is
    then without power. `memory_bytes`: all that it keeps.
    """

    def __init__(
        self,
        settings: Settings | None = None,
        flash: FlashMemory | None = None,
        on_dac: Callable[[Codes], None] | None = None,
        sizes: Mapping[str, int] | None = None,
    ) -> None:
        self.settings = settings or Settings()
        if self.settings.runtime not in (None, "core"):
            raise ValueError(f"the firmware decodes by the integer core, not by {self.settings.runtime}")
        settings_sizes = {
            "VC_CHANNELS": self.settings.channels,
            "VC_BUFFER_SAMPLES": self.settings.buffer_samples,
            "VC_CAPTURE_SAMPLES": self.settings.capture_samples,
            "VC_PROFILE_SAMPLES": self.settings.profile_samples,
        }
        ffi, self._library = _loaded(build("native", settings_sizes | dict(sizes or {})))
        self._raised: list[BaseException] = []
        self._flash = _FlashPort(ffi, flash or FlashMemory(FLASH_BYTES), self._raised)
        self._sink = ffi.callback("vc_dac_sink", _sink(ffi, on_dac, self._raised))
        self._texts = [ffi.new("char[]", text.encode()) for text in (BUILD, self.settings.hardware)]
        self._actuator = ffi.new("vc_actuator *", constants(self.settings.actuator))
        self._profile = ffi.new("int64_t[]", self._library.vc_controller_profile_size() // 8)
        self._sensor = ffi.NULL
        if self.settings.position_sensor is not None:
            self._sensor = ffi.callback("vc_position_sensor", _sensor(self.settings.position_sensor, self._raised))
        self._settings = ffi.new(
            "vc_controller_settings *",
            (
                *self._texts,
                self._actuator,
                self.settings.watchdog_ms,
                ffi.cast("vc_profile *", self._profile),
                self._sensor,
            ),
        )
        self.memory_bytes: int = self._library.vc_controller_size()
        self._memory = np.zeros(-(-self.memory_bytes // 8), np.int64)
        self._controller = ffi.cast("vc_controller *", self._memory.ctypes.data)
        self._origin_us: int | None = None
        self._time_us = 0
        self._sent = bytearray(_LONGEST_READ_BYTES)
        self._sent_pointer = ffi.from_buffer(self._sent)
        self._library.vc_controller_init(
            self._controller, self._settings, self._flash.pointer, self._sink, ffi.NULL, self._time_us
        )
        self._pass_on()

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host."""
        self._library.vc_controller_receive(self._controller, data, len(data), self._clock(now_us))
        self._pass_on()

    def advance(self, now_us: int) -> None:
        """Play what is due, and watch over the host."""
        self._library.vc_controller_advance(self._controller, self._clock(now_us))
        self._pass_on()

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

    def _pass_on(self) -> None:
        """Raise what a callback has raised."""
        if self._raised:
            raise self._raised[0]


def _sensor(read: Callable[[int], int], raised: list[BaseException]) -> Callable[[Any, int], int]:
    def position_nm(context: Any, now_us: int) -> int:
        try:
            return 0 if raised else read(now_us)
        except BaseException as error:
            raised.append(error)
            return 0

    return position_nm


def _sink(ffi: Any, on_dac: Callable[[Codes], None] | None, raised: list[BaseException]) -> Callable[..., None]:
    def put_out(context: Any, codes: Any, samples: int, channels: int) -> None:
        if on_dac is not None and not raised:
            try:
                on_dac(np.frombuffer(ffi.buffer(codes, 2 * samples * channels), np.int16).reshape(-1, channels).copy())
            except BaseException as error:
                raised.append(error)

    return put_out


class _FlashPort:
    """What the firmware sees of a FlashMemory: vc_flash. What it raises, but for OSError, goes into `raised`."""

    def __init__(self, ffi: Any, flash: FlashMemory, raised: list[BaseException]) -> None:
        def guarded(change: Callable[..., None], *arguments: Any) -> int:
            if raised:
                return -1
            try:
                change(*arguments)
            except OSError:
                return -1
            except BaseException as error:
                raised.append(error)
                return -1
            return 0

        def erase(context: Any, offset: int, length: int) -> int:
            return guarded(flash.erase, offset, length)

        def program(context: Any, offset: int, data: Any, length: int) -> int:
            return guarded(flash.program, offset, bytes(ffi.buffer(data, length)))

        sector_bytes = flash.sector_bytes
        slot_bytes = (len(flash) // sector_bytes - 2) // SLOTS * sector_bytes
        self._kept = (
            ffi.from_buffer(flash.contents),
            ffi.callback("int(void *, uint32_t, uint32_t)", erase),
            ffi.callback("int(void *, uint32_t, const uint8_t *, uint32_t)", program),
        )
        base, erase_callback, program_callback = self._kept
        self.pointer = ffi.new(
            "vc_flash *",
            {
                "base": base,
                "record": [0, sector_bytes],
                "record_bytes": sector_bytes,
                "slot": [2 * sector_bytes, 2 * sector_bytes + slot_bytes],
                "slot_bytes": slot_bytes,
                "erase": erase_callback,
                "program": program_callback,
            },
        )
