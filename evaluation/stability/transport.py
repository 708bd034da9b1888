"""Bad links: whole playbacks by the host's player on the simulated controller, in simulated time."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from random import Random

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import Configure, Start, Status, StreamData
from vibrocast.evaluation.cells import RatePoint
from vibrocast.evaluation.stability.maps import Map, Row, Scope, at_level
from vibrocast.evaluation.stability.signals import RATE_HZ, encoded, texture
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, graded
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
PLAYED_S = LOOPS * SECONDS
OFF_PERCENT = 1.0
"""A sample is off where it differs from the faultless one by more than this part of the peak."""
HELD_PERCENT, FAILED_PERCENT = 5.0, 50.0
MAX_STEP_RATIO = 1.5
STALLS_EVERY_S = 0.7
STALLS_UNTIL_S = 60.0

LOSSES_PERCENT = (0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 20.0)
DAMAGES_PERCENT = (0.1, 1.0, 10.0, 20.0)
DRIFTS_PPM = (-10_000.0, -200.0, 200.0, 10_000.0)
PACED_DRIFTS_PPM = (-10_000.0, -1000.0, 1000.0, 2000.0, 5000.0, 10_000.0)
PACED_S, PACED_AHEAD_S = 60.0, 0.1
STALLS_S = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
BUFFERS_S = {f"buffer of {buffer_s:g} s": buffer_s for buffer_s in (BUFFER_S, 0.1, 1.0)}
USUAL_BUFFER = next(iter(BUFFERS_S))


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


FAULTS: Mapping[str, Callable[[float], LinkFaults]] = {
    "loss": lambda percent: LinkFaults(lost=percent / 100),
    "bit_flips": lambda percent: LinkFaults(flipped=percent / 100),
    "drift": lambda ppm: LinkFaults(drift_ppm=round(ppm)),
    "stalls": lambda stall_s: LinkFaults(stall_s=stall_s),
}
"""The faults of each map, by the value that it varies."""


def measure(trial: Trial) -> Measured:
    """Play the texture LOOPS times over a faulty link, and compare the DAC's codes. Raises as `player.play`."""
    rate_point, faults = trial.rate_point, FAULTS[trial.map](trial.value)
    stream, expected = _stream(rate_point)
    played: list[NDArray[np.int16]] = []
    controller = Controller(Settings(drift_ppm=faults.drift_ppm), flash_with(rate_point.image), on_dac=played.append)
    link = MemoryLink(FaultyWire(controller, tuple(faults.of_wire())))
    host = Host(link, link.clock, link.sleep)
    result = play(host, stream, PlaybackSettings(loops=LOOPS, buffer_s=BUFFERS_S[trial.case]))
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
    share = float(np.mean(np.abs(error) > OFF_PERCENT / 100 * np.abs(expected).max()))
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
    return graded(share, HELD_PERCENT / 100, FAILED_PERCENT / 100, figures, effect)


def measure_paced(trial: Trial) -> Measured:
    """Play from a source that sends packets by its own clock, and grade the share that came too late.

    Raises ControllerError and the like.
    """
    stream, _ = _stream(trial.rate_point)
    link = MemoryLink(Controller(Settings(drift_ppm=round(trial.value)), flash_with(trial.rate_point.image)))
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
    return graded(share, 0.0, FAILED_PERCENT / 100, figures, effect)


def _usual(scope: Scope) -> Iterator[Trial]:
    return (replace(begun, case=USUAL_BUFFER) for begun in at_level("middle", scope.methods))


def _buffered(scope: Scope) -> Iterator[Trial]:
    """Yield the beginnings of trials with the usual buffer, and of the first codec's with the others."""
    for begun in _usual(scope):
        for case in BUFFERS_S if begun.method == scope.methods[0].name else [USUAL_BUFFER]:
            yield replace(begun, case=case, method=begun.method + f", {case}" * (case != USUAL_BUFFER))


def _paced(scope: Scope) -> Iterator[Trial]:
    for begun in at_level("middle", scope.methods[:1]):
        yield replace(begun, method=f"{begun.method}, its own pace", case=f"source {PACED_AHEAD_S:g} s ahead")


LOSS = Map("loss", globals(), [Row(measure, _usual, values=LOSSES_PERCENT, value_step=6)])
FLIPS = Map("bit_flips", globals(), [Row(measure, _usual, values=DAMAGES_PERCENT, value_step=3)])
DRIFT = Map(
    "drift",
    globals(),
    [
        Row(measure, _usual, values=DRIFTS_PPM, value_step=3),
        Row(measure_paced, _paced, values=PACED_DRIFTS_PPM, value_step=3),
    ],
)
STALLS = Map("stalls", globals(), [Row(measure, _buffered, values=STALLS_S, value_step=5)])
MAPS = (LOSS, FLIPS, DRIFT, STALLS)
