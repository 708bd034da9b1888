"""Model images in flash: power cuts at every write, writes of every size, broken images and flash, signatures, wear.

The conformance suite states the requests, their answers and their errors.
"""

import copy
import errno
import itertools
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.firmware.c_image_store import CImageStore, RequestError
from tests.simulated_device.bench import Bench, stream
from vibrocast.device_protocol.messages import (
    Error,
    ErrorCode,
    FlashActivate,
    FlashBegin,
    FlashConfirm,
    FlashData,
    FlashVerify,
    Hello,
    HelloResponse,
    SlotState,
    State,
)
from vibrocast.device_protocol.model_image import ModelImage, sha256, signed_message, with_signature
from vibrocast.firmware import native_core
from vibrocast.firmware.keys import public_key, sign
from vibrocast.simulated_device import controller
from vibrocast.simulated_device.flash import FlashMemory, PowerCut

OLD = ModelImage(1, "old", "1", "sim", bytes(range(100))).pack()
NEW = ModelImage(1, "new", "2", "", b"\xff\x00" * 300 + b"\xff" * 40).pack()
ENTRY_BYTES = 92  # firmware/src/controller/vc_slot_record.h
PRIVATE_KEY = bytes(range(32))
KEY = public_key(PRIVATE_KEY)


def blank_flash(path: Path | None = None, sector_bytes: int = 128, write_bytes: int = 1) -> FlashMemory:
    # Sectors small enough that every byte of a session can be a place to cut.
    return FlashMemory(2 * sector_bytes + 2 * 768, sector_bytes, path, write_bytes)


def boot(flash: FlashMemory, key: bytes = b"") -> CImageStore:
    return CImageStore(flash, key)


def signed(image: bytes, number: int, private_key: bytes = PRIVATE_KEY) -> bytes:
    return with_signature(image, number, sign(private_key, signed_message(image, number)))


def write_image(store: CImageStore, slot: int, image: bytes) -> None:
    _, offset = store.begin(slot, len(image), sha256(image))
    while offset < len(image):
        _, offset = store.write(slot, offset, image[offset : offset + 100])
    assert store.verify(slot)[0] == SlotState.VERIFIED


def install(flash: FlashMemory, slot: int, image: bytes, key: bytes = b"") -> CImageStore:
    store = boot(flash, key)
    write_image(store, slot, image)
    store.activate(slot)
    store = boot(flash, key)
    store.confirm(slot)
    return store


def activated() -> tuple[FlashMemory, CImageStore]:
    """Return a flash with OLD confirmed in slot 0 and NEW activated in slot 1, and its store, not booted since."""
    flash = blank_flash()
    store = install(flash, 0, OLD)
    write_image(store, 1, NEW)
    assert store.activate(1)[0] == SlotState.TESTING
    return flash, store


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sector_bytes", "entries_before", "write_bytes"),
    [*itertools.product([128, 256], range(6), [1]), *itertools.product([256], range(4), [2, 4, 8, 16, 32])],
)
def test_power_cut_at_every_write_of_a_flash_session_leaves_an_image_that_runs(
    sector_bytes: int, entries_before: int, write_bytes: int
) -> None:
    """The session begins at each place of the record, and so crosses from one sector into the other everywhere.

    A cut falls between two writes or into the middle of one. The flash fails where a place is programmed twice.
    """
    installed = blank_flash(sector_bytes=sector_bytes, write_bytes=write_bytes)
    install(installed, 0, OLD)
    for number in range(entries_before):
        boot(installed).begin(1, 100, bytes([number] * 32))
    cut_after_bytes = 0
    names = set()
    while True:
        flash = copy.deepcopy(installed)
        flash.cut_after_bytes = cut_after_bytes
        try:
            install(flash, 1, NEW)
        except PowerCut:
            pass
        else:
            break
        flash.cut_after_bytes = None
        store = boot(flash)
        # Before the trial begins the old image runs; from then on the new one, and it falls back unless confirmed.
        confirmed, on_trial = (store.states[1] == state for state in (SlotState.CONFIRMED, SlotState.TESTING))
        assert store.running == ("new" if confirmed or on_trial else "old")
        assert boot(flash).running == ("new" if confirmed else "old")
        if not confirmed:
            assert install(flash, 1, NEW).running == "new"
        names.add(store.running)
        cut_after_bytes += max(1, write_bytes // 2)
    assert cut_after_bytes > 768 + len(NEW)
    assert names == {"old", "new"}


def flip_bit(flash: FlashMemory, slot: int) -> None:
    """Let a bit of the image in a slot go wrong."""
    address = 2 * 128 + slot * 768 + 61
    assert flash.contents[address] > 0
    flash.contents[address] &= flash.contents[address] - 1


def test_image_that_breaks_before_its_trial_is_never_confirmed() -> None:
    flash = blank_flash()
    store = install(flash, 0, OLD)
    write_image(store, 1, NEW)
    flip_bit(flash, 1)
    store.activate(1)
    store = boot(flash)
    assert (store.running, store.states) == ("old", [SlotState.CONFIRMED, SlotState.EMPTY])
    with pytest.raises(RequestError, match="does not run"):
        store.confirm(1)
    assert boot(flash).running == "old"


def test_slot_on_trial_is_confirmed_only_while_it_runs() -> None:
    flash, store = activated()
    with pytest.raises(RequestError, match="does not run"):
        store.confirm(1)
    store = boot(flash)
    assert store.confirm(1)[0] == SlotState.CONFIRMED
    assert store.confirm(1)[0] == SlotState.CONFIRMED


@pytest.mark.parametrize("key", [b"", KEY])
def test_confirmed_image_that_breaks_falls_back_to_the_one_before_of_the_same_release(key: bytes) -> None:
    flash = blank_flash()
    install(flash, 0, signed(OLD, 4), key)
    install(flash, 1, signed(NEW, 4), key)
    flip_bit(flash, 1)
    for _ in range(2):
        store = boot(flash, key)
        assert (store.running, store.states) == ("old", [SlotState.CONFIRMED, SlotState.EMPTY])
    flip_bit(flash, 0)
    store = boot(flash, key)
    assert (store.running, store.states) == ("", [SlotState.EMPTY, SlotState.EMPTY])


def test_first_image_whose_trial_was_not_confirmed_does_not_run() -> None:
    flash = blank_flash()
    store = boot(flash)
    write_image(store, 0, OLD)
    assert boot(flash).running == ""
    store.activate(0)
    assert boot(flash).running == "old"
    assert boot(flash).running == ""


class FailingFlash(FlashMemory):
    """Flash that takes nothing more after `changes` erasures and writes."""

    def __init__(self, before: FlashMemory, changes: int) -> None:
        self.__dict__.update(copy.deepcopy(before.__dict__))
        self.changes = changes

    def erase(self, address: int, count: int) -> None:
        self._count()
        super().erase(address, count)

    def program(self, address: int, data: bytes) -> None:
        self._count()
        super().program(address, data)

    def _count(self) -> None:
        self.changes -= 1
        if self.changes < 0:
            raise OSError("flash takes nothing")


@pytest.mark.parametrize("changes", [0, 1])
def test_flash_that_fails_while_confirming_keeps_the_slot_to_fall_back_to(changes: int) -> None:
    failing = FailingFlash(activated()[0], 2)
    store = boot(failing)
    assert store.running == "new"
    failing.changes = changes
    with pytest.raises(RequestError, match="flash did not take"):
        store.confirm(1)
    failing.changes = 1 << 30
    assert store.states == [SlotState.CONFIRMED, SlotState.TESTING]
    with pytest.raises(RequestError, match="is being tested"):
        store.begin(0, len(NEW), sha256(NEW))
    assert boot(failing).running == "old"


@pytest.mark.parametrize("changes", [0, 1])
def test_flash_that_fails_at_a_boot_runs_what_is_confirmed(changes: int) -> None:
    failing = FailingFlash(activated()[0], changes)
    assert boot(failing).running == "old"
    failing.changes = 1 << 30
    assert boot(failing).running == "new"


@pytest.mark.parametrize("write_bytes", [1, 2, 4, 8, 16, 32])
def test_flash_takes_data_in_whole_writes_and_the_last_one_filled_up(write_bytes: int) -> None:
    flash = blank_flash(write_bytes=write_bytes)
    store = boot(flash)
    store.begin(0, len(NEW), sha256(NEW))
    assert store.write(0, 0, NEW[:50]) == (SlotState.WRITING, 50 // write_bytes * write_bytes)
    assert store.begin(0, len(NEW), sha256(NEW))[1] == 50 // write_bytes * write_bytes
    write_image(store, 0, NEW)
    assert store.read(0, 0, len(NEW)) == (len(NEW), NEW)


@pytest.mark.parametrize("is_cut", [True, False])
def test_a_slot_whose_writing_failed_is_erased_before_it_takes_data_again(is_cut: bool) -> None:
    """Otherwise a place that is half written would be written twice."""
    flash = FailingFlash(blank_flash(write_bytes=8), 4)
    store = boot(flash)
    store.begin(0, len(NEW), sha256(NEW))
    assert store.write(0, 0, NEW[:400])[1] == 400
    flash.cut_after_bytes, flash.changes = (100, 9) if is_cut else (None, 0)
    with pytest.raises(PowerCut if is_cut else RequestError):
        store.write(0, 400, NEW[400:])
    flash.cut_after_bytes, flash.changes = None, 99
    if is_cut:
        store = boot(flash)
    with pytest.raises(RequestError, match="begin with FlashBegin") as rejected:
        store.write(0, 400, NEW[400:])
    assert rejected.value.code == ErrorCode.WRONG_STATE
    with pytest.raises(RequestError, match="begin with FlashBegin"):
        store.verify(0)
    write_image(store, 0, NEW)
    assert store.states[0] == SlotState.VERIFIED


def test_an_erased_slot_has_nothing_of_its_image() -> None:
    flash = blank_flash()
    store = install(flash, 0, OLD)
    write_image(store, 1, NEW)
    assert store.erase(1) == (SlotState.EMPTY, 0)
    assert flash.read(len(flash) - 768, 768) == b"\xff" * 768
    assert boot(flash).running == "old"


def test_flash_lives_in_its_file(tmp_path: Path) -> None:
    path = tmp_path / "flash.bin"
    install(blank_flash(path), 0, OLD)
    assert boot(blank_flash(path)).running == "old"
    with pytest.raises(ValueError, match="delete it"):
        FlashMemory(100, path=path)


def test_garbage_in_flash_boots_without_an_image() -> None:
    flash = blank_flash()
    flash.program(0, bytes(len(flash)))
    store = boot(flash)
    assert store.running == ""
    assert install(flash, 0, OLD).running == "old"


# ---- signatures ----


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (NEW, "has no signature"),
        (signed(NEW, 3, bytes(32)), "not by this controller's key"),
        (with_signature(NEW, 3, bytes(64)), "not by this controller's key"),
        (with_signature(NEW, 4, signed(NEW, 3)[-64:]), "not by this controller's key"),
        (with_signature(NEW, 3, signed(OLD, 3)[-64:]), "not by this controller's key"),
        (signed(NEW, 2), "number 2, and 3 was confirmed"),
        (signed(NEW, 0), "number 0, and 3 was confirmed"),
    ],
)
def test_controller_with_a_key_rejects_other_images(image: bytes, reason: str) -> None:
    flash = blank_flash()
    store = install(flash, 0, signed(OLD, 3), KEY)
    with pytest.raises(RequestError, match=reason) as rejected:
        write_image(store, 1, image)
    assert rejected.value.code == ErrorCode.IMAGE_REJECTED
    assert store.states == [SlotState.CONFIRMED, SlotState.EMPTY]
    assert boot(flash, KEY).running == "old"


@pytest.mark.slow
def test_every_changed_bit_of_a_signed_image_is_rejected() -> None:
    """Even where the host announces the hash of the changed image."""
    image = signed(OLD, 3)
    store = boot(blank_flash(), KEY)
    for bit in range(8 * len(image)):
        changed = (int.from_bytes(image, "little") ^ 1 << bit).to_bytes(len(image), "little")
        with pytest.raises(RequestError) as rejected:
            write_image(store, 0, changed)
        assert rejected.value.code in (ErrorCode.IMAGE_REJECTED, ErrorCode.WRONG_STATE)
        if rejected.value.code == ErrorCode.WRONG_STATE:
            store = boot(blank_flash(), KEY)


@pytest.mark.parametrize("number", [3, 4, 0xFFFFFFFF])
def test_controller_with_a_key_runs_what_it_signed_with_equal_and_later_numbers(number: int) -> None:
    flash = blank_flash()
    store = install(flash, 0, signed(OLD, 3), KEY)
    assert (store.running, store.running_sha256, store.numbers[0]) == ("old", sha256(OLD), 3)
    assert install(flash, 1, signed(NEW, number), KEY).running == "new"
    assert boot(flash, KEY).running == "new"


def test_only_confirming_raises_the_lowest_number() -> None:
    flash = blank_flash()
    install(flash, 0, signed(OLD, 3), KEY)
    store = boot(flash, KEY)
    write_image(store, 1, signed(NEW, 9))
    store.activate(1)
    assert boot(flash, KEY).running == "new"
    store = boot(flash, KEY)  # reverts
    assert store.running == "old"
    write_image(store, 1, signed(NEW, 4))


def test_image_from_before_the_last_release_is_neither_activated_nor_fallen_back_to() -> None:
    flash = blank_flash()
    install(flash, 0, signed(OLD, 3), KEY)
    store = install(flash, 1, signed(NEW, 4), KEY)
    assert store.states == [SlotState.VERIFIED, SlotState.CONFIRMED]
    with pytest.raises(RequestError, match="number 3, and 4 was confirmed"):
        store.activate(0)
    flip_bit(flash, 1)
    store = boot(flash, KEY)
    assert (store.running, store.states) == ("", [SlotState.VERIFIED, SlotState.EMPTY])
    assert install(flash, 1, signed(NEW, 4), KEY).running == "new"


def test_a_key_in_new_firmware_ends_unsigned_images() -> None:
    flash = blank_flash()
    install(flash, 0, OLD)
    store = boot(flash, KEY)
    assert (store.running, store.states) == ("", [SlotState.EMPTY, SlotState.EMPTY])


def test_without_a_key_signed_images_run_and_their_numbers_bind_nothing() -> None:
    flash = blank_flash()
    store = install(flash, 0, signed(OLD, 9, bytes(32)))
    assert store.numbers == [9, 0]
    assert install(flash, 1, signed(NEW, 2)).running == "new"
    assert install(flash, 0, signed(OLD, 1), KEY).running == "old"


# ---- wear ----


class CountingFlash(FlashMemory):
    """Flash that counts the erasures of the record's two sectors and of the two slots, three sectors each."""

    def __init__(self, sector_bytes: int) -> None:
        super().__init__(8 * sector_bytes, sector_bytes)
        self.erased = [0, 0, 0, 0]

    def erase(self, address: int, count: int) -> None:
        sector = address // self.sector_bytes
        self.erased[sector if sector < 2 else 2 + (sector - 2) // 3] += 1
        super().erase(address, count)


@pytest.mark.parametrize("entries", [1, 2, 5])
def test_record_is_erased_once_for_as_many_changes_as_it_holds(entries: int) -> None:
    flash = CountingFlash(entries * ENTRY_BYTES + (ENTRY_BYTES - 1 if entries == 5 else 0))
    store = boot(flash)
    for number in range(60):
        store.begin(0, 1, number.to_bytes(32, "little"))
        assert boot(flash).states[0] == SlotState.WRITING
    assert abs(sum(flash.erased[:2]) - 60 / entries) <= 1
    assert abs(flash.erased[0] - flash.erased[1]) <= 1


def test_slot_that_is_erased_already_is_not_erased_again() -> None:
    flash = CountingFlash(512)
    store = boot(flash)
    with pytest.raises(RequestError, match="an image of 0 bytes"):
        store.begin(0, 0, bytes(32))
    for number in range(20):
        store.begin(0, 1, number.to_bytes(32, "little"))
    assert sum(flash.erased[2:]) == 1
    store.write(0, 0, b"x")
    store.begin(0, 1, bytes(32))
    assert sum(flash.erased[2:]) == 2


def test_hostile_host_wears_out_nothing_between_two_power_ons() -> None:
    flash = CountingFlash(512)
    store = boot(flash)
    with pytest.raises(RequestError, match="switch the controller off and on") as rejected:
        for number in range(3000):
            store.begin(0, 1, number.to_bytes(32, "little"))
            store.write(0, 0, b"x")
    assert rejected.value.code == ErrorCode.WRONG_STATE
    assert flash.erased[2:] == [1001, 0]  # the first erasure needs one change of the record, the others two
    assert sum(flash.erased[:2]) == -(-2001 // (512 // ENTRY_BYTES))
    boot(flash).begin(0, 1, bytes(32))


def test_erasing_wears_out_nothing_either() -> None:
    flash = CountingFlash(512)
    store = boot(flash)
    for _ in range(10):
        store.erase(0)
    assert flash.erased[2:] == [1, 0]
    with pytest.raises(RequestError, match="switch the controller off and on"):
        for _ in range(3000):
            store.begin(0, 1, bytes(32))
            store.erase(0)
    assert flash.erased[2:] == [1, 0]


def test_boots_by_a_host_count_as_changes_too() -> None:
    flash = CountingFlash(512)
    store = install(flash, 0, OLD)
    write_image(store, 1, OLD)
    with pytest.raises(RequestError, match="switch the controller off and on"):
        for number in range(3000):
            slot = 1 - number % 2
            store.activate(slot)
            store.boot_again()
            store.confirm(slot)
    assert 600 < number < 700
    assert boot(flash).running == "old"


def test_torn_entries_are_stepped_over() -> None:
    flash = blank_flash(sector_bytes=4 * ENTRY_BYTES)
    install(flash, 0, OLD)
    for cut_after_bytes in range(1, 3 * ENTRY_BYTES, 7):
        flash.cut_after_bytes = cut_after_bytes
        with pytest.raises(PowerCut):
            for number in range(20):
                boot(flash).begin(1, 1, bytes([number] * 32))
        flash.cut_after_bytes = None
        assert boot(flash).running == "old"
    assert install(flash, 1, NEW).running == "new"


def test_a_board_without_flash_lists_no_slot_and_plays(monkeypatch: pytest.MonkeyPatch) -> None:
    without = SimpleNamespace(pointer=native_core.ffi.NULL)
    monkeypatch.setattr(controller, "FlashPort", lambda *_: without)
    bench, played = Bench(), stream(0.2)
    hello = bench.ask(Hello())
    assert isinstance(hello, HelloResponse) and hello.images == ()
    for slot in (0, 2):
        requests = (
            FlashBegin(slot, 10, bytes(32), ""),
            FlashData(slot, 0, b"data"),
            *(request(slot) for request in (FlashVerify, FlashActivate, FlashConfirm)),
        )
        for request in requests:
            answer = bench.ask(request)
            assert isinstance(answer, Error) and answer.code == ErrorCode.NO_SUCH_SLOT
    bench.start_all(played)
    bench.run(500)
    assert bench.status().state == State.FINISHED


def test_a_full_disk_leaves_no_half_of_a_new_flash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(path: Path, data: bytes) -> int:
        path.touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", fill)
    with pytest.raises(OSError, match="No space left"):
        FlashMemory(100, path=tmp_path / "flash")
    assert not list(tmp_path.iterdir())
