"""Shows a plan: the answer as text or JSON, and the table of the candidates."""

import csv
import json
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from vibrocast import pages
from vibrocast.files import atomic_write, plain
from vibrocast.planner.choose import TextureChoice, why_not
from vibrocast.planner.scene import Asked

WIDTH, INDENT = 80, 14
"""Columns of the answer, and of its labels."""


def write_candidates(path: Path, choices: Sequence[TextureChoice]) -> None:
    """Write all candidates as CSV; None is an empty field. Raises OSError."""
    rows = [row for choice in choices for row in _candidate_rows(choice)]
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def _candidate_rows(choice: TextureChoice) -> Iterator[dict[str, object]]:
    """Yield a row for each candidate; costs and qualities as in forecast.Forecast.

    `short_of`: the requirements that it misses: "quality", or keys of limits.
    """
    for candidate in choice.candidates:
        measured = candidate.measured
        yield {
            "texture": choice.name,
            "codec": measured.option.codec,
            "model": measured.model,
            "setting": json.dumps(measured.setting),
            "packet_samples": measured.packet_samples,
            "refresh_packets": measured.refresh_packets,
            "buffer_ms": candidate.buffer_ms,
            "cost": round(candidate.cost, 4),
            "quality": candidate.quality,
            "meets": candidate.meets,
            "chosen": candidate == choice.chosen,
            "short_of": "; ".join(["quality"] * (candidate.shortfall > 0) + [limit.key for limit in candidate.broken]),
            **asdict(candidate.forecast),
        }


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
