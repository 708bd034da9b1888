"""What a map of trials is made of: its trials, its picture, and the words that explain it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from codec import CODECS, Codec
from codec.interface import Setting
from evaluation.stability.trials import Cell, Trial


@dataclass(frozen=True)
class Scope:
    """How much to try. `codecs`: their names; `quick`: a grid of few conditions."""

    codecs: tuple[str, ...]
    quick: bool


@dataclass(frozen=True)
class Map:
    """One map. `name`: of its files. `varied`: how a cell's value is said, such as "{} dB"; "" without.

    `about`: what is tried and by which rules an outcome follows. `judged`: what makes of the cells those of the map,
    where an outcome depends on others. `draw`: writes the picture. `in_summary`: whether the page begins with it.
    """

    name: str
    title: str
    about: str
    varied: str
    trials: Callable[[Scope], list[Trial]]
    draw: Callable[[Path, Sequence[Cell]], None]
    judged: Callable[[list[Cell]], list[Cell]] = lambda cells: cells
    in_summary: bool = True


def three_settings(codec: Codec) -> dict[str, Setting]:
    """Return settings of a codec's first ladder: a quarter of the way up, half of it, and the finest."""
    ladder = next(iter(codec.ladders.values()))
    return {"low": ladder[len(ladder) // 4], "middle": ladder[len(ladder) // 2], "high": ladder[-1]}


def middle_setting(codec_name: str) -> Setting:
    """Return the middle setting of a codec's first ladder."""
    return three_settings(CODECS[codec_name])["middle"]
