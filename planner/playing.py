"""Plays what a plan says, live, on its controllers, and measures what the plan has forecast."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial

import numpy as np

from vibrocast import models
from vibrocast.codec import Signal, metrics
from vibrocast.codec.live_format import recording_format
from vibrocast.codec.stream import Stream
from vibrocast.codec.threshold import read_threshold
from vibrocast.device_protocol.messages import PacketMessage, Position, State, Tap
from vibrocast.device_protocol.transports import Transport, TransportError
from vibrocast.errors import InputError
from vibrocast.host import devices, hand_playback, live, uploader
from vibrocast.host.bench_file import Bench, actuator_of, check_actuator, choose_controller, driven_actuator
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.host.device_clock import DeviceClock
from vibrocast.host.stream_session import read_capture, stopped_on_error
from vibrocast.host.tracing import TappedTransport
from vibrocast.output.actuator import Actuator, Codes
from vibrocast.planner import band
from vibrocast.planner.candidates import spqi
from vibrocast.planner.plan_file import Plan, PlannedController, PlannedTexture
from vibrocast.textures import Recording

RETAKES = 2
"""How often a texture is played again of which packets came too late: the computer may have been busy."""

# Often enough to know when the controller played what, too seldom to be a load of its own.
_ASKED_EVERY_S = 0.1


class CountingController(Controller):
    """A session that keeps what is sent of a stream: the `packets`, and the bytes of their frames.

    `instructions`: returns how many the controller's processor has carried out; None where nothing counts them.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        instructions: Callable[[], int] | None = None,
    ) -> None:
        self.instructions = instructions
        self.forget()
        super().__init__(transport, clock, sleep)

    def forget(self) -> None:
        """Forget what was sent and noted so far, such as packets that probed the link."""
        self.packets: list[bytes] = []
        self.frame_bytes = 0
        self._loads: list[tuple[float, int]] = []

    def note_load(self) -> None:
        """Note what the processor has done so far, if a stream plays."""
        if self.instructions is not None and self.status is not None and self.status.state == State.PLAYING:
            self._loads[1:] = [(self.clock(), self.instructions())]  # the first one, and the last

    @property
    def instructions_per_second(self) -> float | None:
        """From the first note to the last; None where nothing counts, or nothing has played for any time."""
        if len(self._loads) < 2:
            return None
        (first_s, first), (last_s, last) = self._loads
        return (last - first) / (last_s - first_s)

    def send(self, data: PacketMessage | Position) -> None:
        """Send what is not answered; of stream data, keep what it was. Raises TransportError."""
        before = self.bytes_sent
        super().send(data)
        if isinstance(data, PacketMessage):
            self.frame_bytes += self.bytes_sent - before
            self.packets += data.packets


Opener = Callable[[str, Actuator | None], AbstractContextManager[CountingController]]


@dataclass(frozen=True)
class MeasuredPlayback:
    """Measured figures of a Forecast, by the same names; None where nothing measured them.

    Rates by the bytes that were sent, quality by the samples that the controller decoded, the error at the skin by the
    codes of its DAC.
    """

    payload_bps: float
    wire_bps: float
    instructions_per_second: float | None
    load_percent: float | None
    snr_db: float | None
    spqi: float | None
    third_octave_distance_db: float | None
    error_over_threshold_db: float | None
    delay_ms: float | None


@dataclass(frozen=True)
class Played:
    """A texture that was played as planned, and what was measured.

    `underruns`, `lost_packets`: where there are any, quality is not the codec's alone. `as_decoded`, `as_computed`:
    whether decoded samples and DAC codes, as far as the controller keeps them, are bit for bit what the host computes;
    None where it keeps none.
    """

    texture: PlannedTexture
    measured: MeasuredPlayback
    underruns: int
    lost_packets: int
    as_decoded: bool | None
    as_computed: bool | None

    @property
    def in_time(self) -> bool:
        """Whether every packet came in time."""
        return not self.underruns and not self.lost_packets


@contextlib.contextmanager
def opened(address: str, actuator: Actuator | None) -> Iterator[CountingController]:
    """Open a session with the controller at an address; `actuator`: of a simulated one. Raises as `devices.connect`.

    One that this program simulates is played in simulated time, in which no busy computer makes a packet late; an
    emulated processor counts its instructions, which takes several times as long. A trace has the times of this
    computer even so.
    """
    emulated = devices.is_emulated(address)
    if not emulated and address not in devices.IN_THIS_PROCESS:
        with devices.reach(address, actuator=actuator) as transport:
            yield CountingController(transport)
        return
    from vibrocast.simulated_device.memory_link import MemoryLink

    if emulated:
        device = devices.emulated(address)
        link = MemoryLink(device)
        tapped = TappedTransport(link, address)
        yield CountingController(tapped, link.clock, link.sleep, lambda: device.processor.counter.instructions)
    else:
        link = MemoryLink(devices.simulated(actuator=actuator))
        yield CountingController(TappedTransport(link, address), link.clock, link.sleep)


class PartlyPlayedError(ControllerError):
    """Controllers that failed, by name; `played`: the textures that the others have played."""

    def __init__(self, text: str, played: list[Played]) -> None:
        super().__init__(text)
        self.played = played


def play(
    plan: Plan,
    names: Sequence[str] = (),
    *,
    opener: Opener = opened,
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
            with opener(each.address, bench.actuator(name)) as session:
                player = _Player(plan, each, session)
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


def play_live(
    stream: live.LiveStream,
    controller: CountingController,
    samples: Signal,
    clock: DeviceClock,
    tell: Callable[[float], None],
) -> tuple[live.LiveResult, float | None]:
    """Play samples (n, channels) to their end; return what happened, and the instructions a second while it played.

    Whatever is raised, the controller is stopped first. Raises as `live.LiveStream`.
    """
    controller.forget()
    ask_s = 0.0
    with stopped_on_error(controller):
        for due_s, block in live.paced(stream, samples, stream.packet_samples, clock.sleep):
            stream.send_packets(stream.code(block))
            if due_s >= ask_s:
                ask_s = due_s + _ASKED_EVERY_S
                clock.ask(stream.packets_sent)
            controller.note_load()
            tell(stream.packets_sent * stream.packet_samples / len(samples))
        return stream.finish(), controller.instructions_per_second


def play_by_hand(
    controller: CountingController,
    stream: Stream,
    length_mm: float,
    hand_speed_mm_s: float,
    tell: Callable[[float], None],
) -> tuple[hand_playback.Played, float | None]:
    """Load a profile, and play it once under a hand that goes there and back, so fast at most; return as play_live."""
    controller.forget()

    def note(part: float) -> None:
        controller.note_load()
        tell(part)

    movement = hand_playback.back_and_forth(length_mm, hand_speed_mm_s, 1)
    return hand_playback.play(controller, stream, movement, note), controller.instructions_per_second


class _Player:
    """Plays textures of a plan on one of its controllers. Raises as `play`."""

    def __init__(self, plan: Plan, planned: PlannedController, controller: CountingController) -> None:
        self._planned = planned
        self._controller = controller
        self._threshold = read_threshold(plan.threshold_path)
        bench: Bench = choose_controller(plan.bench(), planned.name)
        described = controller.description.actuator
        check_actuator(bench, bench.first, described)
        self._driven = driven_actuator(bench, bench.first, described)
        self._skin_model = actuator_of(bench, bench.first, described)

    def play_in_time(self, texture: PlannedTexture, tell: Callable[[float], None]) -> Played:
        """Play a texture, again where packets came too late; the last time counts."""
        recording = texture.recording()
        self._check_fits(texture)
        play = self.play_profile if texture.over_position else self.play
        played = play(texture, recording, tell)
        for _ in range(RETAKES):
            if played.in_time:
                break
            played = play(texture, recording, tell)
        return played

    def play_profile(self, texture: PlannedTexture, recording: Recording, tell: Callable[[float], None]) -> Played:
        """Load a profile, and play it once under a hand that goes there and back, as fast as planned at most.

        Controllers keep no decoded profile: where the DAC's codes are those computed, so is what they come from.
        """
        controller, stream = self._controller, texture.encode(recording).stream
        self._provide_model(texture)
        length_mm = 1e3 * len(recording.samples) / texture.rate
        result, instructions = play_by_hand(controller, stream, length_mm, texture.hand_speed_mm_s, tell)
        as_computed = hand_playback.as_computed(
            result, hand_playback.computed(stream, result, self._driven), self._driven
        )
        # As if swept at the greatest speed, like the forecast.
        rate_hz = texture.rate * texture.hand_speed_mm_s / 1000
        seconds = len(stream.packets) * stream.decoder().packet_samples / rate_hz
        measured = self._measured(
            texture,
            Recording(recording.samples, rate_hz, recording.unit, recording.name),
            stream.decode(),
            payload_bps=8 * sum(map(len, controller.packets)) / seconds,
            wire_bps=8 * controller.frame_bytes / seconds,
            instructions_per_second=instructions,
        )
        return Played(texture, measured, result.status.underruns, result.status.lost_packets, None, as_computed)

    def play(self, texture: PlannedTexture, recording: Recording, tell: Callable[[float], None]) -> Played:
        """Play a texture, loaded as planned, once; `tell` is called with the part that is done."""
        controller = self._controller
        model = self._provide_model(texture)
        signal_format = recording_format(recording)
        stream = live.LiveStream(
            controller,
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
        clock = DeviceClock(controller)
        began_s = controller.clock()
        result, instructions = play_live(stream, controller, recording.samples, clock, tell)
        sent = Stream(stream.header, tuple(controller.packets), model.image if model else None)
        seconds = len(sent.packets) * stream.packet_samples / texture.rate
        as_decoded, decoded = self._read_back(Tap.DECODED, offline := sent.decode_integers())
        decoder = sent.decoder()
        codes = band.played_codes(sent, offline, self._driven)
        as_computed, played_codes = self._read_back(Tap.DAC, codes)
        gains = np.array(stream.header.gains) / 32768
        decoded_samples = decoded[decoder.delay_samples : decoder.delay_samples + len(recording.samples)] * gains
        error_db = band.played_error_over_threshold_db(
            sent, recording, played_codes, self._driven, self._skin_model, self._threshold
        )
        measured = self._measured(
            texture,
            recording,
            decoded_samples,
            payload_bps=8 * sum(map(len, sent.packets)) / seconds,
            wire_bps=8 * controller.frame_bytes / seconds,
            instructions_per_second=instructions,
            error_over_threshold_db=error_db,
            delay_ms=self._delay_ms(sent, clock, began_s),
        )
        return Played(texture, measured, result.underruns, result.lost_packets, as_decoded, as_computed)

    def _provide_model(self, texture: PlannedTexture) -> models.Model | None:
        """Return the model of a texture, which the controller then runs; None where it needs none."""
        model = None if texture.model is None else models.find(texture.model)
        if model is not None:
            uploader.provide(self._controller, self._planned.address, model.image)
        return model

    def _measured(
        self,
        texture: PlannedTexture,
        recording: Recording,
        decoded_samples: Signal,
        *,
        payload_bps: float,
        wire_bps: float,
        instructions_per_second: float | None,
        error_over_threshold_db: float | None = None,
        delay_ms: float | None = None,
    ) -> MeasuredPlayback:
        """Return what was measured; `decoded_samples`: what was decoded, in the recording's unit and of its length."""
        quality = metrics.measure(recording.samples, decoded_samples, recording.rate_hz, recording.unit)
        clock_hz = self._planned.clock_hz
        load = None if instructions_per_second is None or clock_hz is None else 100 * instructions_per_second / clock_hz
        return MeasuredPlayback(
            payload_bps=payload_bps,
            wire_bps=wire_bps,
            instructions_per_second=instructions_per_second,
            load_percent=load,
            snr_db=quality.snr_db,
            # It takes long, so only where it was forecast.
            spqi=None if texture.forecast.spqi is None else spqi(recording, decoded_samples),
            third_octave_distance_db=quality.third_octave_distance_db,
            error_over_threshold_db=error_over_threshold_db,
            delay_ms=delay_ms,
        )

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

    def _read_back(self, tap: Tap, computed: Codes) -> tuple[bool | None, Codes]:
        """Return whether a tap holds the values computed here, and these with the tap's own in their place.

        None where it keeps nothing.
        """
        if not self._controller.description.limits.capture_samples:
            return None, computed
        first, kept = read_capture(self._controller, tap, computed.shape[1])
        equal = first + len(kept) == len(computed) and np.array_equal(kept, computed[first:])
        taken = computed.copy()
        taken[first : first + len(kept)] = kept[: len(computed) - first]
        return equal, taken

    def _delay_ms(self, sent: Stream, clock: DeviceClock, began_s: float) -> float | None:
        """Return the delay from a sample at the host, the first of which came at `began_s`, to the skin.

        None for a texture that is over before the controller was known to play.
        """
        playing = [status for _, _, status in clock.trips.values() if status.state == State.PLAYING and status.position]
        if not playing:
            return None
        fit = clock.fit()
        # Positions are whole samples that have been played: the earliest estimate is the best.
        starts_s = (
            fit.host_time_s(status.device_time_us / 1e6) - status.position / sent.header.rate_hz for status in playing
        )
        return 1e3 * (min(starts_s) - began_s + band.rendering_s(sent, self._driven))
