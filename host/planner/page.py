"""Shows a plan: the answer in lines or as JSON, the picture of the candidates, and their tables."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import structs

from vibrocast import pages
from vibrocast.codec.rate_controlled import RateTarget
from vibrocast.evaluation.points import write_rows
from vibrocast.files import atomic_write
from vibrocast.host.planner.band import MARGIN_DB
from vibrocast.host.planner.candidates import Candidate
from vibrocast.host.planner.choose import TextureChoice
from vibrocast.host.planner.plan_file import PlannedTexture
from vibrocast.host.planner.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CANDIDATES, BANDS, PICTURE, PLAN = "candidates.csv", "bands.csv", "plan.png", "plan.toml"
MAX_PANELS = 6
FAR_DB = 6.0
"""Decibels of quality around the target that the picture shows."""
FAR_COST = 2.0
"""Multiple of the choice's cost up to which the picture shows candidates."""
LABELS = {
    "snr_db": "SNR, dB",
    "spqi": "SPQI",
    "third_octave_distance_db": "third-octave distance, dB (less is better)",
    "imperceptible": "error re detection threshold, dB (less is better)",
}
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "p", "h")
# Dark to light, so that grey print keeps them apart; markers differ as well.
_COLOURS = ("#20123a", "#0072b2", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#e69f00")


@dataclass(frozen=True)
class CandidateRow:
    """A line of candidates.csv; costs and qualities as in plan_file.Forecast. `short_of`: the targets that it misses.

    `packet_snr_db`, `capped_rate_bps`: of a capped rate, as in plan_file.PlannedTexture.
    """

    texture: str
    codec: str
    model: str | None
    setting: str
    packet_snr_db: float | None
    capped_rate_bps: float | None
    packet_samples: int
    refresh_packets: int
    buffer_ms: float
    cost: float
    quality: float | None
    meets: bool
    chosen: bool
    short_of: str
    payload_bps: float
    wire_bps: float
    instructions_per_second: float | None
    load_percent: float | None
    flash_bytes: int | None
    ram_bytes: int | None
    snr_db: float | None
    spqi: float | None
    third_octave_distance_db: float | None
    error_over_threshold_db: float | None
    delay_ms: float


@dataclass(frozen=True)
class BandRow:
    """A line of bands.csv: a third octave of a texture at the skin, levels in dB re the detection threshold."""

    texture: str
    frequency_hz: float
    level_db: float
    reach_db: float
    worth_coding: bool


def write_tables(folder: Path, choices: Sequence[TextureChoice]) -> None:
    """Write candidates.csv and bands.csv. Raises OSError."""
    with atomic_write(folder / CANDIDATES) as path:
        write_rows(path, [row for choice in choices for row in _candidate_rows(choice)], CandidateRow)
    with atomic_write(folder / BANDS) as path:
        rows = [
            BandRow(
                choice.name, round(each.frequency_hz, 2), round(each.level_db, 2), round(each.reach_db, 2), each.worth
            )
            for choice in choices
            for each in choice.evaluator.band.levels
        ]
        write_rows(path, rows, BandRow)


def _candidate_rows(choice: TextureChoice) -> Iterator[CandidateRow]:
    for candidate in choice.candidates:
        measured = candidate.measured
        target = measured.target or RateTarget()
        yield CandidateRow(
            choice.name,
            measured.option.codec,
            measured.model,
            json.dumps(measured.setting),
            target.snr_db,
            target.capped_rate_bps,
            measured.packet_samples,
            measured.refresh_packets,
            candidate.buffer_ms,
            round(candidate.cost, 4),
            candidate.quality,
            candidate.meets,
            candidate == choice.chosen,
            "; ".join(["quality"] * (candidate.shortfall > 0) + [limit.key for limit in candidate.broken]),
            **structs.asdict(candidate.forecast),
        )


def draw(path: Path, scene: Scene, choices: Sequence[TextureChoice]) -> None:
    """Draw cost against quality, a panel for each texture, with the choice and its alternatives. Raises OSError.

    A panel leaves out candidates that would squeeze the others: far from the target, or many times as costly.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = choices[:MAX_PANELS]
    columns = 1 if len(shown) == 1 else 2
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(6.6 * columns, 4.4 * rows + 0.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    left = "" if len(shown) == len(choices) else f" (the first {len(shown)} of {len(choices)} textures)"
    figure.suptitle(f"{scene.path.name}: the choice and its alternatives{left}", fontweight="bold", parse_math=False)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    codecs = list(dict.fromkeys(each.measured.option.codec for choice in choices for each in choice.candidates))
    for axes, choice in zip(panels, shown, strict=False):
        _draw_panel(axes, scene, choice, codecs)
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    with atomic_write(path) as partial:
        figure.savefig(partial)


def _draw_panel(axes: "Axes", scene: Scene, choice: TextureChoice, codecs: Sequence[str]) -> None:
    near = [each for each in choice.candidates if _is_near(scene, choice.chosen, each)]
    for place, name in enumerate(codecs):
        own = [each for each in near if each.measured.option.codec == name]
        colour = _COLOURS[place % len(_COLOURS)]
        axes.scatter(
            [each.quality or 0.0 for each in own],
            [each.cost for each in own],
            marker=_MARKERS[place % len(_MARKERS)],
            s=22,
            facecolors=[colour if each.meets else "none" for each in own],
            edgecolors=colour,
            linewidths=0.8,
            label=name if own else "_",
        )
    marked = [choice.chosen, *(each.best for each in choice.alternatives if each.best in near)]
    for rank, candidate in enumerate(marked):
        if candidate is None or candidate.quality is None:
            continue
        text = candidate.measured.option.name
        if rank == 0:
            forecast = candidate.forecast
            text = f"{text}\n{forecast.wire_bps / 1e3:.2f} kbit/s, {forecast.delay_ms:.0f} ms"
            axes.scatter(candidate.quality, candidate.cost, s=190, facecolors="none", edgecolors="black", linewidths=2)
        axes.annotate(
            text,
            (candidate.quality, candidate.cost),
            textcoords="offset points",
            # The choice below its mark, the alternatives above theirs and apart.
            xytext=(12, -26) if rank == 0 else (14, 8 + 14 * rank),
            fontsize="small" if rank == 0 else "x-small",
            fontweight="bold" if rank == 0 else "normal",
            arrowprops=None if rank == 0 else {"arrowstyle": "-", "linewidth": 0.5, "color": "0.4"},
            parse_math=False,
        )
    axes.axvline(wanted(scene), color="0.5", linestyle=(0, (5, 2)), linewidth=1)
    axes.margins(x=0.12, y=0.18)
    axes.set_xlabel(f"{LABELS[scene.asked.measure]}; dashed: the target")
    axes.set_ylabel("weighted cost")
    outside = len(choice.candidates) - len(near)
    note = f"; {outside} more outside, see {CANDIDATES}" if outside else ""
    axes.set_title(f"{choice.name}{note}", loc="left", fontsize="medium", parse_math=False)
    axes.grid(alpha=0.3)
    axes.legend(
        fontsize="x-small", ncols=2, title="filled: meets all targets", title_fontsize="x-small", loc="upper left"
    )


def _is_near(scene: Scene, chosen: Candidate, candidate: Candidate) -> bool:
    """Return whether the picture shows a candidate: near the target, and at most FAR_COST times the choice's cost."""
    if candidate.quality is None or candidate.cost > FAR_COST * chosen.cost:
        return candidate == chosen
    in_decibels = scene.asked.measure.endswith("_db") or scene.asked.measure == "imperceptible"
    is_near = not in_decibels or abs(candidate.quality - wanted(scene)) <= FAR_DB
    return is_near or candidate == chosen


def wanted(scene: Scene) -> float:
    """Return the target quality in its measure."""
    asked = scene.asked
    return MARGIN_DB if asked.measure == "imperceptible" else float(getattr(asked, asked.measure))


def summary(choice: TextureChoice, planned: PlannedTexture) -> str:
    """Return the answer for one texture: the choice, its reason and forecast, and the nearest alternatives."""
    left_out_db = [min(each.level_db, each.reach_db) for each in choice.evaluator.band.levels if not each.worth]
    return pages.render(
        Path(__file__).with_name("plan.txt.jinja"),
        texture=planned,
        chosen=choice.chosen.measured.option.name,
        why=choice.why,
        unit="/m" if planned.over_position else " Hz",
        left_out_db=max(left_out_db) if left_out_db and not planned.over_position else None,
        alternatives=choice.alternatives,
    )


def document(choice: TextureChoice, planned: PlannedTexture) -> dict[str, object]:
    """Return the answer for one texture as JSON holds it."""
    return {
        "choice": choice.chosen.measured.option.name,
        "why": choice.why,
        "forecast": structs.asdict(planned.forecast),
        "alternatives": [
            {"option": each.option.name, "why": each.why, "cost": each.best.cost, "meets": each.best.meets}
            for each in choice.alternatives
            if each.best is not None
        ],
    }
