"""Shared by the modules of the suite: the session with the controller, and the mark with the place in the protocol.

Whoever runs them gives the fixture `link`, a TappedLink to the controller under test.
"""

import contextlib
from collections.abc import Iterator

import pytest

from vibrocast.device_protocol.messages import (
    FlashActivate,
    FlashConfirm,
    FlashStatus,
    HelloResponse,
    ImageDescription,
    SlotState,
)
from vibrocast.device_protocol.transports import TransportError
from vibrocast.harness.conformance.probe import ANSWER_S, NotConforming, Probe, Unreachable
from vibrocast.harness.conformance.tapped_link import TappedLink

SECTIONS = (
    "Frames",
    "Messages",
    "Messages: From the host",
    "Messages: From the controller",
    "Messages: Error codes",
    "Session: Version",
    "Session: Sequence numbers",
    "Session: Watchdog",
    "Playing: States",
    "Playing: Requests by state",
    "Playing: Configure",
    "Playing: Queue",
    "Playing: Positions",
    "Playing: Credit",
    "Playing: Stream data",
    "Playing: Start",
    "Playing: Profiles",
    "Playing: Position",
    "Playing: Rendering",
    "Playing: EndStream",
    "Playing: Stop",
    "Playing: Pause, Resume, Loop and Gain",
    "Playing: Limits of the output",
    "Playing: DAC codes",
    "Playing: Capture",
    "Model upload",
    "Model upload: FlashBegin",
    "Model upload: FlashData",
    "Model upload: FlashVerify",
    "Model upload: FlashActivate",
    "Model upload: FlashErase",
    "Model upload: FlashRead",
    "Model upload: Restarts and power failures",
    "Model upload: Model image",
    "Model upload: Actuator image",
    "Model upload: Signatures",
)
"""Headings of docs/reference/protocol.md that hold requirements, in its order: a section, or section: subsection."""

section = pytest.mark.section
"""Marks a test with one of SECTIONS."""
long = pytest.mark.long
"""Marks a test that takes more than a second of the controller's time."""
prerequisite = pytest.mark.prerequisite
"""Marks a test that comes first: where it fails, the others make no sense."""


@pytest.fixture
def probe(link: TappedLink) -> Iterator[Probe]:
    """A session with the controller, whose output is at rest before the test and after it."""
    link.heal()
    opened = Probe(link)
    opened.open()
    opened.stop()
    yield opened
    with contextlib.suppress(NotConforming, TransportError, Unreachable):
        link.heal()
        opened.open(ANSWER_S)
        opened.stop()


@pytest.fixture
def hello(probe: Probe) -> HelloResponse:
    """The controller's description of itself."""
    return probe.description


@pytest.fixture
def slot(probe: Probe) -> Iterator[int]:
    """A slot that may be written: none that runs. The image that ran before the test runs after it again."""
    if not probe.link.may_flash:
        pytest.skip("slots for model images are not to be written")
    images = probe.description.images
    if any(image.state == SlotState.TESTING for image in images):
        pytest.skip("an image is being tested: confirm it, or restart the controller")
    kept = next((image for image in images if image.state == SlotState.CONFIRMED), None)
    writable = [image for image in images if image != kept]
    if not writable:
        pytest.skip("hello lists no slot, or only the one that runs")
    yield min(writable, key=lambda image: image.state).slot
    with contextlib.suppress(NotConforming, TransportError, Unreachable):
        _run_again(probe, kept)


def _run_again(probe: Probe, kept: ImageDescription | None) -> None:
    """End the test of an image that a check has left, and start the image that was kept before it."""
    probe.link.heal()
    probe.open(ANSWER_S)
    probe.stop()
    states = {image.slot: image.state for image in probe.description.images}
    tested = [number for number, state in states.items() if state == SlotState.TESTING]
    for number in tested:
        probe.expect(FlashConfirm(number), FlashStatus)
    # The slot that was confirmed before is so no longer, once the tested one is.
    if kept is not None and (tested or states[kept.slot] != SlotState.CONFIRMED):
        probe.expect(FlashActivate(kept.slot), FlashStatus)
        probe.open()
        probe.expect(FlashConfirm(kept.slot), FlashStatus)
