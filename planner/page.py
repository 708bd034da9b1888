"""Shows a plan: the answer as text or JSON, and the table of the candidates."""

import csv
import json
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from vibrocast import pages
from vibrocast.files import atomic_write, plain
from vibrocast.planner.choose import TextureChoice, why_not
from vibrocast.planner.scene import Asked

WIDTH, INDENT = 80, 14
"""Columns of the answer, and of its labels."""


def write_candidates(path: Path, choices: Sequence[TextureChoice]) -> None:
    """Write all candidates as CSV; costs and qualities as in forecast.Forecast, None is an empty field. Raises OSError.

    `short_of`: the requirements that it misses: "quality", or keys of limits.
    """
    rows = [
        {
            "texture": choice.name,
            "codec": each.measured.option.codec,
            "model": each.measured.model,
            "setting": json.dumps(each.measured.setting),
            "packet_samples": each.measured.packet_samples,
            "refresh_packets": each.measured.refresh_packets,
            "buffer_ms": each.buffer_ms,
            "cost": round(each.cost, 4),
            "quality": each.quality,
            "meets": each.meets,
            "chosen": each == choice.chosen,
            "short_of": "; ".join(["quality"] * (each.shortfall > 0) + [limit.key for limit in each.broken]),
            **asdict(each.forecast),
        }
        for choice in choices
        for each in choice.candidates
    ]
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def summary(asked: Asked, choice: TextureChoice) -> str:
    """Return the answer for one texture in lines of WIDTH columns at most: the choice, then the alternatives."""
    text = pages.render(
        Path(__file__).with_name("plan.txt.jinja"),
        choice=choice,
        forecast=choice.chosen.forecast,
        settings=_settings(choice),
        at_the_skin=asked.measure == "imperceptible",
        alternatives=[(each, why_not(asked, each, choice.compared)) for each in choice.alternatives],
    )
    # Names come from files: what cannot be seen is escaped before lines are folded.
    return "\n".join(
        textwrap.fill(plain(line), WIDTH, subsequent_indent=" " * (INDENT if line.startswith(" ") else 2))
        for line in text.splitlines()
    )


def _settings(choice: TextureChoice) -> str:
    """Return the settings that the option's name does not state, the rate and the packets."""
    measured, subject = choice.chosen.measured, choice.subject
    values = {name: value for name, value in measured.setting.items() if name not in measured.option.given}
    listed = [
        f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}" for name, value in values.items()
    ]
    rate = f"{subject.band.rate} {'samples/m' if subject.over_position else 'Hz'}"
    return "; ".join(filter(None, (", ".join(listed), f"{rate}, packets of {measured.packet_samples} samples")))


def document(asked: Asked, choice: TextureChoice) -> dict[str, object]:
    """Return the answer for one texture, ready for JSON. Costs are those on which options were compared."""
    measured, subject = choice.chosen.measured, choice.subject
    return {
        "texture": choice.name,
        "choice": {
            "option": measured.option.name,
            "codec": measured.option.codec,
            "model": measured.model,
            "setting": measured.setting,
            "rate": subject.band.rate,
            "band": (subject.band.lowest, subject.band.highest),
            "packet_samples": measured.packet_samples,
            "refresh_packets": measured.refresh_packets,
            "buffer_ms": choice.chosen.buffer_ms,
            "controller": subject.texture.controller,
            "cost": choice.compared.cost,
            "forecast": asdict(choice.chosen.forecast),
        },
        "reason": choice.why,
        "alternatives": [
            {
                "option": each.measured.option.name,
                "rejected": why_not(asked, each, choice.compared),
                "meets": each.meets,
                "cost": each.cost,
                "quality": each.quality,
            }
            for each in choice.alternatives
        ],
    }
