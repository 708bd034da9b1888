"""Plays what a plan says, live, on its controllers, and measures what the plan has forecast."""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from vibrocast import models
from vibrocast.codec import Signal, metrics
from vibrocast.codec.source import recording_format
from vibrocast.codec.threshold import read_threshold
from vibrocast.device_protocol.frames import write_frame
from vibrocast.device_protocol.messages import SinglePacket, State, Status, pack
from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import InputError
from vibrocast.host import devices, hand_playback, live, session, uploader
from vibrocast.host.bench_file import check_actuator
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.host.live_playback import LivePlayback
from vibrocast.host.report import Report
from vibrocast.host.session import Session
from vibrocast.host.tracing import TappedTransport
from vibrocast.output.actuator import Actuator
from vibrocast.planner import band
from vibrocast.planner.candidates import spqi
from vibrocast.planner.plan_file import Plan, PlannedController, PlannedTexture
from vibrocast.textures import Recording

RETAKES = 2
"""How often a texture is played again of which packets came too late: the computer may have been busy."""

# Often enough to know when the controller played what, too seldom to be a load of its own.
_ASKED_EVERY_S = 0.1


class InstructionCounter:
    """Counts what the processor of a controller does while it plays.

    `count`: returns how many instructions it has carried out; None where nothing counts them.
    """

    def __init__(self, controller: Controller, count: Callable[[], int] | None = None) -> None:
        self._controller, self._count = controller, count
        self._noted: list[tuple[float, int]] = []

    def begin(self) -> None:
        """Forget what was noted before."""
        self._noted.clear()

    def note(self) -> None:
        """Note what the processor has done so far, if a stream plays."""
        status = self._controller.status
        if self._count is not None and status is not None and status.state == State.PLAYING:
            self._noted[1:] = [(self._controller.clock(), self._count())]  # the first one, and the last

    @property
    def per_second(self) -> float | None:
        """From the first note to the last; None where nothing counts, or nothing has played for any time."""
        if len(self._noted) < 2:
            return None
        (first_s, first), (last_s, last) = self._noted
        return (last - first) / (last_s - first_s)


@dataclass(frozen=True)
class Played:
    """A texture that was played as planned, what was measured, and the report of its playback.

    `measured`: figures of its Forecast by their names; None where nothing measured them. Rates are by the bytes that
    were sent, quality by the samples that the controller decoded, the error at the skin by the codes of its DAC. Where
    packets were lost, quality is not the codec's alone.
    """

    texture: PlannedTexture
    measured: Mapping[str, float | None]
    report: Report


@contextlib.contextmanager
def opened(address: str, actuator: Actuator | None) -> Iterator[tuple[Session, InstructionCounter]]:
    """Open a session with the controller at an address; `actuator`: behind it. Raises as `session.connect`.

    One that this program simulates is played in simulated time, in which no busy computer makes a packet late; an
    emulated processor counts its instructions, which takes several times as long. A trace has the times of this
    computer even so.
    """
    emulated = devices.is_emulated(address)
    if not emulated and address not in devices.IN_THIS_PROCESS:
        with session.connect(address, actuator=actuator) as real:
            yield real, InstructionCounter(real.controller)
        return
    from vibrocast.simulated_device.memory_link import MemoryLink

    board = devices.emulated(address) if emulated else None
    link = MemoryLink(board or devices.simulated(actuator=actuator))
    controller = Controller(TappedTransport(link, address), link.clock, link.sleep)
    count = board and (lambda: board.processor.counter.instructions)
    yield session.session_with(controller, address, actuator), InstructionCounter(controller, count or None)


class PartlyPlayedError(ControllerError):
    """Controllers that failed, by name; `played`: the textures that the others have played."""

    def __init__(self, text: str, played: list[Played]) -> None:
        super().__init__(text)
        self.played = played


def play(
    plan: Plan,
    names: Sequence[str] = (),
    *,
    progress: Callable[[float, str], None] | None = None,
) -> list[Played]:
    """Play textures of a plan, all if none is named, and return what was measured, in the order asked for.

    Controllers play one after another, and so do the textures of each; a simulated one is flashed with the models that
    it lacks. Raises InputError if the plan does not fit files or controllers, PartlyPlayedError where some
    controllers failed, ControllerError, and as `PlannedTexture.encode`.
    """
    wanted = [plan.texture(name) for name in names] or list(plan.textures)
    mine = {each.name: [texture for texture in wanted if texture.controller == each.name] for each in plan.controllers}
    playing = {controller.name: controller for controller in plan.controllers if mine[controller.name]}
    done = dict.fromkeys(playing, 0.0)

    def tell(name: str, number: int, part: float) -> None:
        done[name] = (number + part) / len(mine[name])
        if progress is not None:
            progress(sum(done.values()) / len(done), mine[name][number].name)

    bench = plan.bench()
    played: dict[str, Played] = {}
    failures: dict[str, ControllerError | TransportError] = {}
    for name, each in playing.items():
        try:
            with opened(each.address, bench.actuator(name)) as (opened_session, counter):
                check_actuator(bench, each, opened_session)
                player = _Player(plan, each, opened_session, counter)
                own = [
                    player.play_in_time(texture, partial(tell, name, number))
                    for number, texture in enumerate(mine[name])
                ]
        except (ControllerError, TransportError) as error:
            if len(playing) == 1:
                raise
            failures[name] = error
        else:
            played.update({each.texture.name: each for each in own})
    in_order = [played[texture.name] for texture in wanted if texture.name in played]
    if failures:
        raise PartlyPlayedError("; ".join(f"{name}: {error}" for name, error in failures.items()), in_order)
    return in_order


class _Player:
    """Plays textures of a plan on one of its controllers. Raises as `play`."""

    def __init__(self, plan: Plan, planned: PlannedController, session: Session, counter: InstructionCounter) -> None:
        self._planned, self._session, self._counter = planned, session, counter
        self._controller = session.controller
        self._threshold = read_threshold(plan.threshold_path)

    def play_in_time(self, texture: PlannedTexture, tell: Callable[[float], None]) -> Played:
        """Play a texture, again where packets came too late; the last time counts."""
        recording = texture.recording()
        self._check_fits(texture)
        play = self.play_profile if texture.over_position else self.play
        for _ in range(1 + RETAKES):
            self._counter.begin()
            played = play(texture, recording, tell)
            if not played.report.lost_anything:
                break
        return played

    def play_profile(self, texture: PlannedTexture, recording: Recording, tell: Callable[[float], None]) -> Played:
        """Load a profile, and play it once under a hand that goes there and back, as fast as planned at most.

        Controllers keep no decoded profile: where the DAC's codes are those computed, so is what they come from.
        """
        stream = texture.encode(recording).stream
        self._provide_model(texture)

        def note(part: float) -> None:
            self._counter.note()
            tell(part)

        length_mm = 1e3 * len(recording.samples) / texture.rate
        movement = hand_playback.back_and_forth(length_mm, texture.hand_speed_mm_s, 1)
        report = hand_playback.play_and_compare(self._session, texture.name, stream, movement, recording, note).report
        # As if swept at the greatest speed, like the forecast.
        rate_hz = texture.rate * texture.hand_speed_mm_s / 1000
        seconds = len(stream.packets) * stream.packet_samples / rate_hz
        frame_bytes = sum(len(write_frame(pack(SinglePacket(0, packet)))) for packet in stream.packets)
        measured = self._measured(
            texture,
            Recording(recording.samples, rate_hz, recording.unit, recording.name),
            stream.decode(),
            payload_bps=8 * sum(map(len, stream.packets)) / seconds,
            wire_bps=8 * frame_bytes / seconds,
        )
        return Played(texture, measured, report)

    def play(self, texture: PlannedTexture, recording: Recording, tell: Callable[[float], None]) -> Played:
        """Play a texture, loaded as planned, once; `tell` is called with the part that is done."""
        model = self._provide_model(texture)
        signal_format = recording_format(recording)
        stream = live.LiveStream(
            self._controller,
            signal_format,
            coding=live.LiveCoding(
                codec_name=texture.codec,
                setting=texture.setting,
                model=model,
                policy=None if texture.target is None else texture.target.policy(signal_format),
                packet_samples=texture.packet_samples,
                refresh_packets=texture.refresh_packets,
            ),
            playout_delay_s=texture.buffer_ms / 1e3,
        )
        playing = LivePlayback(self._session, stream, texture.name, model=model, ask_s=_ASKED_EVERY_S)

        def note(_: Status) -> None:
            self._counter.note()
            tell(stream.seconds / recording.seconds)

        played = playing.play(playing.paced(recording.samples), note)
        report, sent = played.report, played.stream
        if sent is None:
            raise InputError(f"{texture.name} is too short to be played; plan a longer one")
        seconds = len(sent.packets) * stream.packet_samples / texture.rate
        driven = self._session.driven
        codes = band.played_codes(sent, sent.decode_integers(), driven)
        measured = self._measured(
            texture,
            recording,
            sent.decode()[: len(recording.samples)],
            payload_bps=8 * sum(map(len, sent.packets)) / seconds,
            wire_bps=8 * stream.frame_bytes / seconds,
            error_over_threshold_db=band.played_error_over_threshold_db(
                sent, recording, codes, driven, self._session.skin, self._threshold
            ),
            delay_ms=report.timing.end_to_end_ms,
        )
        return Played(texture, measured, report)

    def _provide_model(self, texture: PlannedTexture) -> models.Model | None:
        """Return the model of a texture, which the controller then runs; None where it needs none."""
        model = None if texture.model is None else models.find(texture.model)
        if model is not None:
            uploader.provide(self._controller, self._planned.address, model.image)
        return model

    def _measured(
        self, texture: PlannedTexture, recording: Recording, decoded: Signal, **figures: float | None
    ) -> dict[str, float | None]:
        """Return what was measured. `decoded`: in the recording's unit and of its length. `figures`: what is known."""
        quality = metrics.measure(recording.samples, decoded, recording.rate_hz, recording.unit)
        clock_hz, instructions_per_second = self._planned.clock_hz, self._counter.per_second
        load = None if instructions_per_second is None or clock_hz is None else 100 * instructions_per_second / clock_hz
        return {
            "instructions_per_second": instructions_per_second,
            "load_percent": load,
            "snr_db": quality.snr_db,
            # It takes long, so only where it was forecast.
            "spqi": None if texture.forecast.spqi is None else spqi(recording, decoded),
            "third_octave_distance_db": quality.third_octave_distance_db,
            **figures,
        }

    def _check_fits(self, texture: PlannedTexture) -> None:
        """Raise InputError where the controller cannot play a texture as planned."""
        hello = self._controller.description
        codecs = [name for _, name in hello.codecs]
        if texture.codec not in codecs:
            raise InputError(
                f"{texture.name} is planned for the codec {texture.codec}, {self._planned.name} decodes "
                f"{', '.join(codecs)}; plan for that controller, or update its firmware"
            )
        # Of a profile it keeps all, and says so itself.
        needed = 0 if texture.over_position else texture.packet_samples + texture.buffer_ms / 1e3 * texture.rate
        if needed > hello.limits.buffer_samples:
            raise InputError(
                f"{texture.name} needs a buffer of {math.ceil(needed)} samples, and {self._planned.name} holds "
                f"{hello.limits.buffer_samples}; plan for that controller"
            )
