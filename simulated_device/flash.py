"""Flash memory in a file, and the slots for model images in it: whenever the power goes, an image that runs is left."""

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vibrocast.codec import CodecError
from vibrocast.device_protocol.messages import ErrorCode, FlashStatus, ImageDescription, SlotState
from vibrocast.device_protocol.model_image import ModelImage, ModelImageError, sha256
from vibrocast.simulated_device.refusal import Refusal

SLOTS = 2
ERASED = 0xFF


class PowerCut(Exception):
    """The power went while flash was being written; raised only where a test asks for it."""


class FlashMemory:
    """NOR flash: erasing a sector sets its bytes to 0xFF, programming only clears bits.

    Kept in the file `path`, or in memory only if there is none. `cut_after_bytes`: raise PowerCut once so many more
    bytes have been erased or programmed, the next one half done; None = never. Raises OSError if the file cannot be
    used and ValueError if it has another size.
    """

    def __init__(self, size_bytes: int, sector_bytes: int = 4096, path: Path | None = None) -> None:
        self.sector_bytes = sector_bytes
        self.cut_after_bytes: int | None = None
        self._path = path
        self._data = bytearray([ERASED]) * size_bytes
        if path is not None and path.exists():
            self._data = bytearray(path.read_bytes())
            if len(self._data) != size_bytes:
                raise ValueError(f"{path} has {len(self._data)} bytes, not the {size_bytes} of this flash: delete it")
        elif path is not None:
            path.write_bytes(self._data)

    def __len__(self) -> int:
        return len(self._data)

    @property
    def contents(self) -> memoryview:
        """All bytes, in place; what is written here does not go to the file."""
        return memoryview(self._data)

    def read(self, address: int, count: int) -> bytes:
        """Return `count` bytes from `address` on."""
        return bytes(self._data[address : address + count])

    def erase(self, address: int, count: int) -> None:
        """Erase whole sectors: `address` and `count` are multiples of the sector size."""
        self._change(address, bytes([ERASED]) * count, lambda byte, _: byte | 0xF0)

    def program(self, address: int, data: bytes) -> None:
        """Clear the bits that are 0 in `data`."""
        old = self.read(address, len(data))
        after = (np.frombuffer(old, np.uint8) & np.frombuffer(data, np.uint8)).tobytes()
        self._change(address, after, lambda byte, after: byte & (after | 0x0F))

    def _change(self, address: int, after: bytes, half_done: Callable[[int, int], int]) -> None:
        """Change bytes, up to a cut; `half_done` gives what a byte is in the middle of it, from before and after."""
        done = len(after)
        if self.cut_after_bytes is not None:
            done = min(done, self.cut_after_bytes)
            self.cut_after_bytes -= done
        cut = done < len(after)
        changed = after
        if cut:
            changed = after[:done] + bytes([half_done(self._data[address + done], after[done])])
        if self._path is not None:
            with self._path.open("r+b") as file:
                file.seek(address)
                file.write(changed)
        self._data[address : address + len(changed)] = changed
        if cut:
            raise PowerCut


@dataclass(frozen=True)
class _Slot:
    """What the record says of a slot. `booted`: a slot on trial has been started once."""

    LAYOUT = struct.Struct("<BBI32s")

    state: SlotState = SlotState.EMPTY
    booted: bool = False
    size_bytes: int = 0
    sha256: bytes = bytes(32)


class ImageStore:
    """Two slots for model images, and the record of their states.

    The record is kept twice, in the first two sectors, each copy with a counter and a CRC-32; a change erases and
    writes the older copy, so a cut leaves either the record before or the one after. A slot is erased and written only
    while the record calls it empty or in writing, and neither the slot that runs nor the one to fall back to is.
    """

    _RECORD = struct.Struct(f"<4sI{SLOTS * _Slot.LAYOUT.size}sI")
    _MAGIC = b"VCFS"
    # Data is programmed again from a multiple of this on after a cut, over bytes that may be half done.
    _PAGE_BYTES = 256

    def __init__(self, flash: FlashMemory, hardware: str, check_payload: Callable[[int, bytes], None]) -> None:
        """Boot: start a slot that was put on trial, or fall back from one whose trial was not confirmed.

        `check_payload` raises CodecError where the codec of a number cannot use an image's payload.
        """
        self._flash = flash
        self._hardware = hardware
        self._check_payload = check_payload
        self.slot_bytes = (len(flash) // flash.sector_bytes - 2) // SLOTS * flash.sector_bytes
        self._counter, self._slots = self._read_record()
        self.running: ModelImage | None = None
        self.running_sha256 = b""
        self._running_slot: int | None = None
        self._boot()

    def describe(self) -> tuple[ImageDescription, ...]:
        """Return what each slot holds, as hello tells it."""
        descriptions = []
        for number, slot in enumerate(self._slots):
            image = self._image(number) if slot.state not in (SlotState.EMPTY, SlotState.WRITING) else None
            name, version = (image.name, image.version) if image else ("", "")
            descriptions.append(ImageDescription(number, slot.state, slot.sha256, name, version))
        return tuple(descriptions)

    def begin(self, number: int, size_bytes: int, digest: bytes, hardware: str) -> FlashStatus:
        """Make a slot ready for an image, or go on with the one that it is taking. Raises Refusal."""
        slot = self._slot(number)
        if number == self._running_slot or slot.state == SlotState.CONFIRMED:
            raise Refusal(ErrorCode.WRONG_STATE, f"slot {number} runs or is the one to fall back to: use the other")
        if hardware not in ("", self._hardware):
            raise Refusal(ErrorCode.WRONG_HARDWARE, f"the image is for {hardware}, this controller is {self._hardware}")
        if not 0 < size_bytes <= self.slot_bytes:
            raise Refusal(
                ErrorCode.BEYOND_LIMITS, f"an image of {size_bytes} bytes; a slot holds 1 to {self.slot_bytes}"
            )
        wanted = _Slot(SlotState.WRITING, False, size_bytes, digest)
        if slot != wanted:
            self._set({number: _Slot()})
            self._flash.erase(self._address(number), self.slot_bytes)
            self._set({number: wanted})
        return self._status(number)

    def write(self, number: int, offset: int, data: bytes) -> FlashStatus:
        """Program data at the offset that is next; at any other, write nothing. Raises Refusal."""
        slot = self._slot_in(number, SlotState.WRITING, "begin with FlashBegin")
        if offset == self._next_offset(number):
            if offset + len(data) > slot.size_bytes:
                raise Refusal(
                    ErrorCode.BAD_VALUE, f"data up to byte {offset + len(data)} of an image of {slot.size_bytes} bytes"
                )
            self._flash.program(self._address(number) + offset, data)
            self._written[number] = offset + len(data)
        return self._status(number)

    def verify(self, number: int) -> FlashStatus:
        """Read the slot back and check all of it; an image that is refused leaves the slot empty. Raises Refusal."""
        slot = self._slot_in(number, SlotState.WRITING, "there is nothing new to verify")
        try:
            data = self._flash.read(self._address(number), slot.size_bytes)
            if sha256(data) != slot.sha256:
                raise ModelImageError("what was written has another SHA-256 than announced: flash it again")
            image = ModelImage.unpack(data)
            if image.hardware not in ("", self._hardware):
                raise ModelImageError(f"the image is for {image.hardware}, this controller is {self._hardware}")
            self._check_payload(image.codec_identifier, image.payload)
        except (ModelImageError, CodecError) as error:
            self._set({number: _Slot()})
            raise Refusal(ErrorCode.IMAGE_REFUSED, str(error)) from error
        self._set({number: replace(slot, state=SlotState.VERIFIED)})
        return self._status(number)

    def activate(self, number: int) -> FlashStatus:
        """Put a verified slot on trial at the next boot. Raises Refusal."""
        slot = self._slot_in(number, SlotState.VERIFIED, "verify it first")
        if any(other.state == SlotState.TRIAL for other in self._slots):
            raise Refusal(ErrorCode.WRONG_STATE, "another slot is on trial: confirm it, or restart to fall back")
        self._set({number: replace(slot, state=SlotState.TRIAL)})
        return self._status(number)

    def confirm(self, number: int) -> FlashStatus:
        """Keep the slot that runs on trial; the one confirmed before becomes verified. Raises Refusal."""
        slot = self._slot(number)
        if number != self._running_slot:
            raise Refusal(ErrorCode.WRONG_STATE, f"slot {number} does not run: only what has been tried can be kept")
        if slot.state == SlotState.TRIAL:
            changes = {
                other: replace(before, state=SlotState.VERIFIED)
                for other, before in enumerate(self._slots)
                if before.state == SlotState.CONFIRMED
            }
            self._set(changes | {number: replace(slot, state=SlotState.CONFIRMED, booted=False)})
        return self._status(number)

    def _boot(self) -> None:
        """Start what is on trial for the first time, or else what is confirmed; note what turned out to be broken."""
        self._written = [self._programmed_bytes(number) for number in range(SLOTS)]
        changes: dict[int, _Slot] = {}
        for number, slot in enumerate(self._slots):
            if slot.state in (SlotState.TRIAL, SlotState.CONFIRMED) and self._image(number) is None:
                changes[number] = _Slot()
                spare = self._whole(SlotState.VERIFIED)
                if slot.state == SlotState.CONFIRMED and spare is not None:
                    changes[spare] = replace(self._slots[spare], state=SlotState.CONFIRMED)
            elif slot.state == SlotState.TRIAL and slot.booted:
                changes[number] = replace(slot, state=SlotState.VERIFIED, booted=False)
            elif slot.state == SlotState.TRIAL:
                changes[number] = replace(slot, booted=True)
        startable = [SlotState.TRIAL, SlotState.CONFIRMED]
        try:
            if changes:
                self._set(changes)
        except OSError:
            startable.remove(SlotState.TRIAL)  # without a record of it, the trial would never end
        for state in startable:
            running = self._whole(state)
            if running is not None:
                self.running, self.running_sha256 = self._image(running), self._slots[running].sha256
                self._running_slot = running
                return

    def _whole(self, state: SlotState) -> int | None:
        """Return a slot in this state whose image is whole."""
        whole = (n for n, slot in enumerate(self._slots) if slot.state == state and self._image(n) is not None)
        return next(whole, None)

    def _image(self, number: int) -> ModelImage | None:
        """Return the image in a slot if it is whole."""
        slot = self._slots[number]
        data = self._flash.read(self._address(number), slot.size_bytes)
        try:
            return ModelImage.unpack(data) if sha256(data) == slot.sha256 else None
        except ModelImageError:
            return None

    def _slot(self, number: int) -> _Slot:
        if not 0 <= number < SLOTS:
            raise Refusal(ErrorCode.NO_SUCH_SLOT, f"there is no slot {number}; slots are 0 to {SLOTS - 1}")
        return self._slots[number]

    def _slot_in(self, number: int, state: SlotState, hint: str) -> _Slot:
        slot = self._slot(number)
        if slot.state != state:
            raise Refusal(ErrorCode.WRONG_STATE, f"slot {number} is {slot.state.name.lower()}: {hint}")
        return slot

    def _status(self, number: int) -> FlashStatus:
        slot = self._slots[number]
        verified = slot.state not in (SlotState.EMPTY, SlotState.WRITING)
        return FlashStatus(number, slot.state, self._next_offset(number), slot.sha256 if verified else bytes(32))

    def _next_offset(self, number: int) -> int:
        return self._written[number] if self._slots[number].state == SlotState.WRITING else 0

    def _address(self, number: int) -> int:
        return 2 * self._flash.sector_bytes + number * self.slot_bytes

    def _programmed_bytes(self, number: int) -> int:
        """Return where to go on after a boot: the start of the last page that is not blank."""
        data = self._flash.read(self._address(number), self._slots[number].size_bytes)
        last = len(data.rstrip(bytes([ERASED]))) - 1
        return max(0, last) // self._PAGE_BYTES * self._PAGE_BYTES

    def _set(self, changes: dict[int, _Slot]) -> None:
        """Change slots' states, all at once: in the record first, so that a flash that fails changes nothing."""
        slots = [changes.get(number, slot) for number, slot in enumerate(self._slots)]
        counter = self._counter + 1
        packed = b"".join(_Slot.LAYOUT.pack(s.state, s.booted, s.size_bytes, s.sha256) for s in slots)
        head = self._RECORD.pack(self._MAGIC, counter, packed, 0)[:-4]
        address = counter % 2 * self._flash.sector_bytes
        self._flash.erase(address, self._flash.sector_bytes)
        self._flash.program(address, head + zlib.crc32(head).to_bytes(4, "little"))
        self._counter, self._slots = counter, slots
        for number, slot in changes.items():
            if slot.state == SlotState.EMPTY:
                self._written[number] = 0

    def _read_record(self) -> tuple[int, list[_Slot]]:
        newest: tuple[int, list[_Slot]] = (0, [_Slot()] * SLOTS)
        for copy in range(2):
            data = self._flash.read(copy * self._flash.sector_bytes, self._RECORD.size)
            magic, counter, packed, crc = self._RECORD.unpack(data)
            if magic == self._MAGIC and crc == zlib.crc32(data[:-4]) and counter > newest[0]:
                slots = [
                    _Slot(SlotState(state), bool(booted), min(size_bytes, self.slot_bytes), digest)
                    for state, booted, size_bytes, digest in _Slot.LAYOUT.iter_unpack(packed)
                ]
                newest = (counter, slots)
        return newest
