"""Chooses how each texture of a scene is coded: codes it by every option, and takes the cheapest that suffices."""

import bisect
import math
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from vibrocast import codec, models, textures
from vibrocast.codec import CodecError, Framing, Setting, Signal, Source, metrics
from vibrocast.codec.encoding import Encoding, families, measure_encoding
from vibrocast.codec.rate_control import added_bytes
from vibrocast.codec.source import LIVE_REFRESH_S, live_framing
from vibrocast.codec.threshold import DEFAULT_TOUCH, SHAPE, read_threshold
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT
from vibrocast.errors import InputError, located
from vibrocast.pages import listed
from vibrocast.planner import costs
from vibrocast.planner.band import error_over_threshold_db, slowest_mm_s
from vibrocast.planner.forecast import (
    BUFFERS_MS,
    Candidate,
    Coding,
    CodingOption,
    Subject,
    assessed,
    subject_of,
    wanted,
)
from vibrocast.planner.scene import MEASURES, Asked, Scene, SceneTexture
from vibrocast.textures import Recording

PACKET_BLOCKS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
FIRST_PACKET_BLOCKS = 4
"""Length of packets with which the search for a setting of an option begins."""
DEFAULT_BLOCK_SAMPLES = 32
"""Of codecs with one block length; their packets are rounded up to whole blocks of their own."""
MEASURED_SAMPLES = 1 << 14
"""Samples of all channels on which options are compared: those of most energy in a longer texture."""
SPQI_RATE_HZ = 2800
"""SPQI counts blocks and thresholds in samples, so it is always measured at the rate of the reference data."""
_FINER, _FINER_ON_THE_WHOLE = 3, 16
"""Finer settings that the search tries after the one found, in other packets, and on the whole of a long texture."""
NEAREST = 3
"""Alternatives in the answer."""
_TOUCHES = {"spqi": (DEFAULT_TOUCH, 1.0), "imperceptible": (1.0,)}
"""Strengths of the shape for touch that may need fewer bits than a flat one, by the required quality."""

Progress = Callable[[float, str], None]
"""Takes the share that is done, 0 to 1, and a text."""


class Evaluator:
    """Codes one texture of a scene by every option, and measures each coding once. Raises InputError."""

    def __init__(self, scene: Scene, texture: SceneTexture) -> None:
        self.scene = scene
        self._threshold = read_threshold(scene.threshold_path)
        self.subject = subject_of(scene, texture, self._threshold)
        self._excerpt = self.subject.whole if self.subject.over_position else _strongest(self.subject.whole)
        self._settings: dict[CodingOption, list[tuple[str | None, Setting]]] = {}
        self._measured: dict[tuple[CodingOption, int, int, bool], Coding | None] = {}

    def in_scene(self, scene: Scene) -> "Evaluator":
        """Return one with the same measurements in a scene with other limits, targets or weights."""
        other = copy(self)
        other.scene = scene
        return other

    def candidates(self) -> tuple[Candidate, ...]:
        """Return all codings measured so far whose packets are not longer than asked for, compared with the scene."""
        return tuple(
            assessed(each, self.subject, self.scene)
            for each in self._measured.values()
            if each is not None and each.packet_blocks in self.packet_blocks(each.option, each.packet_blocks)
        )

    def options(self) -> list[CodingOption]:
        """Return the options that the controller can decode, usually the cheapest first."""
        core = self.scene.controller(self.subject.texture.controller).core
        found = []
        for name, each in codec.CODECS.items():
            if self.scene.asked.waveform and not each.keeps_waveform:
                continue
            shipped = [members[0].family for members in families(each)]
            names = shipped if each.needs_model else [None, *shipped]
            shapes = SHAPE in each.parameters and not self.subject.over_position
            touches = (0.0, *(_TOUCHES.get(self.scene.asked.measure, ()) if shapes else ()))
            found += [
                CodingOption(name, family, block, touch)
                for family in names
                for block in each.blocks or (None,)
                for touch in touches
            ]
        found = [option for option in found if _block_samples(option) <= self._longest_packet]
        return [option for option in found if core is None or costs.decoder_cost(option.decoder, core) is not None]

    def settings(self, option: CodingOption) -> list[tuple[str | None, Setting]]:
        """Return the settings of an option, each with its model's name, the coarsest first.

        Empty if the codec rejects this texture.
        """
        if option not in self._settings:
            chosen, part = codec.codec_by_name(option.codec), self._excerpt
            members = [None] if option.family is None else models.members(option.family)
            found: list[tuple[str | None, Setting]] = []
            try:
                given = {**option.given, **codec.shape_setting(chosen, option.touch, part.rate_hz, part.unit)}
                for model in members:
                    source = Source.of(part.samples, round(part.rate_hz), option.codec, part.unit, True, model)
                    name = None if model is None else model.name
                    found += [(name, chosen.complete(setting)) for setting in source.settings(given)]
            except CodecError:
                found = []
            self._settings[option] = found
        return self._settings[option]

    @property
    def _longest_packet(self) -> float:
        """The most samples of a packet.

        Longer packets take fewer bits, and delay the signal. So without a limit of the delay, none is longer than those
        of a live stream (`codec.source.live_framing`).
        """
        rate = self.subject.samples_per_second
        if self.scene.asked.delay_limit_ms is None and not self.subject.over_position:
            return live_framing(round(rate)).packet_samples
        return LIVE_REFRESH_S * rate

    def packet_blocks(self, option: CodingOption, *more: int) -> list[int]:
        """Return the packet lengths of an option, in blocks: the usual ones, and `more` that are not too long."""
        longest = self._longest_packet / _block_samples(option)
        return sorted({blocks for blocks in (*PACKET_BLOCKS, *more) if blocks <= longest} | {1})

    def evaluate(self, option: CodingOption, index: int, packet_blocks: int, whole: bool = False) -> Candidate | None:
        """Code with a setting of an option, in packets of `packet_blocks` blocks; None if the codec rejects it.

        `index`: of `settings`. `whole`: code all of the texture, and measure every quality.
        """
        key = option, index, packet_blocks, whole
        if key not in self._measured:
            try:
                self._measured[key] = self._coded(*key)
            except CodecError:
                self._measured[key] = None
        measured = self._measured[key]
        return None if measured is None else assessed(measured, self.subject, self.scene)

    def _coded(self, option: CodingOption, index: int, packet_blocks: int, whole: bool) -> Coding:
        recording = self.subject.whole if whole else self._excerpt
        model, setting = self.settings(option)[index]
        rate_hz = self.subject.samples_per_second
        packet_samples = packet_blocks * _block_samples(option)
        framing = Framing(packet_samples, max(1, math.floor(LIVE_REFRESH_S * rate_hz / packet_samples)))
        encoding = encode(recording, self.subject.over_position, option.codec, model, setting, framing)
        stream = encoding.stream
        decoded = stream.decode()
        felt = [recording]
        if self.subject.over_position:
            felt = [
                replace(recording, rate_hz=recording.rate_hz * speed_mm_s / 1000)
                for speed_mm_s in (self.subject.hand_speed_mm_s, slowest_mm_s(self.scene.hand_speed_mm_s))
            ]
        frames = [len(packet) + added_bytes(packet) for packet in stream.packets]
        packet_s = stream.packet_samples / rate_hz
        seconds = len(stream.packets) * packet_s
        distance_db = error_db = None
        if whole or self.scene.asked.measure == "third_octave_distance_db":
            quality = metrics.measure(recording.samples, decoded, felt[0].rate_hz, recording.unit)
            distance_db = quality.third_octave_distance_db
        if whole or self.scene.asked.measure == "imperceptible":
            error_db = max(
                error_over_threshold_db(each, decoded, self.subject.actuator, self._threshold) for each in felt
            )
        return Coding(
            option=option,
            index=index,
            packet_blocks=packet_blocks,
            model=model,
            setting=setting,
            packet_samples=stream.packet_samples,
            refresh_packets=framing.refresh_packets,
            payload_bps=8 * sum(map(len, stream.packets)) / seconds,
            wire_bps=8 * sum(frames) / seconds,
            peak_bps=_peak_bps(frames, packet_s),
            max_frame_bytes=max(frames),
            delay_samples=stream.delay_samples,
            snr_db=encoding.quality.snr_db,
            spqi=spqi(felt[0], decoded) if whole or self.scene.asked.measure == "spqi" else None,
            third_octave_distance_db=distance_db,
            error_over_threshold_db=error_db,
            quiet=costs.quiet_part(stream.decode_integers()),
        )


def encode(
    recording: Recording, over_position: bool, codec_name: str, model: str | None, setting: Setting, framing: Framing
) -> Encoding:
    """Code a recording with a setting, in packets of a live stream or of a profile. Raises CodecError."""
    unit = PROFILE_UNIT if over_position else recording.unit
    source = Source.of(
        recording.samples,
        round(recording.rate_hz),
        codec_name,
        unit,
        True,
        None if model is None else models.find(model),
        framing=framing,
    )
    return measure_encoding(recording, source.encode(setting))


def spqi(reference: Recording, decoded: Signal) -> float | None:
    """Return SPQI at SPQI_RATE_HZ, whatever the stream's rate."""
    other = Recording(decoded, reference.rate_hz, reference.unit, reference.name)
    x, y = (textures.resample(each, SPQI_RATE_HZ).samples for each in (reference, other))
    return metrics.measure(x, y, SPQI_RATE_HZ).spqi


def _strongest(recording: Recording) -> Recording:
    """Return the MEASURED_SAMPLES of most energy, or all of a shorter recording."""
    samples = recording.samples
    count = max(1, MEASURED_SAMPLES // recording.channels)
    if len(samples) <= count:
        return recording
    energy = np.concatenate([[0.0], np.cumsum(np.sum(np.square(samples), axis=1))])
    start = int(np.argmax(energy[count:] - energy[:-count]))
    part = np.ascontiguousarray(samples[start : start + count])
    return Recording(part, recording.rate_hz, recording.unit, recording.name)


def _peak_bps(frames: list[int], packet_s: float) -> float:
    """Return the highest rate of the frames over any second of whole packets, in bit/s."""
    count = min(len(frames), max(1, round(1 / packet_s)))
    sums = np.concatenate([[0], np.cumsum(frames)])
    return float(8 * np.max(sums[count:] - sums[:-count]) / (count * packet_s))


def _block_samples(option: CodingOption) -> int:
    return DEFAULT_BLOCK_SAMPLES if option.block is None else int(option.block)


@dataclass(frozen=True)
class TextureChoice:
    """The choice for a texture, and `why` it was chosen.

    `compared`: the choice on the part of the texture on which options are compared. `alternatives`: the best candidate
    of each of the NEAREST other options in cost; those that meet the requirements come first. `candidates`: all.
    """

    subject: Subject
    chosen: Candidate
    compared: Candidate
    why: str
    alternatives: tuple[Candidate, ...]
    candidates: tuple[Candidate, ...]

    @property
    def name(self) -> str:
        """Name of the texture."""
        return self.subject.texture.name

    def encode(self) -> Encoding:
        """Code the texture as chosen."""
        subject, chosen = self.subject, self.chosen.measured
        framing = Framing(chosen.packet_samples, chosen.refresh_packets)
        return encode(subject.whole, subject.over_position, chosen.option.codec, chosen.model, chosen.setting, framing)


def plan(scene: Scene, progress: Progress = lambda part, details: None) -> tuple[TextureChoice, ...]:
    """Choose for every texture of a scene. Raises InputError, also for a texture that nobody can feel."""
    choices = []
    for place, texture in enumerate(scene.textures):

        def tell(part: float, details: str, place: int = place, name: str = texture.name) -> None:
            progress((place + part) / len(scene.textures), f"{name}: {details}")

        with located(scene.path):
            choices.append(choose(Evaluator(scene, texture), tell))
    return tuple(choices)


def choose(evaluator: Evaluator, progress: Progress = lambda part, details: None) -> TextureChoice:
    """Choose for one texture. Raises InputError: the requirement that cannot be met, and what to change.

    The search leaves an option that misses the quality and already costs more than the best: finer costs more.
    """
    options, bests, meeting = evaluator.options(), dict[CodingOption, Candidate](), list[Candidate]()
    for place, option in enumerate(options):
        progress(place / len(options), option.name)
        found = list(_tried(evaluator, option, min((each.cost for each in meeting), default=math.inf)))
        if found:
            bests[option] = min(found, key=_preference)
        meeting += [each for each in found if each.meets]
    for compared in sorted(meeting, key=lambda each: each.cost):
        whole, option = _on_the_whole(evaluator, compared), compared.measured.option
        if whole is not None and whole.meets:
            del bests[option]
            others = sorted(bests.values(), key=lambda each: (not each.meets, abs(each.cost - compared.cost)))
            why = _why(evaluator.scene.asked, compared, others)
            return TextureChoice(
                evaluator.subject, whole, compared, why, tuple(others[:NEAREST]), evaluator.candidates()
            )
        bests[option] = whole or bests[option]
    raise _impossible(evaluator)


def _tried(evaluator: Evaluator, option: CodingOption, bound: float) -> Iterator[Candidate]:
    """Yield candidates of an option.

    Bisection finds the coarsest setting with the required quality. Then packets of other lengths follow. `bound`: the
    cost above which a setting that is too coarse ends the search.
    """
    first_length = min(evaluator.packet_blocks(option), key=lambda blocks: abs(blocks - FIRST_PACKET_BLOCKS))
    last = len(evaluator.settings(option)) - 1
    low, high, found = 0, last, None
    while low <= high:
        middle = (low + high) // 2
        candidate = evaluator.evaluate(option, middle, first_length)
        if candidate is not None:
            yield candidate
        if candidate is not None and candidate.shortfall <= 0:
            found, high = candidate, middle - 1
        elif candidate is not None and candidate.cost >= bound:
            return
        else:
            low = middle + 1
    if found is None:
        return
    for blocks in evaluator.packet_blocks(option, *_just_in_time(evaluator, found)):
        # A packet's length moves the quality a little, as refreshes lie elsewhere.
        for index in range(low, min(low + _FINER, last + 1)) if blocks != first_length else ():
            candidate = evaluator.evaluate(option, index, blocks)
            if candidate is not None:
                yield candidate
                if candidate.shortfall <= 0:
                    break


def _just_in_time(evaluator: Evaluator, found: Candidate) -> Iterator[int]:
    """Yield the longest packets of an option within the delay limit, in blocks, which have the fewest frames."""
    limit_ms = evaluator.scene.asked.delay_limit_ms
    if limit_ms is None or evaluator.subject.over_position:
        return
    blocks = found.measured.packet_blocks
    block_ms = 1e3 * found.measured.packet_samples / blocks / evaluator.subject.samples_per_second
    for buffer_ms in BUFFERS_MS:
        left_ms = limit_ms - (found.forecast.delay_ms - found.buffer_ms) - buffer_ms
        yield min(max(1, blocks + math.floor(left_ms / block_ms)), PACKET_BLOCKS[-1])


def _on_the_whole(evaluator: Evaluator, compared: Candidate) -> Candidate | None:
    """Return the candidate measured on the whole texture, with a finer setting if needed.

    If no setting has the quality, return the finest one; None if the codec rejects the texture.
    """
    option, index, last = compared.measured.option, compared.measured.index, None
    for finer in range(index, min(index + _FINER_ON_THE_WHOLE, len(evaluator.settings(option)))):
        candidate = evaluator.evaluate(option, finer, compared.measured.packet_blocks, whole=True)
        last = candidate or last
        if candidate is not None and candidate.shortfall <= 0:
            break
    return last


def _preference(candidate: Candidate) -> tuple[bool, int, float, float]:
    """Order an option's candidates: one that meets all first, the cheapest of those; else the nearest to it."""
    return not candidate.meets, len(candidate.broken), max(0.0, candidate.shortfall), candidate.cost


def _why(asked: Asked, compared: Candidate, others: list[Candidate]) -> str:
    """Return in a sentence why an option was chosen, and how much more the next one costs."""
    required = [_quality(wanted(asked), asked, "g")]
    if asked.rate_limit_bps is not None:
        required.append(f"{asked.rate_limit_bps:.9g} bit/s")
    if asked.delay_limit_ms is not None:
        required.append(f"{asked.delay_limit_ms:g} ms")
    meeting = [each.cost for each in others if each.meets]
    if not meeting:
        return f"the only one of {len(others) + 1} options that meets {listed(required)}"
    percent = 100 * (min(meeting) / compared.cost - 1) if compared.cost else math.inf
    more = f"{percent:.0f} % more" if 1 <= percent < math.inf else "about the same" if percent < 1 else "more"
    return f"cheapest of {len(meeting) + 1} options that meet {listed(required)}; the next costs {more}"


def why_not(asked: Asked, candidate: Candidate, compared: Candidate) -> str:
    """Return in a line why an alternative was rejected: its cost, and what it misses. `compared`: the choice."""
    relation = "higher" if candidate.cost >= compared.cost else "lower"
    cost = f"{relation} cost ({candidate.cost:.4g} vs {compared.cost:.4g})"
    misses = [reached(candidate, asked)] * (candidate.shortfall > 0)
    misses += [f"{limit.key} {limit.needed:.4g}, limit {limit.available:.4g}" for limit in candidate.broken]
    return f"{cost}, misses the target: {'; '.join(misses)}" if misses else cost


def reached(candidate: Candidate, asked: Asked) -> str:
    """Return the quality of a candidate in words."""
    return "silence" if candidate.quality is None else _quality(candidate.quality, asked, "+.1f")


def _quality(value: float, asked: Asked, error_form: str) -> str:
    if asked.measure == "imperceptible":
        return f"an error of {value:{error_form}} dB re the felt level"
    figure = MEASURES[asked.measure].figure
    return f"{figure.label} {value:.3g} {figure.unit}".rstrip()


def _impossible(evaluator: Evaluator) -> InputError:
    """Return the error: the requirement that cannot be met, the best that can be reached, and what to change."""
    for option in evaluator.options():
        for blocks in (evaluator.packet_blocks(option)[0], evaluator.packet_blocks(option)[-1]):
            _finest_within(evaluator, option, blocks)
    texture, candidates, asked = evaluator.subject.texture, evaluator.candidates(), evaluator.scene.asked
    where = f"{texture.name}: no codec"
    if not candidates:
        return InputError(f"{where} that {texture.controller} decodes takes this signal; choose another controller")
    where = f"{where} reaches {_quality(wanted(asked), asked, 'g')}"
    within = [each for each in candidates if not each.broken and each.quality is not None]
    best = min(within or candidates, key=lambda each: each.shortfall)
    reaches = f"the best{' within all limits' * bool(within)} is {reached(best, asked)} ({best.measured.option.name})"
    lower = _lowered(best, asked)
    enough = [each for each in candidates if each.shortfall <= 0 and each.broken]
    if not enough:
        return InputError(f"{where}; {reaches}; {lower or 'choose another measure of quality'}")
    nearest = min(enough, key=_octaves_over)
    limits = nearest.broken
    exceeded = " and ".join(f"{limit.place(texture.controller)} = {limit.available:.9g}" for limit in limits)
    needed = " and ".join(f"{limit.key} = {_rounded_up(limit.needed)}" for limit in limits)
    remedy = "raise the limit to this value" if len(limits) == 1 else "raise the limits to these values"
    return InputError(
        f"{where} with {exceeded}; {nearest.measured.option.name} comes nearest and needs {needed}; "
        f"{reaches if within else 'no setting keeps all limits'}; {remedy}{f', or {lower}' if within and lower else ''}"
    )


def _finest_within(evaluator: Evaluator, option: CodingOption, packet_blocks: int) -> None:
    """Try the finest setting of an option that keeps all limits: the search for the quality may not have come there."""

    def exceeds(index: int) -> bool:
        candidate = evaluator.evaluate(option, index, packet_blocks)
        return candidate is not None and bool(candidate.broken)

    bisect.bisect_left(range(len(evaluator.settings(option))), True, key=exceeds)


def _octaves_over(candidate: Candidate) -> float:
    """Return by how many octaves a candidate exceeds limits, all together."""
    return sum(math.log2(limit.needed / limit.available) for limit in candidate.broken if limit.available)


def _rounded_up(value: float) -> str:
    """Return a number above 0 with four significant digits, rounded up, so that it is enough."""
    step = 10.0 ** (math.floor(math.log10(value)) - 3)
    return f"{math.ceil(value / step) * step:.9g}"


def _lowered(best: Candidate, asked: Asked) -> str | None:
    """Return how to require no more than the quality of `best`, rounded to the safe side; None if that cannot be."""
    if best.quality is None or asked.measure == "imperceptible":
        return None
    measure = MEASURES[asked.measure]
    scale = 10**measure.digits
    if measure.figure.worse > 0:
        return f"raise {asked.measure} to {math.ceil(scale * best.quality) / scale:g}"
    lower = math.floor(scale * best.quality) / scale
    return f"lower {asked.measure} to {lower:g}" if lower > 0 else None
