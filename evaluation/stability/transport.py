"""Bad links: whole playbacks by the host's player on the simulated controller, in simulated time."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from random import Random

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import Configure, Start, Status, StreamData
from vibrocast.evaluation.stability import maps
from vibrocast.evaluation.stability.maps import Group, Map, RatePoint, Rule, Scope, figure, middle_rate_point
from vibrocast.evaluation.stability.signals import RATE_HZ, encoded, texture
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, Verdict, graded
from vibrocast.host import uploader
from vibrocast.host.controller import Controller as Host
from vibrocast.host.player import BUFFER_S, PlaybackSettings, play
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.output.rendering import render
from vibrocast.simulated_device.controller import FLASH_BYTES, Controller, Settings
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire
from vibrocast.simulated_device.flash import FlashMemory
from vibrocast.simulated_device.memory_link import MemoryLink

SECONDS = 5.0
LOOPS = 4
OFF_PART = 0.01
"""A sample is off where it differs from the faultless one by more than this part of the peak."""
HELD_SHARE, FAILED_SHARE = 0.05, 0.5
MAX_STEP_RATIO = 1.5
STALLS_EVERY_S = 0.7
STALLS_UNTIL_S = 60.0

LOSSES_PERCENT = (0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 20.0)
DAMAGES_PERCENT = (0.1, 1.0, 10.0, 20.0)
DRIFTS_PPM = (-10_000, -200, 200, 10_000)
PACED_DRIFTS_PPM = (-10_000, -1000, 1000, 2000, 5000, 10_000)
PACED_S, PACED_AHEAD_S = 60.0, 0.1
STALLS_S = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
BUFFERS_S = (BUFFER_S, 0.1, 1.0)
USUAL_BUFFER = f"buffer of {BUFFER_S:g} s"
_RULE = Rule(
    f"samples that differ by more than {100 * OFF_PART:g} % of the peak",
    f"up to {100 * HELD_SHARE:g} %",
    f"more than {100 * FAILED_SHARE:g} %; a step over {MAX_STEP_RATIO:g} times the largest",
)


@dataclass(frozen=True)
class LinkFaults:
    """Faults between host and controller. `lost`, `flipped`: the probability of each frame, in both directions.

    `stall_s`: how long nothing goes through, about every STALLS_EVERY_S. `drift_ppm`: of the controller's clock.
    """

    lost: float = 0.0
    flipped: float = 0.0
    stall_s: float = 0.0
    drift_ppm: int = 0

    def of_wire(self) -> Iterator[Fault]:
        """Yield the faults of the wire."""
        yield Fault(lost=self.lost, flipped=self.flipped)
        random, at_s = Random(0), STALLS_EVERY_S
        while self.stall_s and at_s < STALLS_UNTIL_S:
            yield Fault(at_s=at_s, for_s=self.stall_s, bits_per_second=1)  # for such a time, that is nothing
            at_s += self.stall_s + STALLS_EVERY_S * random.uniform(0.5, 1.5)


@lru_cache(maxsize=1)
def _stream(rate_point: RatePoint) -> tuple[Stream, NDArray[np.int16]]:
    """Return a live stream of the texture, and all DAC codes of its faultless playback."""
    stream = encoded(0.5 * texture(seconds=SECONDS), RATE_HZ, rate_point, live=True)
    delay_samples = stream.delay_samples
    codes, _ = render(stream.header, stream.decode_integers(), delay_samples, PIEZO_STACK, loops=LOOPS)
    return stream, codes


@lru_cache(maxsize=1)
def flash_with(image: bytes | None) -> FlashMemory:
    """Return the memory of a controller that has a model image, uploaded over a faultless link, or none."""
    flash = FlashMemory(FLASH_BYTES)
    if image is not None:
        link = MemoryLink(Controller(flash=flash))
        uploader.flash(Host(link, link.clock, link.sleep), image)
    return flash


def measure(rate_point: RatePoint, faults: LinkFaults, buffer_s: float = BUFFER_S) -> Measured:
    """Play the texture LOOPS times over a faulty link, and compare the DAC's codes. Raises as `player.play`."""
    stream, expected = _stream(rate_point)
    played: list[NDArray[np.int16]] = []
    controller = Controller(Settings(drift_ppm=faults.drift_ppm), flash_with(rate_point.image), on_dac=played.append)
    link = MemoryLink(FaultyWire(controller, tuple(faults.of_wire())))
    host = Host(link, link.clock, link.sleep)
    result = play(host, stream, PlaybackSettings(loops=LOOPS, buffer_s=buffer_s))
    codes = np.concatenate(played).astype(np.float64)
    return rate_codes(expected.astype(np.float64), codes, result.underruns, result.lost_packets, result.reconnects)


def rate_codes(
    expected: NDArray[np.float64], codes: NDArray[np.float64], underruns: int, lost_packets: int, reconnects: int
) -> Measured:
    """Return the outcome of a playback from the expected and the real codes (n, 1) of the DAC."""
    length = max(len(expected), len(codes))
    error = np.zeros((length, 1))
    error[: len(expected)] = expected
    error[: len(codes)] -= codes
    share = float(np.mean(np.abs(error) > OFF_PART * np.abs(expected).max()))
    noise = float(np.sum(error**2))
    steps = [np.abs(np.diff(each, axis=0, prepend=0)).max() for each in (codes, expected)]
    figures = {
        "off_share": share,
        "snr_db": 10 * math.log10(float(np.sum(expected**2)) / noise) if noise else math.inf,
        "underruns": underruns,
        "lost_packets": lost_packets,
        "reconnects": reconnects,
        "max_step_ratio": float(steps[0] / steps[1]),
    }
    counted = "1 underrun" if underruns == 1 else f"{underruns} underruns"
    effect = f"{100 * share:.1f} % of the signal off, {counted}" if share else ""
    if figures["max_step_ratio"] > MAX_STEP_RATIO:
        effect += f", a click of {figures['max_step_ratio']:.1f} times the signal's largest step"
        return Measured(Outcome.FAILS, figures, effect)
    return graded(share, HELD_SHARE, FAILED_SHARE, figures, effect)


def measure_paced(rate_point: RatePoint, drift_ppm: int) -> Measured:
    """Play from a source that sends packets by its own clock, and grade the share that came too late.

    Raises ControllerError and the like.
    """
    stream, _ = _stream(rate_point)
    link = MemoryLink(Controller(Settings(drift_ppm=drift_ppm), flash_with(rate_point.image)))
    host = Host(link, link.clock, link.sleep)
    packets, packet_samples = stream.packets, stream.packet_samples
    packet_s = stream.seconds / len(packets)
    ahead = max(2, round(PACED_AHEAD_S / packet_s))
    prebuffer_samples = ahead * packet_samples
    host.request(Configure(1, stream.header.pack(), prebuffer_samples, packets=len(packets), loops=0), Status)
    for number in range(ahead):
        host.send(StreamData(1, 0, (packets[number],)))
    started_s, late_s = host.clock(), math.nan
    host.request(Start(), Status)
    count = round(PACED_S / packet_s)
    for number in range(ahead, count):
        link.sleep(started_s + (number - ahead + 1) * packet_s - host.clock())
        iteration, of_iteration = divmod(number, len(packets))
        host.send(StreamData(1, iteration, (packets[of_iteration],)))
        host.poll(0)
        if host.status is not None and host.status.underruns and math.isnan(late_s):
            late_s = host.clock() - started_s
    status = host.stop()
    share = status.lost_packets / count
    figures = {"off_share": share, "underruns": status.underruns, "lost_packets": status.lost_packets}
    if not share:
        return Measured(Outcome.HOLDS, figures)
    effect = f"{100 * share:.1f} % of the packets too late, the first after {late_s:.0f} s"
    figures["first_underrun_s"] = late_s
    return graded(share, 0.0, FAILED_SHARE, figures, effect)


def _playbacks(
    values: Sequence[float], faults: Callable[[float], LinkFaults], buffers_s: Sequence[float], scope: Scope
) -> Iterator[Trial]:
    """Return every codec's trials with each value of a fault; the first codec's with each buffer."""
    for method in scope.methods:
        rate_point = middle_rate_point(method)
        for buffer_s in buffers_s if method is scope.methods[0] else buffers_s[:1]:
            case = f"buffer of {buffer_s:g} s"
            name = method.name if buffer_s == BUFFER_S else f"{method.name}, {case}"
            for value in scope.some(values, len(values) - 1):
                played = partial(measure, rate_point, faults(value), buffer_s)
                yield Trial(name, case, played, rate_point.text, float(value))


def _drifts(scope: Scope) -> Iterator[Trial]:
    """Return every codec's trials by the player, and the first codec's from a source with its own pace."""
    yield from _playbacks(DRIFTS_PPM, lambda ppm: LinkFaults(drift_ppm=round(ppm)), (BUFFER_S,), scope)
    first, rate_point = scope.methods[0], middle_rate_point(scope.methods[0])
    for drift_ppm in scope.some(PACED_DRIFTS_PPM, 3):
        case, paced = f"source {PACED_AHEAD_S:g} s ahead", partial(measure_paced, rate_point, drift_ppm)
        yield Trial(f"{first.name}, its own pace", case, paced, rate_point.text, float(drift_ppm))


def _up_to(what: str, cells: Sequence[Verdict]) -> str:
    """Return the message of a map that most codecs bear up to a limit, with the usual buffer."""
    usual = [cell for cell in cells if cell.case == USUAL_BUFFER]
    limit = maps.most_hold_up_to(usual)
    return f"Most codecs bear {what.format(f'up to {limit:g}' if limit else 'no')}"


def _drift_message(cells: Sequence[Verdict]) -> str:
    paced = [cell for cell in cells if cell.case == USUAL_BUFFER]
    own = [cell for cell in cells if cell.case != USUAL_BUFFER]
    values = maps.ranges(maps.sound_values(own), [cell.value for cell in own if cell.value is not None]) or "no"
    return (
        f"Credit makes drift harmless {maps.with_methods(paced)}; a source with its own pace holds at {values} ppm only"
    )


_link_map = partial(
    Map,
    group=Group.LINK,
    rule=_RULE,
    label=figure("off_share", factor=100),
)
LOSS = _link_map(
    name="loss",
    title="Lost frames",
    tried=f"The player streams a texture for {LOOPS * SECONDS:g} s. Frames are lost by chance, in both directions.",
    conditions=partial(_playbacks, LOSSES_PERCENT, lambda percent: LinkFaults(lost=percent / 100), (BUFFER_S,)),
    message=partial(_up_to, "{} % of lost frames"),
    caption="frames lost, %; samples that differ, %",
    value_name="lost_percent",
    varied="{} %",
)
FLIPS = _link_map(
    name="bit_flips",
    title="Damaged frames",
    tried="One byte of a frame changes by chance. The frame fails its CRC and is dropped.",
    conditions=partial(_playbacks, DAMAGES_PERCENT, lambda percent: LinkFaults(flipped=percent / 100), (BUFFER_S,)),
    message=partial(_up_to, "{} % of damaged frames"),
    caption="frames damaged, %; samples that differ, %",
    value_name="damaged_percent",
    varied="{} %",
)
DRIFT = _link_map(
    name="drift",
    title="Clock drift",
    tried="The controller's clock is faster or slower than the host's. A source with its own pace sends for "
    f"{PACED_S:g} s, whatever the controller's credit.",
    conditions=_drifts,
    message=_drift_message,
    caption="drift of the controller's clock, ppm; samples that differ, %",
    value_name="drift_ppm",
    varied="{} ppm",
)
STALLS = _link_map(
    name="stalls",
    title="Stalls",
    tried=f"About every {STALLS_EVERY_S:g} s nothing passes for a while. The first codec shows other buffers too.",
    conditions=partial(_playbacks, STALLS_S, lambda stall_s: LinkFaults(stall_s=stall_s), BUFFERS_S),
    message=partial(_up_to, f"stalls of {{}} s with a {USUAL_BUFFER}"),
    caption="length of a stall, s; samples that differ, %",
    value_name="stall_s",
    varied="{} s",
)
MAPS = (LOSS, FLIPS, DRIFT, STALLS)
