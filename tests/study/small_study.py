"""A small study for tests, whose stimuli are made once."""

from functools import cache
from pathlib import Path

from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.study import stimuli
from vibrocast.study.study_file import Study, read_study
from vibrocast.study.trials import Stimulus

HEAD = """
name = "small"
title = "A small study"
seed = 5
stimulus_seconds = 0.2
gain_db = -12
actuator = "piezo-stack"
break_seconds = 0
"""
TEXTURES = """
[[textures]]
name = "rough"
surface = "rough"
seconds = 0.3
hand_speed_mm_s = 50
[[textures]]
name = "wood"
surface = "wood"
seconds = 0.3
hand_speed_mm_s = 50
"""
REFERENCE = """
[[conditions]]
name = "recording"
role = "reference"
"""
HIDDEN = """
[[conditions]]
name = "recording again"
role = "hidden reference"
"""
CODED = """
[[conditions]]
name = "fine"
codec = "mdct"
snr_db = 20
[[conditions]]
name = "coarse"
codec = "mdct"
snr_db = 6
"""
ANCHORS = """
[[conditions]]
name = "low"
role = "anchor"
lowpass_hz = 120
[[conditions]]
name = "middle"
role = "anchor"
lowpass_hz = 250
"""
CONDITIONS = {
    "degradation": REFERENCE + HIDDEN + CODED,
    "same_different": REFERENCE + CODED,
    "abx": REFERENCE + CODED,
    "two_alternative": REFERENCE + CODED,
    "mushra": REFERENCE + HIDDEN + CODED + ANCHORS,
    "paired_comparison": REFERENCE + CODED,
    "staircase": CODED.split('[[conditions]]\nname = "coarse"')[0],
}
"""The conditions of each method."""
STAIRCASE = """
[staircase]
start_db = 0
lowest_db = -60
highest_db = 0
reversals = 4
"""


def text_of(method: str, extra: str = "") -> str:
    """Return the study file of a method; `extra`: keys at its top."""
    staircase = STAIRCASE if method == "staircase" else ""
    return f'{HEAD}method = "{method}"\n{extra}{staircase}{TEXTURES}{CONDITIONS[method]}'


def study_of(folder: Path, method: str, extra: str = "") -> Study:
    """Write a study file, and return it as it is read."""
    path = folder / f"{method}.toml"
    path.write_text(text_of(method, extra))
    return read_study(path)


@cache
def stimuli_of(method: str, folder: Path) -> tuple[Stimulus, ...]:
    """Return the stimuli of a method's study."""
    return stimuli.prepare(study_of(folder, method), PIEZO_STACK)
