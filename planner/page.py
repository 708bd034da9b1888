"""Shows a plan: the answer as text or JSON, the picture of the candidates, and their tables."""

import csv
import json
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import structs

from vibrocast import pages
from vibrocast.codec.rate_control import RateTarget
from vibrocast.evaluation.pictures import figure_file
from vibrocast.files import atomic_write, plain
from vibrocast.planner.choose import TextureChoice
from vibrocast.planner.forecast import Candidate, wanted
from vibrocast.planner.plan_file import PlannedTexture
from vibrocast.planner.scene import MEASURES, Asked, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CANDIDATES, BANDS, PICTURE, PLAN = "candidates.csv", "bands.csv", "plan.png", "plan.toml"
MAX_PANELS = 6
WIDTH, INDENT = 80, 14
"""Columns of the answer, and of its labels."""
FAR_COST = 2.0
"""Multiple of the choice's cost up to which the picture shows candidates."""
_RINGS = (260, 170, 110, 70)
"""Sizes of the rings around the choice and its alternatives, which the legend names in this order."""
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "p", "h")
# Dark to light, so that grey print keeps them apart; markers differ as well.
_COLOURS = ("#20123a", "#0072b2", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#e69f00")


def write_tables(folder: Path, choices: Sequence[TextureChoice]) -> None:
    """Write candidates.csv and bands.csv: all candidates, and the third octaves of each texture. Raises OSError."""
    for name, rows_of in ((CANDIDATES, _candidate_rows), (BANDS, _band_rows)):
        rows = [row for choice in choices for row in rows_of(choice)]
        write_table(folder / name, list(rows[0]), rows)


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, object]]) -> None:
    """Write rows as CSV; None is an empty field. Raises OSError."""
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, columns, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def _candidate_rows(choice: TextureChoice) -> Iterator[dict[str, object]]:
    """Yield a row for each candidate; costs and qualities as in plan_file.Forecast.

    `short_of`: the requirements that it misses: "quality", or keys of limits. `packet_snr_db`, `capped_rate_bps`: of a
    capped rate, as in plan_file.PlannedTexture.
    """
    for candidate in choice.candidates:
        measured = candidate.measured
        target = measured.target or RateTarget()
        yield {
            "texture": choice.name,
            "codec": measured.option.codec,
            "model": measured.model,
            "setting": json.dumps(measured.setting),
            "packet_snr_db": target.snr_db,
            "capped_rate_bps": target.capped_rate_bps,
            "packet_samples": measured.packet_samples,
            "refresh_packets": measured.refresh_packets,
            "buffer_ms": candidate.buffer_ms,
            "cost": round(candidate.cost, 4),
            "quality": candidate.quality,
            "meets": candidate.meets,
            "chosen": candidate == choice.chosen,
            "short_of": "; ".join(["quality"] * (candidate.shortfall > 0) + [limit.key for limit in candidate.broken]),
            **structs.asdict(candidate.forecast),
        }


def _band_rows(choice: TextureChoice) -> Iterator[dict[str, object]]:
    """Yield a row for each third octave of a texture at the skin; levels are in dB re the detection threshold."""
    for each in choice.evaluator.subject.band.levels:
        levels = {name: round(getattr(each, name), 2) for name in ("frequency_hz", "level_db", "reach_db")}
        yield {"texture": choice.name, **levels, "worth_coding": each.worth}


def draw(path: Path, scene: Scene, choices: Sequence[TextureChoice]) -> None:
    """Draw cost against quality, a panel for each texture, with the choice and its alternatives. Raises OSError.

    A panel leaves out candidates that would squeeze the others (`is_near`), and states their number.
    """
    shown = choices[:MAX_PANELS]
    left = "" if len(shown) == len(choices) else f" (the first {len(shown)} of {len(choices)} textures)"
    title = f"{scene.path.name}: the choice and its alternatives{left}"
    codecs = list(dict.fromkeys(each.measured.option.codec for choice in choices for each in choice.candidates))
    with figure_file(path, 8.4, 4.2 * len(shown) + 0.6) as figure:
        figure.suptitle(title, fontweight="bold", parse_math=False)
        panels = figure.subplots(len(shown), 1, squeeze=False).ravel()
        for axes, choice in zip(panels, shown, strict=True):
            _draw_panel(axes, scene.asked, choice, codecs)


def _draw_panel(axes: "Axes", asked: Asked, choice: TextureChoice, codecs: Sequence[str]) -> None:
    alternatives = [(each.option, each.best) for each in choice.alternatives if each.best is not None]
    near = [each for each in choice.candidates if is_near(asked, choice, each)]
    for place, name in enumerate(codecs):
        own = [each for each in near if each.measured.option.codec == name]
        colour = _COLOURS[place % len(_COLOURS)]
        axes.scatter(
            [each.quality or 0.0 for each in own],
            [each.cost for each in own],
            marker=_MARKERS[place % len(_MARKERS)],
            s=26,
            facecolors=[colour if each.meets else "none" for each in own],
            edgecolors=colour,
            linewidths=0.9,
            label=name if own else "_",
        )
    forecast = choice.chosen.forecast
    chosen = f"{choice.chosen.measured.option.name}\n{forecast.wire_bps / 1e3:.2f} kbit/s, {forecast.delay_ms:.0f} ms"
    marked = [(chosen, choice.compared), *((option.name, best) for option, best in alternatives)]
    for (text, each), size in zip(marked, _RINGS, strict=False):
        if each in near:
            ring = axes.scatter([each.quality or 0.0], [each.cost], s=size, facecolors="none", edgecolors="black")
            ring.set_label(text)
    axes.axvline(wanted(asked), color="0.5", linestyle=(0, (5, 2)), linewidth=1)
    figure = MEASURES[asked.measure].figure
    less = " (less is better)" if figure.worse > 0 else ""
    axes.set_xlabel(f"{figure.title}{less}; dashed: the target")
    axes.set_ylabel("weighted cost")
    outside = len(choice.candidates) - len(near)
    note = f"; {outside} further candidates outside, see {CANDIDATES}" if outside else ""
    axes.set_title(f"{choice.name}{note}", loc="left", fontsize="medium", parse_math=False)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(
        fontsize="x-small",
        title="filled: meets all requirements;\nrings, from the largest: the choice, alternatives",
        title_fontsize="x-small",
        frameon=False,
        loc="upper left",
        bbox_to_anchor=(1.03, 1.0),
        borderaxespad=0,
    )


def is_near(asked: Asked, choice: TextureChoice, candidate: Candidate) -> bool:
    """Return whether the picture shows a candidate: near the target, and at most FAR_COST times the choice's cost.

    An alternative widens these limits, to twice as much at most. Silence has no quality, and no place.
    """
    if candidate.quality is None:
        return False
    factor = 2 if candidate in [each.best for each in choice.alternatives] else 1
    is_cheap = candidate.cost <= factor * FAR_COST * choice.compared.cost
    is_close = abs(candidate.quality - wanted(asked)) <= factor * MEASURES[asked.measure].far
    return candidate == choice.compared or (is_cheap and is_close)


def summary(asked: Asked, choice: TextureChoice, planned: PlannedTexture) -> str:
    """Return the answer for one texture in lines of WIDTH columns at most: the choice, then the alternatives."""
    text = pages.render(
        Path(__file__).with_name("plan.txt.jinja"),
        texture=planned,
        chosen=choice.chosen.measured.option.name,
        why=choice.why,
        settings=_settings(planned, choice.chosen),
        at_the_skin=asked.measure == "imperceptible",
        alternatives=choice.alternatives,
    )
    # Names come from files: what cannot be seen is escaped before lines are folded.
    return "\n".join(
        textwrap.fill(plain(line), WIDTH, subsequent_indent=" " * (INDENT if line.startswith(" ") else 2))
        for line in text.splitlines()
    )


def _settings(planned: PlannedTexture, chosen: Candidate) -> str:
    """Return the settings that the option's name does not state, the rate and the packets."""
    named = chosen.measured.option.given
    values = {name: value for name, value in planned.setting.items() if name not in named}
    listed = [
        f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}" for name, value in values.items()
    ]
    rate = f"{planned.rate} samples/m" if planned.over_position else f"{planned.rate} Hz"
    return "; ".join(filter(None, (", ".join(listed), f"{rate}, packets of {planned.packet_samples} samples")))


def document(choice: TextureChoice, planned: PlannedTexture) -> dict[str, object]:
    """Return the answer for one texture, ready for JSON. Costs are those on which options were compared."""
    return {
        "texture": planned.name,
        "choice": {
            "option": choice.chosen.measured.option.name,
            **{key: getattr(planned, key) for key in ("codec", "model", "setting", "rate", "packet_samples")},
            "controller": planned.controller,
            "cost": choice.compared.cost,
            "forecast": structs.asdict(planned.forecast),
        },
        "reason": choice.why,
        "alternatives": [
            {
                "option": each.option.name,
                "rejected": each.why,
                "meets": each.best.meets,
                "cost": each.best.cost,
                "quality": each.best.quality,
            }
            for each in choice.alternatives
            if each.best is not None
        ],
    }
