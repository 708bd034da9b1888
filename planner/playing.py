"""Plays what was planned, live, on its controllers, and compares what it measures with the forecast."""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from vibrocast import models
from vibrocast.codec import Signal, metrics
from vibrocast.codec.rate_control import added_bytes
from vibrocast.codec.source import recording_format
from vibrocast.device_protocol.messages import State
from vibrocast.device_protocol.trace import TappedTransport
from vibrocast.errors import InputError
from vibrocast.host import devices, hand_playback, live, uploader
from vibrocast.host.bench_file import Bench, check_actuator
from vibrocast.host.controller import Controller
from vibrocast.host.devices import Session
from vibrocast.host.figures import FIGURES, Figure
from vibrocast.host.live_playback import LivePlayback
from vibrocast.host.report import Report
from vibrocast.output.actuator import Actuator
from vibrocast.planner.choose import TextureChoice, spqi
from vibrocast.planner.scene import Scene
from vibrocast.textures import Recording


class InstructionCounter:
    """Counts what the processor of a controller does while it plays.

    `count`: returns how many instructions it has carried out; None where nothing counts them.
    """

    def __init__(self, controller: Controller, count: Callable[[], int] | None = None) -> None:
        self._controller, self._count = controller, count
        self._noted: list[tuple[float, int]] = []

    def note(self) -> None:
        """Note what the processor has done so far, if a stream plays."""
        status = self._controller.status
        if self._count is not None and status is not None and status.state == State.PLAYING:
            self._noted[1:] = [(self._controller.clock(), self._count())]  # the first one, and the last

    def take_per_second(self) -> float | None:
        """Return the instructions per second from the first note to the last, and forget all notes.

        None where nothing counts, or nothing has played for any time.
        """
        noted, self._noted = self._noted, []
        if len(noted) < 2:
            return None
        (first_s, first), (last_s, last) = noted
        return (last - first) / (last_s - first_s)


@contextlib.contextmanager
def opened(address: str, actuator: Actuator | None) -> Iterator[tuple[Session, InstructionCounter]]:
    """Open a session with the controller at an address; `actuator`: behind it. Raises as `devices.open_session`.

    One that this program simulates is played in simulated time, in which no busy computer makes a packet late; an
    emulated processor counts its instructions, which takes several times as long. A trace has the times of this
    computer even so.
    """
    emulated = devices.is_emulated(address)
    if not emulated and address not in devices.IN_THIS_PROCESS:
        with devices.open_session(address, actuator=actuator) as real:
            yield real, InstructionCounter(real.controller)
        return
    from vibrocast.simulated_device.memory_link import MemoryLink

    board = devices.emulated(address) if emulated else None
    link = MemoryLink(board or devices.simulated(actuator=actuator))
    controller = Controller(TappedTransport(link, address), link.clock, link.sleep)
    count = board and (lambda: board.processor.counter.instructions)
    yield devices.session_with(controller, address, actuator), InstructionCounter(controller, count or None)


@dataclass(frozen=True)
class Row:
    """One figure of one texture. `measured`: None if nothing measured it."""

    texture: str
    figure: Figure
    forecast: float
    measured: float | None

    @property
    def deviation(self) -> float | None:
        """The deviation relative to the forecast; of levels as amplitudes, so 1 dB is 12 %."""
        if self.measured is None:
            return None
        if self.figure.unit == "dB":
            return math.pow(10.0, (self.measured - self.forecast) / 20) - 1
        return self.measured / self.forecast - 1 if self.forecast else float(self.measured != self.forecast)

    @property
    def within(self) -> bool | None:
        """Whether the measurement is as forecast, within the figure's tolerance; None if nothing measured it."""
        return None if self.measured is None else not self.figure.differs(self.forecast, self.measured)

    def line(self) -> str:
        """Return the figure in a line for people."""
        found = "computed only"
        if self.measured is not None and self.deviation is not None:
            off = ", OFF" if self.within is False else ""
            found = f"measured {self.figure.text(self.measured)} ({100 * self.deviation:+.1f} %{off})"
        return f"{self.texture}: {self.figure.label}: forecast {self.figure.text(self.forecast)}, {found}"


@dataclass(frozen=True)
class Played:
    """A texture that was played as planned, what was measured, and the report of its playback.

    `measured`: figures of its Forecast by their names; None where nothing measured them. Rates are by the bytes that
    were sent, quality by the samples that the controller decoded. Where packets were lost, quality is not the codec's
    alone.
    """

    choice: TextureChoice
    measured: Mapping[str, float | None]
    report: Report

    def rows(self) -> list[Row]:
        """Return every forecast with its measurement."""
        return [
            Row(self.choice.name, FIGURES[key], forecast, self.measured.get(key))
            for key, forecast in asdict(self.choice.chosen.forecast).items()
            if forecast is not None
        ]

    def failures(self) -> Iterator[str]:
        """Yield a line for each failure: late packets, samples that differ from those sent, and wrong forecasts."""
        name, report = self.choice.name, self.report
        if report.lost_anything:
            yield (
                f"{name}: {report.underruns} underruns, {report.lost_packets} lost packets; the computer or the link "
                "is too busy, or the delay limit too short; play again, or raise delay_limit_ms"
            )
        if report.differs:
            yield (
                f"{name}: the controller's samples differ from those that the host computes; test it with "
                "`vibrocast conformance`"
            )
        for row in self.rows():
            if row.within is False and row.deviation is not None:
                yield f"{name}: {row.figure.label} deviates by {100 * row.deviation:+.1f} % from its forecast"

    def document(self) -> dict[str, Any]:
        """Return forecast and measured figures, ready for JSON."""
        return {
            "texture": self.choice.name,
            "controller": self.choice.subject.texture.controller,
            "forecast": asdict(self.choice.chosen.forecast),
            "measured": dict(self.measured),
            "report": asdict(self.report),
        }


def play(
    scene: Scene,
    choices: Sequence[TextureChoice],
    progress: Callable[[float, str], None] = lambda part, details: None,
) -> list[Played]:
    """Play the choices for a scene, live, and return what was measured.

    Controllers play one after another, and so do the textures of each; a simulated one is flashed with the models that
    it lacks. Raises InputError if the scene does not fit its controllers, ControllerError, TransportError, and as
    `live.LiveStream`.
    """
    bench = Bench(scene.controllers, scene.actuators)
    played: list[Played] = []
    for controller in scene.controllers:
        own = [each for each in choices if each.subject.texture.controller == controller.name]
        if not own:
            continue
        with opened(controller.address, bench.actuator(controller.name)) as (its_session, counter):
            check_actuator(bench, controller, its_session)
            for choice in own:

                def note(part: float, name: str = choice.name) -> None:
                    counter.note()
                    progress((len(played) + part) / len(choices), name)

                model = None if choice.chosen.measured.model is None else models.find(choice.chosen.measured.model)
                if model is not None:
                    uploader.provide(its_session.controller, controller.address, model.image)
                play_one = _play_profile if choice.subject.over_position else _play_live
                measured, report = play_one(its_session, choice, model, note)
                measured["instructions_per_second"] = per_second = counter.take_per_second()
                if per_second is not None and controller.clock_hz is not None:
                    measured["load_percent"] = 100 * per_second / controller.clock_hz
                played.append(Played(choice, measured, report))
    return played


def _play_profile(
    its_session: Session, choice: TextureChoice, _: models.Model | None, note: Callable[[float], None]
) -> tuple[dict[str, float | None], Report]:
    """Load a profile, and play it once under a hand that goes there and back, as fast as planned at most.

    Controllers keep no decoded profile: where the DAC's codes are those computed, so is what they come from.
    """
    subject, stream = choice.subject, choice.encode().stream
    length_mm = 1e3 * len(subject.whole.samples) / subject.band.rate
    movement = hand_playback.back_and_forth(length_mm, subject.hand_speed_mm_s, 1)
    report = hand_playback.play_and_compare(its_session, choice.name, stream, movement, subject.whole, note).report
    # As if swept at the greatest speed, like the forecast.
    seconds = len(stream.packets) * stream.packet_samples / subject.samples_per_second
    frame_bytes = sum(len(packet) + added_bytes(packet) for packet in stream.packets)
    return {
        "payload_bps": 8 * sum(map(len, stream.packets)) / seconds,
        "wire_bps": 8 * frame_bytes / seconds,
        **_quality(choice, stream.decode()),
    }, report


def _play_live(
    its_session: Session, choice: TextureChoice, model: models.Model | None, note: Callable[[float], None]
) -> tuple[dict[str, float | None], Report]:
    """Play a texture once, as it would come from a live source."""
    recording, chosen = choice.subject.whole, choice.chosen.measured
    coding = live.LiveCoding(
        codec_name=chosen.option.codec,
        setting=chosen.setting,
        model=model,
        packet_samples=chosen.packet_samples,
        refresh_packets=chosen.refresh_packets,
    )
    stream = live.LiveStream(
        its_session.controller,
        recording_format(recording),
        coding=coding,
        playout_delay_s=choice.chosen.buffer_ms / 1e3,
    )
    playing = LivePlayback(its_session, stream, choice.name, model=model)
    played = playing.play(playing.paced(recording.samples), lambda _: note(stream.seconds / recording.seconds))
    sent = played.stream
    if sent is None:
        raise InputError(f"{choice.name} is too short to be played; plan a longer one")
    seconds = len(sent.packets) * stream.packet_samples / choice.subject.band.rate
    return {
        "payload_bps": 8 * sum(map(len, sent.packets)) / seconds,
        "wire_bps": 8 * stream.frame_bytes / seconds,
        "delay_ms": played.report.timing.end_to_end_ms,
        **_quality(choice, sent.decode()[: len(recording.samples)]),
    }, played.report


def _quality(choice: TextureChoice, decoded: Signal) -> dict[str, float | None]:
    """Return the quality that was measured. `decoded`: in the texture's unit and of its length."""
    whole = choice.subject.whole
    reference = Recording(whole.samples, choice.subject.samples_per_second, whole.unit, whole.name)
    quality = metrics.measure(reference.samples, decoded, reference.rate_hz, reference.unit)
    return {
        "snr_db": quality.snr_db,
        "spqi": spqi(reference, decoded),
        "third_octave_distance_db": quality.third_octave_distance_db,
    }
