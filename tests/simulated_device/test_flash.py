"""Model images in flash: trial, fall back, the power cut at every byte."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.firmware.c_image_store import CImageStore, RequestError
from vibrocast.codec import CodecError
from vibrocast.device_protocol.messages import ErrorCode, SlotState
from vibrocast.device_protocol.model_image import ModelImage, sha256
from vibrocast.simulated_device.flash import FlashMemory, PowerCut

HARDWARE = "sim"
OLD = ModelImage(1, "old", "1", HARDWARE, bytes(range(100))).pack()
NEW = ModelImage(1, "new", "2", "", b"\xff\x00" * 300 + b"\xff" * 40).pack()


def blank_flash(path: Path | None = None) -> FlashMemory:
    # Sectors small enough that every byte of a session can be a place to cut.
    return FlashMemory(2 * 128 + 2 * 768, sector_bytes=128, path=path)


def check_payload(codec_identifier: int, payload: bytes) -> None:
    if codec_identifier != 1 or payload.startswith(b"corrupt"):
        raise CodecError("tables that the codec does not take")


def boot(flash: FlashMemory) -> CImageStore:
    return CImageStore(flash, HARDWARE, check_payload)


def write_image(store: CImageStore, slot: int, image: bytes) -> None:
    offset = store.begin(slot, len(image), sha256(image), HARDWARE).next_offset
    while offset < len(image):
        offset = store.write(slot, offset, image[offset : offset + 100]).next_offset
    assert store.verify(slot).sha256 == sha256(image)


def install(flash: FlashMemory, slot: int, image: bytes) -> CImageStore:
    store = boot(flash)
    write_image(store, slot, image)
    store.activate(slot)
    store = boot(flash)
    store.confirm(slot)
    return store


def running_name(store: CImageStore) -> str:
    return store.running.name if store.running else ""


def test_trial_runs_once_and_falls_back_unless_confirmed() -> None:
    flash = blank_flash()
    store = install(flash, 0, OLD)
    assert running_name(store) == "old"
    write_image(store, 1, NEW)
    assert store.activate(1).state == SlotState.TESTING
    store = boot(flash)
    assert running_name(store) == "new"
    assert [image.state for image in store.describe()] == [SlotState.CONFIRMED, SlotState.TESTING]
    store = boot(flash)
    assert running_name(store) == "old"
    assert [image.state for image in store.describe()] == [SlotState.CONFIRMED, SlotState.VERIFIED]
    store.activate(1)
    store = boot(flash)
    assert store.confirm(1).state == SlotState.CONFIRMED
    store = boot(flash)
    assert running_name(store) == "new"
    assert [image.state for image in store.describe()] == [SlotState.VERIFIED, SlotState.CONFIRMED]
    assert [image.name for image in store.describe()] == ["old", "new"]


@pytest.mark.slow
def test_power_cut_at_every_byte_of_a_flash_session_leaves_an_image_that_runs() -> None:
    installed = blank_flash()
    install(installed, 0, OLD)
    contents = installed.read(0, len(installed))
    cut_after_bytes = 0
    names = set()
    while True:
        flash = blank_flash()
        flash.program(0, contents)
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
        confirmed = store.describe()[1].state == SlotState.CONFIRMED
        on_trial = store.describe()[1].state == SlotState.TESTING
        assert running_name(store) == ("new" if confirmed or on_trial else "old")
        assert running_name(boot(flash)) == ("new" if confirmed else "old")
        if not confirmed:
            assert running_name(install(flash, 1, NEW)) == "new"
        names.add(running_name(store))
        cut_after_bytes += 1
    assert cut_after_bytes > 768 + len(NEW)
    assert names == {"old", "new"}


def flip_bit(flash: FlashMemory, slot: int) -> None:
    """Let a bit of the image in a slot go wrong."""
    address = 2 * 128 + slot * 768 + 61
    value = flash.read(address, 1)[0]
    flash.program(address, bytes([value & (value - 1)]))
    assert flash.read(address, 1)[0] != value


def states(store: CImageStore) -> list[SlotState]:
    return [image.state for image in store.describe()]


def test_image_that_breaks_before_its_trial_is_never_confirmed() -> None:
    flash = blank_flash()
    store = install(flash, 0, OLD)
    write_image(store, 1, NEW)
    flip_bit(flash, 1)
    store.activate(1)
    store = boot(flash)
    assert (running_name(store), states(store)) == ("old", [SlotState.CONFIRMED, SlotState.EMPTY])
    with pytest.raises(RequestError, match="does not run"):
        store.confirm(1)
    assert running_name(boot(flash)) == "old"


def test_slot_on_trial_is_confirmed_only_while_it_runs() -> None:
    flash = blank_flash()
    store = install(flash, 0, OLD)
    write_image(store, 1, NEW)
    store.activate(1)
    with pytest.raises(RequestError, match="does not run"):
        store.confirm(1)
    store = boot(flash)
    assert store.confirm(1).state == SlotState.CONFIRMED
    assert store.confirm(1).state == SlotState.CONFIRMED


def test_confirmed_image_that_breaks_falls_back_to_the_one_before() -> None:
    flash = blank_flash()
    install(flash, 0, OLD)
    install(flash, 1, NEW)
    flip_bit(flash, 1)
    for _ in range(2):
        store = boot(flash)
        assert (running_name(store), states(store)) == ("old", [SlotState.CONFIRMED, SlotState.EMPTY])
    flip_bit(flash, 0)
    store = boot(flash)
    assert (store.running, states(store)) == (None, [SlotState.EMPTY, SlotState.EMPTY])


def test_first_image_whose_trial_was_not_confirmed_does_not_run() -> None:
    flash = blank_flash()
    store = boot(flash)
    write_image(store, 0, OLD)
    assert boot(flash).running is None
    store.activate(0)
    assert running_name(boot(flash)) == "old"
    assert boot(flash).running is None


class FailingFlash(FlashMemory):
    """Flash that takes nothing more after `changes` erasures and writes."""

    def __init__(self, contents: bytes, changes: int) -> None:
        super().__init__(len(contents), sector_bytes=128)
        super().program(0, contents)
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
    flash = blank_flash()
    store = install(flash, 0, OLD)
    write_image(store, 1, NEW)
    store.activate(1)
    failing = FailingFlash(flash.read(0, len(flash)), 2)
    store = boot(failing)
    assert running_name(store) == "new"
    failing.changes = changes
    with pytest.raises(RequestError, match="flash did not take"):
        store.confirm(1)
    failing.changes = 1 << 30
    assert states(store) == [SlotState.CONFIRMED, SlotState.TESTING]
    with pytest.raises(RequestError, match="fall back"):
        store.begin(0, len(NEW), sha256(NEW), "")
    assert running_name(boot(failing)) == "old"


@pytest.mark.parametrize("changes", [0, 1])
def test_flash_that_fails_at_a_boot_runs_what_is_confirmed(changes: int) -> None:
    flash = blank_flash()
    store = install(flash, 0, OLD)
    write_image(store, 1, NEW)
    store.activate(1)
    failing = FailingFlash(flash.read(0, len(flash)), changes)
    assert running_name(boot(failing)) == "old"
    failing.changes = 1 << 30
    assert running_name(boot(failing)) == "new"


def test_an_interrupted_session_resumes_where_it_was() -> None:
    flash = blank_flash()
    store = boot(flash)
    store.begin(0, len(NEW), sha256(NEW), "")
    flash.cut_after_bytes = 500
    with pytest.raises(PowerCut):
        store.write(0, 0, NEW)
    flash.cut_after_bytes = None
    store = boot(flash)
    resumed = store.begin(0, len(NEW), sha256(NEW), "")
    assert 0 < resumed.next_offset <= 500
    write_image(store, 0, NEW)
    assert store.describe()[0].state == SlotState.VERIFIED


def test_flash_lives_in_its_file(tmp_path: Path) -> None:
    path = tmp_path / "flash.bin"
    install(blank_flash(path), 0, OLD)
    assert running_name(boot(blank_flash(path))) == "old"
    with pytest.raises(ValueError, match="delete it"):
        FlashMemory(100, path=path)


def test_garbage_in_flash_boots_without_an_image() -> None:
    flash = blank_flash()
    flash.program(0, bytes(len(flash)))
    store = boot(flash)
    assert store.running is None
    assert running_name(install(flash, 0, OLD)) == "old"


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        (lambda store: store.begin(2, 10, bytes(32), ""), ErrorCode.NO_SUCH_SLOT),
        (lambda store: store.begin(0, 10, bytes(32), ""), ErrorCode.WRONG_STATE),
        (lambda store: store.begin(1, 10, bytes(32), "other"), ErrorCode.WRONG_HARDWARE),
        (lambda store: store.begin(1, 10_000, bytes(32), ""), ErrorCode.BEYOND_LIMITS),
        (lambda store: store.begin(1, 0, bytes(32), ""), ErrorCode.BEYOND_LIMITS),
        (lambda store: store.write(1, 0, b"x"), ErrorCode.WRONG_STATE),
        (lambda store: store.verify(1), ErrorCode.WRONG_STATE),
        (lambda store: store.activate(1), ErrorCode.WRONG_STATE),
        (lambda store: store.confirm(1), ErrorCode.WRONG_STATE),
        (
            lambda store: (store.begin(1, 10, bytes(32), ""), store.write(1, 0, bytes(11))),
            ErrorCode.BAD_VALUE,
        ),
        (
            lambda store: (store.begin(1, 10, bytes(32), ""), store.write(1, 0, bytes(10)), store.verify(1)),
            ErrorCode.IMAGE_REJECTED,
        ),
    ],
)
def test_requests_that_are_rejected(request_: Callable[[CImageStore], object], code: ErrorCode) -> None:
    store = install(blank_flash(), 0, OLD)
    with pytest.raises(RequestError) as rejected:
        request_(store)
    assert rejected.value.code == code
    assert running_name(store) == "old"


@pytest.mark.parametrize(
    "image",
    [
        ModelImage(9, "a", "1", "", b"").pack(),
        ModelImage(1, "a", "1", "other", b"").pack(),
        b"not an image",
        ModelImage(1, "a", "1", "", b"corrupt tables").pack(),
    ],
)
def test_image_of_another_kind_is_rejected_and_the_slot_is_empty(image: bytes) -> None:
    store = boot(blank_flash())
    with pytest.raises(RequestError):
        write_image(store, 0, image)
    assert store.describe()[0].state == SlotState.EMPTY


def test_data_at_another_offset_writes_nothing() -> None:
    store = boot(blank_flash())
    store.begin(0, len(NEW), sha256(NEW), "")
    assert store.write(0, 50, NEW[50:100]).next_offset == 0
    assert store.write(0, 0, NEW[:50]).next_offset == 50
    assert store.write(0, 0, NEW[:50]).next_offset == 50
