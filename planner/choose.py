"""Chooses how each texture of a scene is coded: the least weighted cost that meets the targets; and says why."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from vibrocast.codec.rate_control import RateTarget
from vibrocast.errors import InputError, located
from vibrocast.pages import listed
from vibrocast.planner.candidates import Evaluator
from vibrocast.planner.forecast import BUFFERS_MS, Candidate, CodingOption, costs_of, wanted
from vibrocast.planner.plan_file import Plan, PlannedController, PlannedTexture
from vibrocast.planner.scene import MEASURES, Asked, Scene, Weights

Progress = Callable[[float, str], None]
FIRST_PACKET_BLOCKS = 4
"""Length of packets with which the search for a setting of an option begins."""
_FINER, _FINER_ON_THE_WHOLE = 3, 16
"""Finer settings that the search tries after the one found, in other packets, and on the whole of a long texture."""
NEAREST = 3
"""Alternatives in the answer; candidates.csv has all candidates."""
_RATE_LIMITS = {"rate_limit_bps", "bytes_per_second"}
"""Keys of the limits that a capped rate may keep if no setting does."""


@dataclass(frozen=True)
class Reason:
    """Why an option was rejected. `best`: its candidate nearest to the targets; None if it has no setting."""

    option: CodingOption
    best: Candidate | None
    why: str


@dataclass(frozen=True)
class TextureChoice:
    """The choice for a texture, `why` it was chosen, all candidates, and why each other option was rejected.

    `compared`: the choice on the part of the texture on which options are compared.
    """

    evaluator: Evaluator
    chosen: Candidate
    compared: Candidate
    why: str
    candidates: tuple[Candidate, ...]
    reasons: tuple[Reason, ...]

    @property
    def name(self) -> str:
        """Name of the texture."""
        return self.evaluator.subject.texture.name

    @property
    def alternatives(self) -> tuple[Reason, ...]:
        """The NEAREST other options in cost: first those that meet the targets, then those that miss one."""
        measured = [(each, each.best) for each in self.reasons if each.best is not None]
        measured.sort(key=lambda pair: (not pair[1].meets, abs(pair[1].cost - self.compared.cost)))
        return tuple(reason for reason, _ in measured[:NEAREST])


def plan(scene: Scene, progress: Progress = lambda part, details: None) -> tuple[Plan, tuple[TextureChoice, ...]]:
    """Plan every texture of a scene. Raises InputError, also for a texture that nobody can feel.

    `progress`: called with the share that is done, 0 to 1, and a text.
    """
    choices = []
    for place, texture in enumerate(scene.textures):

        def tell(part: float, details: str, place: int = place, name: str = texture.name) -> None:
            progress((place + part) / len(scene.textures), f"{name}: {details}")

        with located(scene.path):
            evaluator = Evaluator(scene, texture)
        choices.append(choose(evaluator, tell))
    planned = tuple(map(_planned, choices))
    controllers = tuple(PlannedController(each.name, each.address, each.clock_hz) for each in scene.controllers)
    return Plan(scene.path, controllers, scene.actuators, planned, scene.threshold_path), tuple(choices)


def choose(evaluator: Evaluator, progress: Progress = lambda part, details: None) -> TextureChoice:
    """Choose for one texture. Raises InputError.

    It caps the rate only if no setting keeps the limits, because a capped rate takes more bits on average.
    """
    search = _Search(evaluator, progress)
    options = evaluator.options()
    chosen = search.cheapest(options) or search.cheapest(search.capped(options))
    if chosen is None or search.compared is None:
        raise search.error()
    reasons = tuple(
        Reason(option, best, search.why_not(option, best, search.compared))
        for option, best in search.bests.items()
        if option != chosen.measured.option
    )
    return TextureChoice(
        evaluator, chosen, search.compared, search.why(search.compared), evaluator.candidates(), reasons
    )


class _Search:
    """The search for the cheapest candidate of one texture.

    `bests`: the best candidate of each option. `compared`: the chosen candidate where options are compared, on the
    loudest part of a long texture; None before there is a choice.
    """

    def __init__(self, evaluator: Evaluator, progress: Progress) -> None:
        self.bests: dict[CodingOption, Candidate | None] = {}
        self.compared: Candidate | None = None
        self._evaluator, self._scene, self._progress = evaluator, evaluator.scene, progress

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
        meeting.sort(key=lambda each: each[0].cost)
        for place, (candidate, option, index, blocks) in enumerate(meeting):
            whole = self._on_the_whole(option, index, blocks)
            if whole is not None and whole.meets:
                self.bests[option], self.compared = whole, candidate
                return whole
            later = (other for other, same, *_ in meeting[place + 1 :] if same == option)
            self.bests[option] = next(later, whole)
        return None

    def capped(self, options: list[CodingOption]) -> list[CodingOption]:
        """Return, with their rate capped, the options that have the quality and exceed only limits of the rate."""
        limit_bps = self._scene.asked.rate_limit_bps
        if limit_bps is None or self._evaluator.subject.over_position:
            return []
        enough = {
            candidate.measured.option
            for candidate in self._evaluator.candidates()
            if candidate.shortfall <= 0 and {limit.key for limit in candidate.broken} <= _RATE_LIMITS
        }
        return [replace(option, rate_limit_bps=limit_bps) for option in options if option in enough]

    def why_not(self, option: CodingOption, best: Candidate | None, compared: Candidate) -> str:
        """Return in a line why an option was rejected. `compared`: the choice."""
        if best is None and option.rate_limit_bps is not None:
            return "cannot hold this rate"
        if best is None:
            return "cannot code this signal at this rate"
        is_higher = best.cost >= compared.cost
        cost = f"{'higher' if is_higher else 'lower'} cost ({_apart(best.cost, compared.cost)})"
        if not best.meets:
            return f"{cost} {'and' if is_higher else 'but'} misses the target: {self._missing(best)}"
        extra = _dominant_extra(best, compared, self._scene.weights)
        return cost if extra is None else f"{cost}: {extra[1]}"

    def why(self, compared: Candidate) -> str:
        """Return in a sentence why an option was chosen, and how much more the next one costs."""
        options = len([best for best in self.bests.values() if best is not None])
        chosen = compared.measured.option
        others = [best for option, best in self.bests.items() if option != chosen and best is not None and best.meets]
        required = requirements(self._scene.asked)
        if not others:
            return f"the only one of {options} options that meets {required}"
        following = min(others, key=lambda best: best.cost)
        first = f"cheapest of {len(others) + 1} options that meet {required}; the next costs "
        extra = _dominant_extra(following, compared, self._scene.weights)
        if extra is None:
            return f"{first}the same"
        percent = 100 * (following.cost / compared.cost - 1) if compared.cost else math.inf
        more = "more" if percent == math.inf else f"{percent:.0f} % more" if percent >= 1 else "less than 1 % more"
        return f"{first}{more}, mainly {extra[0]}"

    def error(self) -> InputError:
        """Return the error: the requirement that cannot be met, the best that can be reached, and what to change."""
        texture, candidates, asked = self._evaluator.subject.texture, self._evaluator.candidates(), self._scene.asked
        where = f"{self._scene.path}: {texture.name}"
        if not candidates:
            return InputError(
                f"{where}: no codec that {texture.controller} decodes takes this signal; choose another controller"
            )
        within = [each for each in candidates if not each.broken and each.quality is not None]
        best = min(within, key=lambda each: each.shortfall, default=None)
        enough = [each for each in candidates if each.shortfall <= 0 and each.broken]
        if not enough:
            place = "the best is" if best is None else "the best within all limits is"
            best = best or min(candidates, key=lambda each: each.shortfall)
            return InputError(
                f"{where}: no codec reaches {target(asked)}; {place} {reached(best, asked)} "
                f"({best.measured.option.name}); {_lowered(best, asked) or 'choose another measure of quality'}"
            )
        nearest = min(enough, key=_octaves_over)
        exceeded = " and ".join(
            f"{limit.place(texture.controller)} = {limit.available:.9g}" for limit in nearest.broken
        )
        needed = " and ".join(f"{limit.key} = {_rounded_up(limit.needed)}" for limit in nearest.broken)
        within_limits = (
            "no setting keeps all limits"
            if best is None
            else f"the best within all limits is {reached(best, asked)} ({best.measured.option.name})"
        )
        limits = "the limit to this value" if len(nearest.broken) == 1 else "the limits to these values"
        lower = None if best is None else _lowered(best, asked)
        return InputError(
            f"{where}: no codec reaches {target(asked)} with {exceeded}; {nearest.measured.option.name} comes nearest "
            f"and needs {needed}; {within_limits}; raise {limits}{'' if lower is None else f', or {lower}'}"
        )

    def _missing(self, candidate: Candidate) -> str:
        """Return the quality of a candidate if it is too low, and the limits that it exceeds."""
        quality = [reached(candidate, self._scene.asked)] * (candidate.shortfall > 0)
        limits = [f"{limit.key} {limit.needed:.4g}, limit {limit.available:.4g}" for limit in candidate.broken]
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
            candidate = self._evaluator.evaluate(option, middle, first_length)
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
                candidate = self._evaluator.evaluate(option, index, blocks)
                if candidate is not None:
                    yield candidate, index, blocks
                    if candidate.shortfall <= 0:
                        break

    def _other_lengths(self, lengths: list[int], found: Candidate, blocks: int) -> list[int]:
        """Return the other packet lengths, in blocks, for an option whose candidate `found` has `blocks`.

        The usual ones, and the longest within the delay limit, which have the fewest frames.
        """
        usual, limit_ms = set(lengths), self._scene.asked.delay_limit_ms
        if limit_ms is not None and not self._evaluator.subject.over_position:
            block_ms = 1e3 * found.measured.packet_samples / blocks / self._evaluator.subject.samples_per_second
            for buffer_ms in BUFFERS_MS:
                left_ms = limit_ms - (found.forecast.delay_ms - found.buffer_ms) - buffer_ms
                longest = blocks + math.floor(left_ms / block_ms)
                if 0 < longest <= max(usual):
                    usual.add(longest)
        return sorted(usual - {blocks})

    def _on_the_whole(self, option: CodingOption, index: int, blocks: int) -> Candidate | None:
        """Return the candidate measured on the whole texture, with a finer setting if needed.

        If no setting has the quality, return the finest one; None if the codec rejects the texture.
        """
        last = None
        for finer in range(index, min(index + _FINER_ON_THE_WHOLE, len(self._evaluator.qualities(option)))):
            candidate = self._evaluator.evaluate(option, finer, blocks, whole=True)
            last = candidate or last
            if candidate is not None and candidate.shortfall <= 0:
                return candidate
        return last


def _preference(candidate: Candidate) -> tuple[bool, int, float, float]:
    """Order an option's candidates: one that meets all first, the cheapest of those; else the nearest to it."""
    return not candidate.meets, len(candidate.broken), max(0.0, candidate.shortfall), candidate.cost


def _octaves_over(candidate: Candidate) -> float:
    """Return by how many octaves a candidate exceeds limits, all together."""
    return sum(math.log2(limit.needed / limit.available) for limit in candidate.broken if limit.available)


def _dominant_extra(best: Candidate, compared: Candidate, weights: Weights) -> tuple[str, str] | None:
    """Return the name of the cost that adds most to that of `best`, and by how much; None if none adds to it."""
    pairs = zip(costs_of(best.forecast, weights), costs_of(compared.forecast, weights), strict=True)
    extras = [((cost.amount - other.amount) / cost.per, cost) for cost, other in pairs]
    difference, cost = max(extras, key=lambda pair: pair[1].weight * pair[0])
    if cost.weight * difference <= 0:
        return None
    return cost.name, f"{difference:.{2 if difference < 10 else 3}g} {cost.more}"


def _apart(a: float, b: float) -> str:
    """Return "a vs b" with the fewest decimals, at least 2, that tell them apart."""
    digits = next((digits for digits in range(2, 9) if f"{a:.{digits}f}" != f"{b:.{digits}f}"), 2)
    return f"{a:.{digits}f} vs {b:.{digits}f}"


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


def requirements(asked: Asked) -> str:
    """Return all requirements: the quality, and the limits of rate and delay."""
    given = [target(asked)]
    if asked.rate_limit_bps is not None:
        given.append(f"{asked.rate_limit_bps:.9g} bit/s")
    if asked.delay_limit_ms is not None:
        given.append(f"{asked.delay_limit_ms:g} ms")
    return listed(given)


def reached(candidate: Candidate, asked: Asked) -> str:
    """Return the quality of a candidate in words."""
    return "silence" if candidate.quality is None else _quality(candidate.quality, asked, "+.1f")


def target(asked: Asked) -> str:
    """Return the required quality in words."""
    return _quality(wanted(asked), asked, "g")


def _quality(value: float, asked: Asked, error_form: str) -> str:
    if asked.measure == "imperceptible":
        return f"an error of {value:{error_form}} dB re the felt level"
    figure = MEASURES[asked.measure].figure
    return f"{figure.label} {value:.3g} {figure.unit}".rstrip()


def _planned(choice: TextureChoice) -> PlannedTexture:
    subject, chosen = choice.evaluator.subject, choice.chosen
    measured = chosen.measured
    target = measured.target or RateTarget()
    return PlannedTexture(
        name=subject.texture.name,
        source=subject.texture.source,
        controller=subject.texture.controller,
        hand_speed_mm_s=subject.hand_speed_mm_s,
        over_position=subject.over_position,
        codec=measured.option.codec,
        model=measured.model,
        setting=measured.setting,
        rate=subject.band.rate,
        lowest=subject.band.lowest,
        highest=subject.band.highest,
        packet_samples=measured.packet_samples,
        refresh_packets=measured.refresh_packets,
        buffer_ms=chosen.buffer_ms,
        forecast=chosen.forecast,
        sha256=subject.texture.source.sha256(),
        capped_rate_bps=target.capped_rate_bps,
        packet_snr_db=target.snr_db,
    )
