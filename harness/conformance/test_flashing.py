"""Model upload: transfer, resumption, checks, test, confirmation, and rejections."""

import zlib
from collections.abc import Iterable
from dataclasses import replace

import pytest

from vibrocast import codec
from vibrocast.codec.stream import image_hash
from vibrocast.device_protocol.messages import (
    CaptureRead,
    Error,
    ErrorCode,
    FlashActivate,
    FlashBegin,
    FlashConfirm,
    FlashContents,
    FlashData,
    FlashErase,
    FlashRead,
    FlashStatus,
    FlashVerify,
    HelloResponse,
    ImageDescription,
    Message,
    SlotState,
    Start,
    State,
    Status,
    StatusRequest,
    Stop,
    Tap,
    pack,
)
from vibrocast.device_protocol.model_image import ModelImage, sha256, with_signature
from vibrocast.harness.conformance.fixtures import section
from vibrocast.harness.conformance.probe import NotConforming, Probe, an_error, describe, in_state, same_samples
from vibrocast.harness.conformance.streams import (
    decoded,
    known_actuator,
    lasting_stream,
    model,
    need_capture,
    need_no_signature,
    need_since,
    stream_for,
)
from vibrocast.host.devices import description_of
from vibrocast.output.actuator_constants import image as actuator_image

_REQUESTS_OF_AN_UPLOAD = 7
_NO_SLOTS = (0x7F, 0xFF)
_NAME = 13  # where an image's name begins


@pytest.fixture
def image(hello: HelloResponse, unsigned_image: ModelImage) -> ModelImage:
    """A model image that the controller takes; skip the test where that needs a signature."""
    need_no_signature(hello)
    return unsigned_image


@pytest.fixture
def unsigned_image(hello: HelloResponse) -> ModelImage:
    """A model image for a codec of the controller; skip the test where no image is known for any."""
    learned = ModelImage.unpack(model().image)
    for number, name in hello.codecs:
        known = codec.BUILT_IN.get(name)
        if known is not None and known.tables is not None and known.tables.built_in is not None:
            return ModelImage(number, "conformance", "1", hello.hardware, known.tables.built_in())
        if number == learned.codec_identifier:
            return replace(learned, hardware=hello.hardware)
    pytest.skip("no model image is known for any codec of the controller")


def begin(probe: Probe, slot: int, data: bytes, hardware: str = "", digest: bytes | None = None) -> FlashStatus:
    """Announce an image."""
    announced = sha256(data) if digest is None else digest
    return probe.expect(FlashBegin(slot, len(data), announced, hardware), FlashStatus)


def write(probe: Probe, slot: int, data: bytes, first: int = 0, last: int | None = None) -> None:
    """Write an image from one byte up to another, in whole writes of any flash: `first`, `last` are multiples of 32."""
    room = (probe.description.limits.max_payload_bytes - len(pack(FlashData(slot, 0, b"")))) // 32 * 32
    last = len(data) if last is None else last
    while first < last:
        piece = data[first : min(last, first + room)]
        status = probe.expect(FlashData(slot, first, piece), FlashStatus)
        first += len(piece)
        if status.next_offset != first:
            raise NotConforming(f"FlashData up to byte {first}: expected next_offset {first}, came {describe(status)}")


def verify(probe: Probe, slot: int, data: bytes) -> None:
    """Write a whole image and have it read back."""
    begin(probe, slot, data)
    write(probe, slot, data)
    status = probe.expect(FlashVerify(slot), FlashStatus)
    expected = replace(status, slot=slot, state=SlotState.VERIFIED, sha256=sha256(data))
    if status != expected:
        raise NotConforming(f"FlashVerify: expected {describe(expected)}, came {describe(status)}")


def described(probe: Probe, slot: int) -> ImageDescription:
    """Return what the controller says of a slot."""
    probe.open()
    return next(image for image in probe.description.images if image.slot == slot)


def new_image(probe: Probe, image: ModelImage) -> bytes:
    """Return an image that no slot holds."""
    held = {description.sha256 for description in probe.description.images}
    packed = (replace(image, version=str(version)).pack() for version in range(1, 10))
    return next(data for data in packed if sha256(data) not in held)


@section("Messages: Error codes")
def test_slots_that_are_not_there(probe: Probe) -> None:
    """The controller answers NO_SUCH_SLOT to every request for an absent slot."""
    there = {image.slot for image in probe.description.images}
    for slot in set(_NO_SLOTS) - there:
        requests: tuple[Message, ...] = (
            FlashBegin(slot, 100, bytes(32), ""),
            FlashData(slot, 0, b"data"),
            FlashVerify(slot),
            FlashActivate(slot),
            FlashConfirm(slot),
            FlashErase(slot),
            FlashRead(slot, 0, 1),
        )
        for request in known_to(probe, requests):
            probe.expect_rejection(request, ErrorCode.NO_SUCH_SLOT)


@section("Model upload: FlashBegin")
def test_image_for_other_hardware_is_rejected(probe: Probe, slot: int) -> None:
    """The controller answers WRONG_HARDWARE to a FlashBegin for other hardware. It accepts its own id and none."""
    hardware = probe.description.hardware
    for other in (f"not {hardware}", hardware + "x", hardware[:-1]):
        if other:
            probe.expect_rejection(FlashBegin(slot, 100, bytes(32), other), ErrorCode.WRONG_HARDWARE)
    for digest, fitting in ((b"\x01" * 32, hardware), (b"\x02" * 32, "")):
        status = probe.expect(FlashBegin(slot, 100, digest, fitting), FlashStatus)
        assert (status.state, status.next_offset) == (SlotState.WRITING, 0), (
            f"expected to begin, came {describe(status)}"
        )


@section("Messages: Error codes")
def test_image_larger_than_a_slot_is_rejected(probe: Probe, slot: int) -> None:
    """The controller answers BEYOND_LIMITS to a FlashBegin with a size beyond every slot."""
    probe.expect_rejection(FlashBegin(slot, 0xFFFFFFFF, bytes(32), ""), ErrorCode.BEYOND_LIMITS)


@section("Model upload: FlashData")
def test_data_at_another_offset_is_not_written(probe: Probe, slot: int) -> None:
    """The controller writes no FlashData at an offset other than next_offset, and answers with next_offset."""
    data = bytes(range(200))
    begin(probe, slot, data)
    write(probe, slot, data, last=64)
    for offset in (0, 63, 65, 128, 0xFFFFFFFF):
        status = probe.expect(FlashData(slot, offset, data[64:96]), FlashStatus)
        assert status.next_offset == 64, f"data at {offset}: expected next_offset 64, came {describe(status)}"


@section("Model upload: FlashData")
def test_data_beyond_the_image_is_rejected(probe: Probe, slot: int) -> None:
    """The controller answers BAD_VALUE to FlashData beyond the announced size, and does not write them."""
    data = bytes(range(100))
    begin(probe, slot, data)
    write(probe, slot, data, last=64)
    probe.expect_rejection(FlashData(slot, 64, bytes(37)), ErrorCode.BAD_VALUE)
    write(probe, slot, data, first=64)


@section("Model upload")
def test_slot_in_the_wrong_state(probe: Probe, slot: int, image: ModelImage) -> None:
    """The controller answers WRONG_STATE to a request that the slot's state excludes."""
    begin(probe, slot, b"some image")
    probe.expect_rejection(FlashActivate(slot), ErrorCode.WRONG_STATE)
    probe.expect_rejection(FlashConfirm(slot), ErrorCode.WRONG_STATE)
    verify(probe, slot, new_image(probe, image))
    probe.expect_rejection(FlashData(slot, 0, b"data"), ErrorCode.WRONG_STATE)
    probe.expect_rejection(FlashVerify(slot), ErrorCode.WRONG_STATE)
    probe.expect_rejection(FlashConfirm(slot), ErrorCode.WRONG_STATE)


@section("Model upload: FlashBegin")
def test_cut_session_is_resumed(probe: Probe, slot: int, image: ModelImage) -> None:
    """The controller resumes a cut transfer of the same image at next_offset, and begins another image at byte 0."""
    data = new_image(probe, image)
    half = len(data) // 64 * 32
    begin(probe, slot, data)
    write(probe, slot, data, last=half)
    probe.link.cut()
    found = described(probe, slot)
    assert found.state == SlotState.WRITING, f"expected a slot in writing, came {found}"
    status = begin(probe, slot, data)
    assert status.next_offset == half, f"expected to go on at byte {half}, came {describe(status)}"
    write(probe, slot, data, first=half)
    status = probe.expect(FlashVerify(slot), FlashStatus)
    assert status.sha256 == sha256(data), f"expected the hash of the image, came {describe(status)}"
    status = begin(probe, slot, data[:-1])
    assert (status.state, status.next_offset) == (SlotState.WRITING, 0), f"expected to begin, came {describe(status)}"


@section("Model upload: FlashVerify")
@pytest.mark.parametrize(
    "fault",
    [
        "another hash than announced",
        "a damaged byte",
        "a wrong CRC-32",
        "another beginning than VCMI",
        "another layout version",
        "an unknown codec",
        "another hardware id",
        "a byte missing",
        "a payload that its codec cannot use",
        "a name that is not UTF-8",
    ],
)
def test_faulty_image_is_rejected(probe: Probe, slot: int, image: ModelImage, fault: str) -> None:
    """The controller answers IMAGE_REJECTED to an image with {fault}, and empties the slot."""
    data = image.pack()
    faulty, digest = {
        "another hash than announced": (data, bytes(32)),
        "a damaged byte": (data[:100] + bytes([data[100] ^ 1]) + data[101:], sha256(data)),
        "a wrong CRC-32": (data[:-1] + bytes([data[-1] ^ 1]), None),
        "another beginning than VCMI": (with_crc(b"VCMX" + data[4:-4]), None),
        "another layout version": (with_crc(data[:4] + b"\x7f" + data[5:-4]), None),
        "an unknown codec": (replace(image, codec_identifier=unknown_codec(probe)).pack(), None),
        "another hardware id": (replace(image, hardware="other hardware").pack(), None),
        "a byte missing": (with_crc(data[:-5]), None),
        "a payload that its codec cannot use": (replace(image, payload=image.payload[:-1]).pack(), None),
        "a name that is not UTF-8": (with_crc(data[:_NAME] + b"\xff" + data[_NAME + 1 : -4]), None),
    }[fault]
    begin(probe, slot, faulty, digest=digest)
    write(probe, slot, faulty)
    probe.expect_rejection(FlashVerify(slot), ErrorCode.IMAGE_REJECTED)
    found = described(probe, slot)
    assert found.state == SlotState.EMPTY, f"expected an EMPTY slot, came {found}"


@section("Model upload: Signatures")
def test_signature_is_checked_where_hello_names_a_key(probe: Probe, slot: int, unsigned_image: ModelImage) -> None:
    """A controller with a public key rejects images without its signature; one without ignores signatures."""
    status = probe.expect(StatusRequest(), Status)
    has_key = bool(probe.description.public_key)
    assert status.signed_images == has_key, f"expected signed_images as in HelloResponse, came {describe(status)}"
    data = new_image(probe, unsigned_image)
    signed = with_signature(data, 7, b"\x01" * 64)
    if not has_key:
        verify(probe, slot, signed)
        found = described(probe, slot)
        assert (found.number, found.sha256) == (7, sha256(data)), f"expected the number 7 and the hash, came {found}"
        return
    for faulty in (data, signed):
        begin(probe, slot, faulty)
        write(probe, slot, faulty)
        probe.expect_rejection(FlashVerify(slot), ErrorCode.IMAGE_REJECTED)


@section("Model upload")
def test_upload_waits_for_the_end_of_a_stream(probe: Probe, slot: int, image: ModelImage) -> None:
    """The controller rejects the requests of an upload while a stream plays, and plays it undisturbed."""
    need_capture(probe.description)
    data = new_image(probe, image)
    stream = lasting_stream(probe, _REQUESTS_OF_AN_UPLOAD + 2, 1.0)
    begin(probe, slot, data)
    write(probe, slot, data[: len(data) // 2])
    number = probe.configure(stream).stream
    probe.feed(number, stream)
    probe.expect(Start(), Status)
    probe.wait_for_state(State.PLAYING)
    requests: tuple[Message, ...] = (
        FlashBegin(slot, len(data), sha256(data), ""),
        FlashData(slot, len(data) // 2, data[len(data) // 2 :][:1]),
        FlashVerify(slot),
        FlashActivate(slot),
        FlashConfirm(slot),
        FlashErase(slot),
        FlashRead(slot, 0, 1),
    )
    for request in known_to(probe, requests):
        probe.expect_rejection(request, ErrorCode.WRONG_STATE)
    played = probe.wait_for_state(State.FINISHED, 2.0 + 2 * stream.seconds)
    assert (played.underruns, played.lost_packets) == (0, 0), f"expected no loss, came {describe(played)}"
    first, came = probe.captured(Tap.DECODED, 1)
    same_samples(came, decoded(stream)[first:], "a stream during an upload")


@section("Model upload: FlashRead")
def test_slot_is_read_back(probe: Probe, hello: HelloResponse, slot: int, image: ModelImage) -> None:
    """The controller returns an image from any offset, nothing behind its end, and WRONG_STATE until it is VERIFIED."""
    need_since(hello, FlashRead)
    data = new_image(probe, image)
    begin(probe, slot, data)
    probe.expect_rejection(FlashRead(slot, 0, 1), ErrorCode.WRONG_STATE)
    verify(probe, slot, data)
    found = b""
    while len(found) < len(data):
        contents = probe.expect(FlashRead(slot, len(found), 0xFFFF), FlashContents)
        named = contents.slot, contents.size_bytes, contents.offset
        assert named == (slot, len(data), len(found)) and contents.data, f"came {describe(contents)}"
        found += contents.data
    assert found == data, "expected the bytes of the image, came others"
    for offset, count in ((1, 3), (len(data) - 1, 9), (len(data), 9), (0xFFFFFFFF, 9)):
        contents = probe.expect(FlashRead(slot, offset, count), FlashContents)
        assert contents.data == data[offset : offset + count], f"{count} bytes at {offset}: came {describe(contents)}"


@section("Model upload: FlashErase")
def test_slot_is_erased(probe: Probe, hello: HelloResponse, slot: int, image: ModelImage) -> None:
    """The controller empties a slot at FlashErase, and answers WRONG_STATE for the slot that runs."""
    need_since(hello, FlashErase)
    for _ in range(2):
        verify(probe, slot, new_image(probe, image))
        status = probe.expect(FlashErase(slot), FlashStatus)
        assert status == FlashStatus(slot, SlotState.EMPTY, 0), f"expected an EMPTY slot, came {describe(status)}"
        assert described(probe, slot).state == SlotState.EMPTY, f"expected it EMPTY, came {described(probe, slot)}"
    verify(probe, slot, new_image(probe, image))
    probe.expect(FlashActivate(slot), FlashStatus)
    probe.open()
    probe.expect_rejection(FlashErase(slot), ErrorCode.WRONG_STATE)


@section("Model upload: FlashActivate")
def test_image_is_tested_and_kept(probe: Probe, slot: int, image: ModelImage) -> None:
    """The controller restarts into the slot of FlashActivate (TESTING, no session), and keeps it at FlashConfirm."""
    data = new_image(probe, image)
    before = {found.slot: found for found in probe.description.images}
    probe.play(stream_for(probe.description))
    verify(probe, slot, data)
    status = probe.expect(FlashActivate(slot), FlashStatus)
    assert status.slot == slot, f"expected an answer for slot {slot}, came {describe(status)}"
    an_error(probe.insist(StatusRequest()), ErrorCode.HELLO_FIRST, "StatusRequest after the restart")
    an_error(probe.ask(FlashActivate(slot)), ErrorCode.HELLO_FIRST, "a copy of FlashActivate after the restart")
    in_state(probe.expect(Stop(), Status), State.STOPPED, "Stop before a hello")
    found = described(probe, slot)
    expected = ImageDescription(slot, SlotState.TESTING, sha256(data), image.name, ModelImage.unpack(data).version)
    assert found == expected, f"expected {expected}, came {found}"
    probe.expect_rejection(CaptureRead(Tap.DECODED, 0, 1), ErrorCode.WRONG_STATE)
    probe.expect_rejection(FlashBegin(slot, len(data), sha256(data), ""), ErrorCode.WRONG_STATE)
    status = probe.expect(FlashConfirm(slot), FlashStatus)
    assert status.state == SlotState.CONFIRMED, f"expected a CONFIRMED slot, came {describe(status)}"
    probe.open()
    after = {found.slot: found for found in probe.description.images}
    assert after[slot] == replace(expected, state=SlotState.CONFIRMED), f"expected it kept, came {after[slot]}"
    for other, found in before.items():
        if found.state == SlotState.CONFIRMED:
            expected = replace(found, state=SlotState.VERIFIED)
            assert after[other] == expected, f"expected {expected}, came {after[other]}"
    probe.expect_rejection(FlashBegin(slot, len(data), sha256(data), ""), ErrorCode.WRONG_STATE)


@section("Model upload: Model image")
def test_stream_plays_with_the_image_that_it_names(probe: Probe, slot: int, image: ModelImage) -> None:
    """The controller answers UNKNOWN_IMAGE to a stream until its model image runs, and then plays it."""
    known = codec.codec_by_identifier(image.codec_identifier)
    if known.needs_model:
        pytest.skip("the controller's codec has no built-in tables to compare with")
    need_capture(probe.description)
    stream = stream_for(probe.description, known.name)
    data = new_image(probe, image)
    named = replace(stream.header, image_hash=image_hash(data)).pack()
    answer = probe.ask(replace(probe.configuration(stream), header=named))
    an_error(answer, ErrorCode.UNKNOWN_IMAGE, "Configure before the image is flashed")
    verify(probe, slot, data)
    probe.expect(FlashActivate(slot), FlashStatus)
    probe.open()
    number = in_state(
        probe.expect(replace(probe.configuration(stream), header=named), Status), State.BUFFERING, "Configure"
    ).stream
    probe.feed(number, stream)
    probe.expect(Start(), Status)
    probe.wait_for_state(State.FINISHED, 2.0 + 2 * stream.seconds)
    first, came = probe.captured(Tap.DECODED, 1)
    same_samples(came, decoded(stream)[first:], "a stream with its image")


@section("Model upload: Actuator image")
def test_actuator_of_an_image_is_driven_within_the_limits(
    probe: Probe, slot: int, hello: HelloResponse, image: ModelImage
) -> None:
    """While an image with an actuator runs, HelloResponse describes it. One with wider limits is IMAGE_REJECTED."""
    other = next((each for each in probe.description.images if each.slot != slot), None)
    if other is None:
        pytest.skip("no other slot is there to run afterwards")
    own = known_actuator(hello.actuator)
    wider, narrower = (replace(own, name="conformance", power_limit=part * own.power_limit) for part in (2.0, 0.5))
    for actuator in (wider, narrower):
        begin(probe, slot, actuator_image(actuator))
        write(probe, slot, actuator_image(actuator))
        answer = probe.ask(FlashVerify(slot))
        if actuator is wider or isinstance(answer, Error):
            an_error(
                answer, ErrorCode.IMAGE_REJECTED, f"FlashVerify of an actuator's power limit {actuator.power_limit}"
            )
    if isinstance(answer, Error):
        pytest.skip("the controller takes no images with actuators")
    probe.expect(FlashActivate(slot), FlashStatus)
    probe.open()
    found, expected = probe.description.actuator, description_of(narrower)
    if other.state != SlotState.CONFIRMED:  # else the fixture goes back to it
        probe.expect(FlashConfirm(slot), FlashStatus)
        verify(probe, other.slot, new_image(probe, image))
        probe.expect(FlashActivate(other.slot), FlashStatus)
        probe.open()
    assert found == expected, f"expected {expected}, came {found}"


@section("Model upload: Restarts and power failures")
def test_image_that_is_not_confirmed_is_reverted_by_a_restart(probe: Probe, slot: int, image: ModelImage) -> None:
    """After a restart without FlashConfirm, the controller runs the CONFIRMED slot; the tested one is VERIFIED."""
    if probe.link.restart is None:
        pytest.skip("this controller cannot be restarted from here")
    kept = [found for found in probe.description.images if found.state == SlotState.CONFIRMED]
    data = new_image(probe, image)
    verify(probe, slot, data)
    probe.expect(FlashActivate(slot), FlashStatus)
    assert described(probe, slot).state == SlotState.TESTING, f"expected a test, came {described(probe, slot)}"
    probe.link.restart()
    found = described(probe, slot)
    assert found.state == SlotState.VERIFIED, f"expected the slot VERIFIED again, came {found}"
    still = [found for found in probe.description.images if found.state == SlotState.CONFIRMED]
    assert still == kept, f"expected {kept}, came {still}"


def known_to(probe: Probe, requests: Iterable[Message]) -> list[Message]:
    """Return the requests that the controller's minor version has."""
    return [request for request in requests if probe.description.minor >= request.SINCE]


def with_crc(data: bytes) -> bytes:
    """Return an image's bytes with the CRC-32 behind them."""
    return data + zlib.crc32(data).to_bytes(4, "little")


def unknown_codec(probe: Probe) -> int:
    """Return the number of a codec that the controller does not have."""
    return min(set(range(1, 0x100)) - {number for number, _ in probe.description.codecs})
