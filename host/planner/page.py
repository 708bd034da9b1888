"""What `vibrocast plan` shows besides the plan: the picture of all candidates, their tables, and lines for a person."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from msgspec import structs

from vibrocast import pages
from vibrocast.codec.rate_controlled import RateTarget
from vibrocast.evaluation.points import write_rows
from vibrocast.files import atomic_write
from vibrocast.host.planner.band import MARGIN_DB
from vibrocast.host.planner.choose import TextureChoice
from vibrocast.host.planner.plan_file import PlannedTexture
from vibrocast.host.planner.scene import Scene

CANDIDATES, BANDS, PICTURE, PLAN = "candidates.csv", "bands.csv", "plan.png", "plan.toml"
MAX_PANELS = 6
FAR_DB = 30.0
LABELS = {
    "snr_db": "SNR, dB",
    "spqi": "SPQI",
    "third_octave_distance_db": "third-octave distance, dB (less is better)",
    "imperceptible": "error re detection threshold, dB (less is better)",
}
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "p", "h")
_GREYS = ("0.0", "0.45", "0.7")


@dataclass(frozen=True)
class CandidateRow:
    """A line of candidates.csv; costs and qualities as in plan_file.Forecast. `short_of`: what is not enough.

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
    """Draw cost against quality of all candidates, a panel for each texture, the choice marked. Raises OSError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = choices[:MAX_PANELS]
    columns = 1 if len(shown) == 1 else 2
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(6.6 * columns, 4.2 * rows + 0.8), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    left = "" if len(shown) == len(choices) else f" (the first {len(shown)} of {len(choices)} textures)"
    figure.suptitle(
        f"{scene.path.name}: cost against quality of all candidates{left}", fontweight="bold", parse_math=False
    )
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    codecs = list(dict.fromkeys(each.measured.option.codec for choice in shown for each in choice.candidates))
    asked = scene.asked
    for axes, choice in zip(panels, shown, strict=False):
        points = [each for each in choice.candidates if each.quality is not None]
        low, high = _shown(scene, [each.quality for each in points if each.quality is not None])
        for place, name in enumerate(codecs):
            of_codec = [each for each in points if each.measured.option.codec == name]
            grey = _GREYS[place % len(_GREYS)]
            axes.scatter(
                [min(max(each.quality or 0.0, low), high) for each in of_codec],
                [each.cost for each in of_codec],
                marker=_MARKERS[place % len(_MARKERS)],
                s=20,
                facecolors=[grey if each.meets else "none" for each in of_codec],
                edgecolors=grey,
                linewidths=0.8,
                label=name,
            )
        chosen = choice.chosen
        if chosen.quality is not None:
            place_of_chosen = min(max(chosen.quality, low), high), chosen.cost
            axes.scatter(*place_of_chosen, marker="o", s=190, facecolors="none", edgecolors="black", linewidths=2)
            axes.annotate(
                f"{chosen.measured.option.name}\n"
                f"{chosen.forecast.wire_bps / 1e3:.2f} kbit/s, {chosen.forecast.delay_ms:.0f} ms",
                place_of_chosen,
                textcoords="offset points",
                xytext=(10, -24),
                fontsize="small",
                fontweight="bold",
                parse_math=False,
            )
        axes.axvline(wanted(scene), color="0.5", linestyle=(0, (5, 2)), linewidth=1)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
        axes.set_xlabel(f"{LABELS[asked.measure]}; dashed: what is asked; on the edge: beyond it")
        margin = 0.03 * (high - low)
        axes.set_xlim(low - margin, high + margin)
        axes.set_ylabel("weighted cost")
        axes.set_title(choice.name, loc="left", fontsize="medium", parse_math=False)
        axes.grid(alpha=0.3)
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    panels[0].legend(
        fontsize="x-small", ncols=2, title="filled: meets all that is asked; ringed: chosen", title_fontsize="x-small"
    )
    with atomic_write(path) as partial:
        figure.savefig(partial)


def _shown(scene: Scene, qualities: Sequence[float]) -> tuple[float, float]:
    """Return the range of qualities that a panel shows: all, but of decibels none farther than FAR_DB from the asked.

    One codec far off, such as a lossless one that overloads, would squeeze the others.
    """
    asked = wanted(scene)
    low, high = min([asked, *qualities]), max([asked, *qualities])
    if scene.asked.measure.endswith("_db") or scene.asked.measure == "imperceptible":
        low, high = max(low, asked - FAR_DB), min(high, asked + FAR_DB)
    return (low, high) if low < high else (low - 1, high + 1)


def wanted(scene: Scene) -> float:
    """Return the asked quality in its measure."""
    asked = scene.asked
    return MARGIN_DB if asked.measure == "imperceptible" else float(getattr(asked, asked.measure))


def summary(choice: TextureChoice, planned: PlannedTexture) -> str:
    """Return, in lines for a person, what was chosen for one texture, what it costs, and why."""
    left_out_db = [min(each.level_db, each.reach_db) for each in choice.evaluator.band.levels if not each.worth]
    return pages.render(
        Path(__file__).with_name("plan.txt.jinja"),
        texture=planned,
        chosen=choice.chosen.measured.option.name,
        unit="/m" if planned.over_position else " Hz",
        quality=choice.chosen.forecast,
        left_out_db=max(left_out_db) if left_out_db and not planned.over_position else None,
        reasons=choice.reasons,
    )
