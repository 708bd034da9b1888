"""Chooses how each texture of a scene is coded: the least weighted cost that meets the targets; and says why."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from vibrocast.codec.rate_controlled import RateTarget
from vibrocast.files import InputFileError
from vibrocast.host.planner.band import MARGIN_DB, BandError
from vibrocast.host.planner.candidates import BUFFERS_MS, Candidate, CodingOption, Evaluator
from vibrocast.host.planner.plan_file import CAPPED_MODE, SETTING_MODE, Plan, PlannedController, PlannedTexture
from vibrocast.host.planner.scene import Asked, Scene

Progress = Callable[[float, str], None]
FIRST_PACKET_BLOCKS = 4
"""Length of packets with which the search for a setting of an option begins."""
_FINER, _FINER_ON_THE_WHOLE = 3, 16
"""Finer settings that the search tries after the one found, in other packets, and on the whole of a long texture."""
NEAREST = 3
"""Alternatives that a person sees; the file of candidates has all."""
QUALITIES = {
    "snr_db": ("SNR", " dB"),
    "spqi": ("SPQI", ""),
    "third_octave_distance_db": ("third-octave distance", " dB"),
}
"""Name and unit of each measure for a person."""
_RATE_LIMITS = {"rate_limit_bps", "bytes_per_second"}
"""Keys of the limits that a capped rate may keep where no setting does."""


class PlanningError(InputFileError):
    """A scene whose requirements cannot be met; the message names the limits that are exceeded and the action."""


@dataclass(frozen=True)
class Reason:
    """Why an option was not chosen. `best`: its candidate nearest to the targets; None where it has no setting."""

    option: CodingOption
    best: Candidate | None
    why: str


@dataclass(frozen=True)
class TextureChoice:
    """The choice for a texture, `why` it was chosen, all candidates, and why each other option was not chosen."""

    evaluator: Evaluator
    chosen: Candidate
    why: str
    candidates: tuple[Candidate, ...]
    reasons: tuple[Reason, ...]

    @property
    def name(self) -> str:
        """Name of the texture."""
        return self.evaluator.texture.name

    @property
    def alternatives(self) -> tuple[Reason, ...]:
        """The NEAREST other options: first those that meet the targets, then those that miss, each by their cost."""

        def distance(reason: Reason) -> tuple[bool, float]:
            return not reason.best.meets, abs(reason.best.cost - self.chosen.cost)  # type: ignore[union-attr]

        return tuple(sorted((each for each in self.reasons if each.best is not None), key=distance)[:NEAREST])


def plan(scene: Scene, progress: Progress = lambda part, details: None) -> tuple[Plan, tuple[TextureChoice, ...]]:
    """Plan every texture of a scene. Raises PlanningError, also for a texture that nobody can feel."""
    choices = []
    for place, texture in enumerate(scene.textures):

        def tell(part: float, details: str, place: int = place, name: str = texture.name) -> None:
            progress((place + part) / len(scene.textures), f"{name}: {details}")

        try:
            evaluator = Evaluator(scene, texture)
        except BandError as error:
            raise PlanningError(f"{scene.path}: {error}") from error
        choices.append(choose(evaluator, scene, tell))
    planned = tuple(map(_planned, choices))
    controllers = tuple(PlannedController(each.name, each.address, each.clock_hz) for each in scene.controllers)
    return Plan(scene.path, controllers, scene.actuators, planned, scene.threshold_path), tuple(choices)


def choose(evaluator: Evaluator, scene: Scene, progress: Progress = lambda part, details: None) -> TextureChoice:
    """Choose for one texture. Raises PlanningError.

    The rate is capped where it has to be: to code by a setting takes fewer bits, but more of them in a loud second.
    """
    search = _Search(evaluator, scene, progress)
    options = evaluator.options(scene.controller(evaluator.texture.controller).core)
    chosen = search.cheapest(options) or search.cheapest(search.capped(options))
    if chosen is None:
        raise search.error()
    reasons = tuple(
        Reason(option, best, search.why_not(option, best, chosen))
        for option, best in search.bests.items()
        if option != chosen.measured.option
    )
    return TextureChoice(evaluator, chosen, search.why(chosen), search.candidates(), reasons)


class _Search:
    """The search for the cheapest candidate of one texture. `bests`: the best candidate of each option."""

    def __init__(self, evaluator: Evaluator, scene: Scene, progress: Progress) -> None:
        self.bests: dict[CodingOption, Candidate | None] = {}
        self._evaluator, self._scene, self._progress = evaluator, scene, progress

    def candidates(self) -> tuple[Candidate, ...]:
        """Return all measured codings, as the scene sees them."""
        return tuple(self._evaluator.assessed(measured, self._scene) for measured in self._evaluator.measured)

    def cheapest(self, options: list[CodingOption]) -> Candidate | None:
        """Return the cheapest candidate of these options that meets the targets, if there is one.

        The search leaves an option that misses the quality and already costs more than the best: finer costs more.
        """
        meeting: list[tuple[Candidate, CodingOption, int, int]] = []
        for place, option in enumerate(options):
            self._progress(place / len(options), option.name)
            bound = min((candidate.cost for candidate, *_ in meeting), default=math.inf)
            found = list(self._of_option(option, bound))
            self.bests[option] = min((candidate for candidate, *_ in found), key=_preference, default=None)
            meeting += [(candidate, option, index, blocks) for candidate, index, blocks in found if candidate.meets]
        for _, option, index, blocks in sorted(meeting, key=lambda each: each[0].cost):
            whole = self._on_the_whole(option, index, blocks)
            if whole is not None:
                self.bests[option] = whole
                return whole
        return None

    def capped(self, options: list[CodingOption]) -> list[CodingOption]:
        """Return, with their rate capped, those options that have the quality and exceed no limit but that of rate."""
        limit_bps = self._scene.asked.rate_limit_bps
        if limit_bps is None or self._evaluator.over_position:
            return []
        enough = {
            candidate.measured.option
            for candidate in self.candidates()
            if candidate.shortfall <= 0 and {limit.key for limit in candidate.broken} <= _RATE_LIMITS
        }
        return [replace(option, rate_limit_bps=limit_bps) for option in options if option in enough]

    def why_not(self, option: CodingOption, best: Candidate | None, chosen: Candidate) -> str:
        """Return in a line why an option was not chosen."""
        if best is None and option.rate_limit_bps is not None:
            return "it cannot hold this rate"
        if best is None:
            return "it cannot code this signal at this rate"
        cost = self._compared_cost(chosen)
        costs = f"{'higher' if best.cost >= cost else 'lower'} cost ({best.cost:.3g} vs {cost:.3g}"
        if not best.meets:
            return f"{costs}) and misses the target: {self._missing(best)}"
        if best.cost >= cost:
            return f"{costs}; {_differences(best, chosen, self._scene)})"
        return f"{costs}), but misses the target on the whole texture"

    def _compared_cost(self, chosen: Candidate) -> float:
        """Return the choice's cost where options were compared: on the loudest part of a long texture."""
        own = [each.cost for each in self.candidates() if each.measured.option == chosen.measured.option and each.meets]
        return min(own)

    def why(self, chosen: Candidate) -> str:
        """Return in a sentence why a candidate was chosen, and why not a coarser setting of it."""
        meeting = sum(best is not None and best.meets for best in self.bests.values())
        asked = self._scene.asked
        first = (
            f"cheapest of the {meeting} options that meet {target(asked)} within all limits"
            if meeting > 1
            else f"the only option that meets {target(asked)} within all limits"
        )
        coarser = [
            each
            for each in self.candidates()
            if each.measured.option == chosen.measured.option and each.shortfall > 0 and each.cost < chosen.cost
        ]
        if not coarser:
            return f"{first}; it has no coarser setting"
        nearest = min(coarser, key=lambda each: each.shortfall)
        return f"{first}; a coarser setting has {reached(nearest, asked)}"

    def error(self) -> PlanningError:
        """Return the error that names the limits which the nearest candidate exceeds, or the best quality."""
        texture, candidates = self._evaluator.texture, self.candidates()
        where = f"{self._scene.path}: {texture.name}"
        if not candidates:
            return PlanningError(
                f"{where}: no codec that {texture.controller} decodes takes this signal; give another controller"
            )
        enough = [candidate for candidate in candidates if candidate.shortfall <= 0 and candidate.broken]
        if enough:
            nearest, action = min(enough, key=_octaves_over), "raise this limit, or require less"
        else:
            nearest, action = min(candidates, key=lambda candidate: candidate.shortfall), "require less"
        return PlanningError(
            f"{where} cannot be planned: {nearest.measured.option.name} comes nearest: {self._missing(nearest)}; "
            f"{action}"
        )

    def _missing(self, candidate: Candidate) -> str:
        """Return the quality where a candidate falls short of it, and the limits that it exceeds."""
        controller = self._evaluator.texture.controller
        asked = self._scene.asked
        quality = [f"{reached(candidate, asked)}, required {target(asked)}"] * (candidate.shortfall > 0)
        limits = [
            f"needs {limit.place(controller)} = {limit.needed:.4g}, the scene has {limit.available:.4g}"
            for limit in candidate.broken
        ]
        return "; ".join([*quality, *limits])

    def _of_option(self, option: CodingOption, bound: float) -> Iterator[tuple[Candidate, int, int]]:
        """Yield candidates of an option, each with the place of its setting and the blocks in its packets.

        Bisection finds the coarsest setting with the required quality. Then packets of other lengths follow.
        """
        lengths = self._evaluator.packet_blocks(option)
        if option.rate_limit_bps is not None:
            first_length = lengths[-1]  # the fewest frames leave the most for quality
        else:
            first_length = min(lengths, key=lambda blocks: abs(blocks - FIRST_PACKET_BLOCKS))
        last = len(self._evaluator.qualities(option)) - 1
        low, high, found = 0, last, None
        while low <= high:
            middle = (low + high) // 2
            candidate = self._candidate(option, middle, first_length)
            if candidate is not None:
                yield candidate, middle, first_length
            if candidate is not None and candidate.shortfall <= 0:
                found, high = candidate, middle - 1
            elif candidate is not None and candidate.cost >= bound:
                return
            else:
                low = middle + 1
        if found is None:
            return
        for blocks in self._other_lengths(lengths, found, first_length):
            # A packet's length moves the quality a little, as refreshes lie elsewhere.
            for index in range(low, min(low + _FINER, last + 1)):
                candidate = self._candidate(option, index, blocks)
                if candidate is not None:
                    yield candidate, index, blocks
                    if candidate.shortfall <= 0:
                        break

    def _other_lengths(self, lengths: list[int], found: Candidate, blocks: int) -> list[int]:
        """Return the other packet lengths, in blocks, for an option whose candidate `found` has `blocks`.

        The usual ones, and the longest within the delay limit, which have the fewest frames.
        """
        usual, limit_ms = set(lengths), self._scene.asked.delay_limit_ms
        if limit_ms is not None and not self._evaluator.over_position:
            block_ms = 1e3 * found.measured.packet_samples / blocks / self._evaluator.samples_per_second
            for buffer_ms in BUFFERS_MS:
                left_ms = limit_ms - (found.forecast.delay_ms - found.buffer_ms) - buffer_ms
                longest = blocks + math.floor(left_ms / block_ms)
                if 0 < longest <= max(usual):
                    usual.add(longest)
        return sorted(usual - {blocks})

    def _on_the_whole(self, option: CodingOption, index: int, blocks: int) -> Candidate | None:
        """Return the candidate measured on the whole texture, finer where needed; None where it fails."""
        for finer in range(index, min(index + _FINER_ON_THE_WHOLE, len(self._evaluator.qualities(option)))):
            candidate = self._candidate(option, finer, blocks, whole=True)
            if candidate is not None and candidate.shortfall <= 0:
                return candidate if candidate.meets else None
        return None

    def _candidate(self, option: CodingOption, index: int, blocks: int, whole: bool = False) -> Candidate | None:
        measured = self._evaluator.evaluate(option, index, blocks, whole)
        return None if measured is None else self._evaluator.assessed(measured, self._scene)


def _preference(candidate: Candidate) -> tuple[bool, int, float, float]:
    """Order an option's candidates: one that meets all first, the cheapest of those; else the nearest to it."""
    return not candidate.meets, len(candidate.broken), max(0.0, candidate.shortfall), candidate.cost


def _octaves_over(candidate: Candidate) -> float:
    """Return by how many octaves a candidate exceeds limits, all together."""
    return sum(math.log2(limit.needed / limit.available) for limit in candidate.broken if limit.available)


def _differences(best: Candidate, chosen: Candidate, scene: Scene) -> str:
    """Return what differs most, by weight."""
    a, b, weights = best.forecast, chosen.forecast, scene.weights
    memory = [((each.flash_bytes or 0) + (each.ram_bytes or 0)) / 1e3 for each in (a, b)]
    parts = (
        (weights.per_kilobit_per_second, (a.wire_bps - b.wire_bps) / 1e3, "kbit/s"),
        (
            weights.per_million_instructions_per_second,
            ((a.instructions_per_second or 0) - (b.instructions_per_second or 0)) / 1e6,
            "million instructions/s",
        ),
        (weights.per_kilobyte, memory[0] - memory[1], "kB"),
        (weights.per_millisecond, a.delay_ms - b.delay_ms, "ms"),
    )
    largest = sorted(parts, key=lambda part: -abs(part[0] * part[1]))[:2]
    return ", ".join(f"{difference:+.3g} {unit}" for _, difference, unit in largest)


def reached(candidate: Candidate, asked: Asked) -> str:
    """Return the quality of a candidate in words."""
    if candidate.quality is None:
        return "silence"
    if asked.measure == "imperceptible":
        return f"an error of {candidate.quality:+.1f} dB re the detection threshold"
    name, unit = QUALITIES[asked.measure]
    return f"{name} {candidate.quality:.3g}{unit}"


def target(asked: Asked) -> str:
    """Return the required quality in words."""
    if asked.measure == "imperceptible":
        return f"an error of {MARGIN_DB:g} dB re the detection threshold"
    name, unit = QUALITIES[asked.measure]
    return f"{name} {getattr(asked, asked.measure):.3g}{unit}"


def _planned(choice: TextureChoice) -> PlannedTexture:
    evaluator, chosen = choice.evaluator, choice.chosen
    measured = chosen.measured
    target = measured.target or RateTarget()
    return PlannedTexture(
        name=evaluator.texture.name,
        source=evaluator.texture.source,
        controller=evaluator.texture.controller,
        hand_speed_mm_s=evaluator.hand_speed_mm_s,
        over_position=evaluator.over_position,
        codec=measured.option.codec,
        model=measured.model,
        setting=measured.setting,
        rate=evaluator.band.rate,
        lowest=evaluator.band.lowest,
        highest=evaluator.band.highest,
        packet_samples=measured.packet_samples,
        refresh_packets=measured.refresh_packets,
        rate_mode=SETTING_MODE if measured.target is None else CAPPED_MODE,
        buffer_ms=chosen.buffer_ms,
        forecast=chosen.forecast,
        sha256=evaluator.texture.source.sha256(),
        capped_rate_bps=target.capped_rate_bps,
        packet_snr_db=target.snr_db,
    )
