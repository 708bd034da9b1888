"""Chooses how each texture of a scene is coded: the least weighted cost that meets what is asked, and says why."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from vibrocast.codec.rate_controlled import RateTarget
from vibrocast.files import InputFileError
from vibrocast.host.planner.band import MARGIN_DB, BandError
from vibrocast.host.planner.candidates import BUFFERS_MS, Candidate, Limit, Measured, Way, Workbench
from vibrocast.host.planner.plan_file import CAPPED_MODE, SETTING_MODE, Plan, PlannedController, PlannedTexture
from vibrocast.host.planner.scene import Asked, Scene

Progress = Callable[[float, str], None]
FIRST_PACKET_BLOCKS = 4
"""With packets of so many blocks a way's setting is looked for."""
_FINER, _FINER_ON_THE_WHOLE = 3, 16
"""Settings that are tried beyond the one found, in other packets, and on the whole of a long texture."""
_RATE_LIMITS = {"rate_limit_bps", "bytes_per_second"}
"""Keys of the limits that a capped rate may keep where no setting does."""


class PlanningError(InputFileError):
    """What a scene requires cannot be met; the message names the limits in the way, and says what to do."""


@dataclass(frozen=True)
class Reason:
    """Why a way was not chosen. `best`: the nearest that it came; None where it has no setting at all."""

    way: Way
    best: Candidate | None
    why: str


@dataclass(frozen=True)
class Choice:
    """What was chosen for a texture, among what, and why the others were not."""

    workbench: Workbench
    chosen: Candidate
    candidates: tuple[Candidate, ...]
    reasons: tuple[Reason, ...]

    @property
    def name(self) -> str:
        """Name of the texture."""
        return self.workbench.texture.name


def plan(scene: Scene, progress: Progress = lambda part, details: None) -> tuple[Plan, tuple[Choice, ...]]:
    """Plan every texture of a scene. Raises PlanningError, also for a texture of which nothing can be felt."""
    choices = []
    for place, texture in enumerate(scene.textures):

        def tell(part: float, details: str, place: int = place, name: str = texture.name) -> None:
            progress((place + part) / len(scene.textures), f"{name}: {details}")

        try:
            bench = Workbench(scene, texture)
        except BandError as error:
            raise PlanningError(f"{scene.path}: {error}") from error
        choices.append(choose(bench, scene, tell))
    planned = tuple(_planned(choice) for choice in choices)
    controllers = tuple(PlannedController(each.name, each.address, each.clock_hz) for each in scene.controllers)
    return Plan(scene.path, controllers, scene.actuators, planned, scene.threshold_path), tuple(choices)


def choose(bench: Workbench, scene: Scene, progress: Progress = lambda part, details: None) -> Choice:
    """Choose for one texture. Raises PlanningError."""
    found = _search(bench, scene, progress)
    if found is None:
        raise _impossible(bench, scene)
    chosen, bests = found
    candidates = tuple(bench.judged(measured, scene) for measured in bench.measured)
    reasons = tuple(
        Reason(way, best, _why(bench, way, best, chosen, scene))
        for way, best in bests.items()
        if way != chosen.measured.way
    )
    return Choice(bench, chosen, candidates, (_coarser(bench, chosen, scene, candidates), *reasons))


def _search(
    bench: Workbench, scene: Scene, progress: Progress = lambda part, details: None
) -> tuple[Candidate, dict[Way, Candidate | None]] | None:
    """Return the cheapest candidate that meets all, and the nearest that each way came; None where none meets all.

    The rate is capped where it has to be: to code by a setting takes fewer bits, but more of them in a loud second.
    """
    ways = bench.ways(scene.controller(bench.texture.controller).core)
    chosen, bests = _search_among(bench, scene, ways, progress)
    if chosen is None:
        chosen, capped = _search_among(bench, scene, _capped(bench, scene, ways), progress)
        bests |= capped
    return None if chosen is None else (chosen, bests)


def _capped(bench: Workbench, scene: Scene, ways: list[Way]) -> list[Way]:
    """Return, with their rate capped, those ways that have the quality and lack no more than rate."""
    limit_bps = scene.asked.rate_limit_bps
    if limit_bps is None or bench.over_position:
        return []
    candidates = [bench.judged(measured, scene) for measured in bench.measured]
    enough = {
        candidate.measured.way
        for candidate in candidates
        if candidate.lack <= 0 and {limit.key for limit in candidate.broken} <= _RATE_LIMITS
    }
    return [replace(way, rate_limit_bps=limit_bps) for way in ways if way in enough]


def _search_among(
    bench: Workbench, scene: Scene, ways: list[Way], progress: Progress
) -> tuple[Candidate | None, dict[Way, Candidate | None]]:
    """Return the cheapest candidate of these ways that meets all, if there is one, and the nearest that each came.

    A way is given up where it already costs more than the best one does without having the quality: finer costs more.
    """
    meeting: list[tuple[Candidate, Way, int, int]] = []
    bests: dict[Way, Candidate | None] = {}
    for place, way in enumerate(ways):
        progress(place / len(ways), way.name)
        bound = min((candidate.cost for candidate, *_ in meeting), default=math.inf)
        found = list(_of_way(bench, scene, way, bound))
        bests[way] = min((candidate for candidate, *_ in found), key=_preference, default=None)
        meeting += [(candidate, way, index, blocks) for candidate, index, blocks in found if candidate.meets]
    for _, way, index, blocks in sorted(meeting, key=lambda each: each[0].cost):
        whole = _on_the_whole(bench, scene, way, index, blocks)
        if whole is not None:
            return whole, {**bests, way: whole}
    return None, bests


def _of_way(bench: Workbench, scene: Scene, way: Way, bound: float) -> Iterator[tuple[Candidate, int, int]]:
    """Yield candidates of a way, each with the place of its setting and the blocks in its packets.

    First the coarsest setting with the asked quality is found, by halving; then packets of other lengths are tried.
    """
    first_length = _first_length(bench, way)
    low, high, found = 0, len(bench.qualities(way)) - 1, None
    while low <= high:
        middle = (low + high) // 2
        candidate = _candidate(bench, scene, way, middle, first_length)
        if candidate is not None:
            yield candidate, middle, first_length
        if candidate is not None and candidate.lack <= 0:
            found, high = candidate, middle - 1
            place = middle
        elif candidate is not None and candidate.cost >= bound:
            return
        else:
            low = middle + 1
    if found is None:
        return
    for blocks in _other_lengths(bench, scene, way, found, first_length):
        # A packet's length moves the quality a little, as refreshes lie elsewhere.
        for index in range(place, min(place + _FINER, len(bench.qualities(way)))):
            candidate = _candidate(bench, scene, way, index, blocks)
            if candidate is not None:
                yield candidate, index, blocks
                if candidate.lack <= 0:
                    break


def _other_lengths(bench: Workbench, scene: Scene, way: Way, found: Candidate, blocks: int) -> list[int]:
    """Return the packet lengths left to try, in blocks, where `found` has so many: the usual ones, and the longest that
    the asked delay leaves room for, which have the fewest frames.
    """
    lengths = set(bench.packet_blocks(way))
    if scene.asked.delay_limit_ms is not None and not bench.over_position:
        block_ms = 1e3 * found.measured.packet_samples / blocks / bench.samples_per_second
        for buffer_ms in BUFFERS_MS:
            left_ms = scene.asked.delay_limit_ms - (found.forecast.delay_ms - found.buffer_ms) - buffer_ms
            longest = blocks + math.floor(left_ms / block_ms)
            if 0 < longest <= max(lengths):
                lengths.add(longest)
    return sorted(lengths - {blocks})


def _first_length(bench: Workbench, way: Way) -> int:
    if way.rate_limit_bps is not None:
        return bench.packet_blocks(way)[-1]  # the fewest frames leave the most for quality
    return min(bench.packet_blocks(way), key=lambda blocks: abs(blocks - FIRST_PACKET_BLOCKS))


def _candidate(
    bench: Workbench, scene: Scene, way: Way, index: int, blocks: int, whole: bool = False
) -> Candidate | None:
    measured = bench.code(way, index, blocks, whole)
    return None if measured is None else bench.judged(measured, scene)


def _on_the_whole(bench: Workbench, scene: Scene, way: Way, index: int, blocks: int) -> Candidate | None:
    """Return the candidate measured on all of the texture, a little finer where that is needed; None where it fails."""
    for finer in range(index, min(index + _FINER_ON_THE_WHOLE, len(bench.qualities(way)))):
        candidate = _candidate(bench, scene, way, finer, blocks, whole=True)
        if candidate is not None and candidate.lack <= 0:
            return candidate if candidate.meets else None
    return None


def _preference(candidate: Candidate) -> tuple[bool, int, float, float]:
    """Order a way's candidates: what meets all first, the cheapest of those; else what is nearest to it."""
    return not candidate.meets, len(candidate.broken), max(0.0, candidate.lack), candidate.cost


def _coarser(bench: Workbench, chosen: Candidate, scene: Scene, candidates: tuple[Candidate, ...]) -> Reason:
    """Return why no coarser setting of the chosen way was taken."""
    way = chosen.measured.way
    short = [each for each in candidates if each.measured.way == way and each.lack > 0 and each.cost < chosen.cost]
    nearest = min(short, key=lambda each: each.lack, default=None)
    if nearest is None:
        return Reason(way, None, "it has no coarser setting")
    return Reason(way, nearest, f"coarser: cheaper, but not enough: {reached(nearest, scene.asked)}")


def _why(bench: Workbench, way: Way, best: Candidate | None, chosen: Candidate, scene: Scene) -> str:
    """Return in a line why a way was not chosen."""
    if best is None and way.rate_limit_bps is not None:
        return "cannot be held to this rate"
    if best is None:
        return "cannot code this signal at this rate"
    if best.meets:
        return f"not needed: costs {best.cost:.3g} instead of {chosen.cost:.3g} ({_differences(best, chosen, scene)})"
    told = _short_of(best, scene, bench.texture.controller)
    if best.cost >= chosen.cost:
        return f"not needed: costs {best.cost:.3g} instead of {chosen.cost:.3g}, and is not enough: {'; '.join(told)}"
    return f"cheaper, but not enough: {'; '.join(told)}"


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
    """Return the quality of a candidate beside the asked one."""
    if candidate.quality is None:
        return "silent"
    if asked.measure == "imperceptible":
        return f"its error is {candidate.quality:+.1f} dB re the detection threshold, {MARGIN_DB:g} are asked"
    wanted = getattr(asked, asked.measure)
    return f"{asked.measure} {candidate.quality:.3g}, {wanted:.3g} is asked"


def _needs(limit: Limit, controller: str) -> str:
    return f"needs {limit.place(controller)} = {limit.needed:.4g}, the scene has {limit.available:.4g}"


def _impossible(evaluator: Workbench, scene: Scene) -> PlanningError:
    """Return the error that names the limits in the way, by the candidate that comes nearest to what is required."""
    candidates = [evaluator.judged(measured, scene) for measured in evaluator.measured]
    name, controller = evaluator.texture.name, evaluator.texture.controller
    if not candidates:
        return PlanningError(
            f"{scene.path}: {name}: no codec that {controller} decodes takes this signal; give another controller"
        )
    enough = [candidate for candidate in candidates if candidate.lack <= 0 and candidate.broken]
    if enough:
        nearest = min(enough, key=lambda candidate: _octaves_over(candidate.broken))
        action = "raise that, or require less"
    else:
        nearest = min(candidates, key=lambda candidate: candidate.lack)
        action = "require less"
    return PlanningError(
        f"{scene.path}: {name} cannot be planned: {nearest.measured.way.name} comes nearest: "
        f"{'; '.join(_short_of(nearest, scene, controller))}; {action}"
    )


def _octaves_over(broken: Sequence[Limit]) -> float:
    """Return by how many octaves limits are exceeded, all together."""
    return sum(math.log2(limit.needed / limit.available) for limit in broken if limit.available)


def _short_of(candidate: Candidate, scene: Scene, controller: str) -> list[str]:
    """Return what a candidate lacks: quality, and the limits that it breaks."""
    return [reached(candidate, scene.asked)] * (candidate.lack > 0) + [
        _needs(limit, controller) for limit in candidate.broken
    ]


def _planned(choice: Choice) -> PlannedTexture:
    bench, chosen = choice.workbench, choice.chosen
    measured: Measured = chosen.measured
    target = measured.target or RateTarget()
    return PlannedTexture(
        name=bench.texture.name,
        source=bench.texture.source,
        controller=bench.texture.controller,
        hand_speed_mm_s=bench.hand_speed_mm_s,
        over_position=bench.over_position,
        codec=measured.way.codec,
        model=measured.way.model,
        setting=measured.setting,
        rate=bench.band.rate,
        lowest=bench.band.lowest,
        highest=bench.band.highest,
        packet_samples=measured.packet_samples,
        refresh_packets=measured.refresh_packets,
        rate_mode=SETTING_MODE if measured.target is None else CAPPED_MODE,
        buffer_ms=chosen.buffer_ms,
        forecast=chosen.forecast,
        sha256=bench.texture.source.sha256(),
        capped_rate_bps=target.capped_rate_bps,
        packet_snr_db=target.snr_db,
    )
