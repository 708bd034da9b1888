"""The image store in C against the one in Python: any requests and restarts are answered alike, and flash is alike."""

from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from tests.firmware.c_image_store import CImageStore
from tests.simulated_device.test_flash import FailingFlash
from vibrocast.codec import CodecError
from vibrocast.device_protocol.messages import ErrorCode
from vibrocast.device_protocol.model_image import ModelImage, sha256
from vibrocast.simulated_device.flash import ImageStore
from vibrocast.simulated_device.refusal import Refusal

HARDWARE = "board"
IMAGES = (
    ModelImage(1, "old", "1", HARDWARE, bytes(range(100))).pack(),
    ModelImage(1, "new", "2", "", b"\xff\x00" * 100).pack(),
    ModelImage(1, "other's", "3", "other", b"").pack(),
    ModelImage(2, "refused", "4", "", b"").pack(),
    b"no image",
)


BLANK = b"\xff" * (2 * 128 + 2 * 1024)
UNLIMITED = 1 << 30


def check_payload(codec_identifier: int, payload: bytes) -> None:
    if codec_identifier != 1:
        raise CodecError("not for this codec")


def answer(store: Any, request: str, arguments: tuple[Any, ...]) -> Any:
    """Return the answer to a request or, where it is refused or the flash fails, the code of that."""
    try:
        return getattr(store, request)(*arguments)
    except Refusal as refusal:
        return refusal.code
    except OSError:
        return ErrorCode.FLASH_FAILED


slots = st.integers(0, 2)
requests = st.one_of(
    st.tuples(st.just("begin"), st.tuples(slots, st.sampled_from(IMAGES), st.sampled_from(["", HARDWARE, "other"]))),
    st.tuples(st.just("write"), st.tuples(slots, st.sampled_from(IMAGES), st.integers(0, 400), st.integers(1, 400))),
    st.tuples(st.just("flash"), st.tuples(slots, st.sampled_from(IMAGES))),
    st.tuples(st.sampled_from(["verify", "activate", "confirm", "boot"]), st.tuples(slots)),
    st.tuples(st.just("fail"), st.tuples(st.integers(0, 4))),
    st.tuples(st.just("damage"), st.tuples(st.integers(0, 2303), st.integers(0, 255))),
)


def steps(request: str, arguments: tuple[Any, ...]) -> list[tuple[str, tuple[Any, ...]]]:
    """Return the requests of the store that a drawn one stands for."""
    if request == "begin":
        slot, image, hardware = arguments
        return [("begin", (slot, len(image), sha256(image), hardware))]
    if request == "write":
        slot, image, offset, count = arguments
        return [("write", (slot, offset, image[offset : offset + count]))]
    if request == "flash":
        slot, image = arguments
        begin = ("begin", (slot, len(image), sha256(image), ""))
        return [begin, ("write", (slot, 0, image)), ("verify", (slot,)), ("activate", (slot,)), ("boot", ())]
    return [(request, arguments)]


@settings(max_examples=200)
@given(st.lists(requests, max_size=12))
def test_any_requests_and_restarts_are_answered_alike(drawn: list[tuple[str, tuple[Any, ...]]]) -> None:
    flashes = [FailingFlash(BLANK, UNLIMITED) for _ in range(2)]
    kinds: tuple[Any, Any] = (ImageStore, CImageStore)
    stores = [kind(flash, HARDWARE, check_payload) for kind, flash in zip(kinds, flashes, strict=True)]
    for request, arguments in [step for pair in drawn for step in steps(*pair)]:
        if request == "damage":
            address, mask = arguments
            for flash in flashes:
                flash.changes = UNLIMITED
                flash.program(address, bytes([mask]))
        if request == "fail":
            for flash in flashes:
                flash.changes = arguments[0]
            continue
        # What breaks in flash is noticed at a boot.
        if request in ("boot", "damage"):
            stores = [kind(flash, HARDWARE, check_payload) for kind, flash in zip(kinds, flashes, strict=True)]
        else:
            in_python, in_c = (answer(store, request, arguments) for store in stores)
            assert in_c == in_python
        in_python, in_c = stores
        assert in_c.describe() == in_python.describe()
        assert (in_c.running, in_c.running_sha256) == (in_python.running, in_python.running_sha256)
        assert flashes[0].read(0, len(flashes[0])) == flashes[1].read(0, len(flashes[1]))
