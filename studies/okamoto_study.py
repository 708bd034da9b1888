"""Puts simulated observers through the texture paper's listening study: `python -m studies.okamoto_study`."""

import itertools
import math
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.page import OUT, errors_in_one_line, render, results_folder, write_rows
from studies.page import write as write_page
from studies.texture_paper import HAND_SPEED_MM_S, PAPER_LEVELS, PUBLISHED, SIXTEEN_BITS, STRETCH_MM, generated_profiles
from vibrocast import pages, pictures, textures
from vibrocast.files import atomic_write
from vibrocast.host.study import analysis, statistics, stimuli
from vibrocast.host.study.analysis import ALPHA, Analysis
from vibrocast.host.study.simulation import SkinOf, simulate_participant
from vibrocast.host.study.study_file import Study, read_study
from vibrocast.host.study.trials import Stimulus
from vibrocast.output.actuator import ACTUATORS, Actuator

OBSERVERS = 10
"""Of each texture, as in the paper."""
REPETITIONS = 2
PAIRS = 4
"""Same-different trials of each condition and observer, half of them the same. The count is this study's own."""
LEVELS = (*PAPER_LEVELS, 20, 28, 40, 64, 128)
"""The paper's, and finer ones: an observer may notice all of the paper's."""
CUTS_DB = (-20, -16, -12, -8, -4, 0, 4, 8, 12)
"""The paper's range is -12 to 12 dB."""
LIMIT_HZ = 400
GAIN_DB = -6.0
"""Of all stimuli, so that no limit of the actuator acts."""
ACTUATOR = "piezo-stack"
UNCOMPRESSED, AGAIN = "uncompressed", "uncompressed again"
LINEAR, LOG, CUT = FAMILIES = ("linear", "log", "cut")
VALUES: Mapping[str, Sequence[float]] = {LINEAR: sorted(LEVELS), LOG: sorted(LEVELS), CUT: CUTS_DB}


@dataclass(frozen=True)
class Result:
    """One texture under one condition, as simulated observers judged it.

    `parameter`: levels L, or the offset b0 of the cut in dB. `mean_grade`: 0 = same to 3 = different. `t`, `p`: of the
    paired t-test against the hidden reference, without correction. `holm_p`: corrected over the conditions of the
    texture. `sensitivity`: d' of same-different trials, with its bootstrap interval.
    """

    texture: str
    family: str
    parameter: float
    snr_db: float | None
    mean_grade: float
    difference: float
    t: float | None
    p: float | None
    holm_p: float | None
    sensitivity: float | None
    sensitivity_low: float | None
    sensitivity_high: float | None

    @property
    def is_noticed(self) -> bool:
        """Whether the t-test finds a higher grade than that of the hidden reference."""
        return self.difference > 0 and (self.p is None or self.p < ALPHA)


def setting(family: str, parameter: float) -> str:
    """Return the setting of the codec dct in TOML."""
    levels = SIXTEEN_BITS if family == CUT else int(parameter)
    cut = f', threshold = "on", b0_db = {parameter:g}' if family == CUT else ""
    quantiser = LOG if family == LOG else LINEAR
    return (
        f'{{ quantiser = "{quantiser}", levels = {levels}, block = "whole", limit_hz = {LIMIT_HZ}, dc = "drop"{cut} }}'
    )


def conditions() -> dict[str, tuple[str, float]]:
    """Return family and parameter of each condition by its name."""
    return {f"{family} {value:g}": (family, value) for family in FAMILIES for value in VALUES[family]}


def study_file(method: str, repetitions: int, names: Iterable[str]) -> str:
    """Return the study of a method in TOML. The profile of each texture lies next to it, as NAME.csv.

    The uncompressed texture loses DC and all above 400 Hz too, so that quantisation alone is judged.
    """
    lines = [
        'name = "okamoto"',
        'title = "The listening study of the texture paper"',
        f'method = "{method}"',
        "seed = 2013",
        f"repetitions = {repetitions}",
        "trials_per_block = 1000",
        "stimulus_seconds = 5",
        "match_levels = false",
        f"gain_db = {GAIN_DB:g}",
    ]
    for name in names:
        lines += ["[[textures]]", f'name = "{name}"', f'file = "{name}.csv"', f"hand_speed_mm_s = {HAND_SPEED_MM_S:g}"]
    whole = setting(LINEAR, SIXTEEN_BITS)
    for name, role in ((UNCOMPRESSED, "reference"), (AGAIN, "hidden reference")):
        lines += ["[[conditions]]", f'name = "{name}"', f'role = "{role}"', 'codec = "dct"', f"setting = {whole}"]
    for name, (family, parameter) in conditions().items():
        lines += ["[[conditions]]", f'name = "{name}"', 'codec = "dct"', f"setting = {setting(family, parameter)}"]
    return "\n".join(lines) + "\n"


def first_stretch(profile: textures.Profile) -> textures.Profile:
    """Return the first 10 mm of a profile, the length of the paper's; a shorter one as it is."""
    count = round(1000 * STRETCH_MM / profile.spacing_um)
    return replace(profile, heights_um=profile.heights_um[:count])


def judge(profiles: Mapping[str, textures.Profile], observers: int, folder: Path) -> tuple[Analysis, Analysis]:
    """Let simulated observers grade all conditions and compare pairs; return both analyses. Raises StudyError."""
    actuator = ACTUATORS[ACTUATOR]
    for name, profile in profiles.items():
        textures.save_profile(folder / f"{name}.csv", first_stretch(profile))
    graded = _study(folder, "degradation", REPETITIONS, profiles)
    prepared = stimuli.prepare(graded, actuator)
    skin_of = SkinOf(prepared, actuator)
    found = []
    for study in (graded, _study(folder, "same_different", PAIRS // 2, profiles)):
        out = folder / study.method
        _simulate(study, prepared, skin_of, observers, out, actuator)
        found.append(analysis.analyse(out))
    return found[0], found[1]


def _study(folder: Path, method: str, repetitions: int, names: Iterable[str]) -> Study:
    path = folder / f"{method}.toml"
    path.write_text(study_file(method, repetitions, names), encoding="utf-8")
    return read_study(path)


def _simulate(
    study: Study, prepared: Sequence[Stimulus], skin_of: SkinOf, observers: int, out: Path, actuator: Actuator
) -> None:
    """Write the results folder of a study with simulated observers."""
    stimuli.save(out / analysis.STIMULI, tuple(prepared), actuator)
    (out / analysis.STUDY_FILE).write_bytes((Path(study.folder) / f"{study.method}.toml").read_bytes())
    for number in range(1, observers + 1):
        simulate_participant(study, prepared, skin_of, number, out / f"participant_{number:03}")


def results(graded: Analysis, compared: Analysis) -> list[Result]:
    """Return a row for each texture and condition."""
    sensitivities = {(each.texture, each.condition): each.sensitivity for each in compared.detections}
    snrs_db = {(each.texture, each.condition): each.facts["snr_db"] for each in graded.stimuli}
    families = conditions()
    rows = []
    for each in graded.ratings:
        if each.test is not None and each.condition in families:
            key = each.texture, each.condition
            d = sensitivities[key]
            rows.append(
                Result(
                    each.texture,
                    *families[each.condition],
                    snrs_db[key],
                    each.mean.value or 0.0,
                    each.test.difference,
                    each.test.t,
                    each.test.p,
                    each.test.holm_p,
                    d.value,
                    d.low,
                    d.high,
                )
            )
    return rows


def limit(rows: Iterable[Result], texture: str, family: str, among: Sequence[float]) -> float | None:
    """Return the coarsest value among some from which on nobody noticed a condition; None where all were noticed.

    The fewest levels, or the highest b0. It ends at the first value that is noticed, from the finest one on.
    """
    own = {row.parameter: row for row in rows if (row.texture, row.family) == (texture, family)}
    found = None
    for value in sorted(among, reverse=family != CUT):
        if own[value].is_noticed:
            break
        found = value
    return found


@dataclass(frozen=True)
class Fall:
    """Two neighbouring counts of levels of which the finer one got the worse grade.

    `p`: of the paired t-test, after Holm's correction over all steps of the texture.
    """

    texture: str
    coarse: float
    fine: float
    difference: float
    p: float | None


def falls(graded: Analysis, texture: str) -> list[Fall]:
    """Return where linear quantisation with more levels was graded as worse."""
    grades = {each.condition: each.by_participant for each in graded.ratings if each.texture == texture}
    steps = list(itertools.pairwise(sorted(LEVELS)))
    pairs = [(grades[f"{LINEAR} {fine:g}"], grades[f"{LINEAR} {coarse:g}"]) for coarse, fine in steps]
    tests = [statistics.paired_test(list(fine.values()), list(coarse.values())) for fine, coarse in pairs]
    corrected = statistics.holm([test.p for test in tests])
    return [
        Fall(texture, *step, test.difference, p)
        for step, test, p in zip(steps, tests, corrected, strict=True)
        if test.difference > 0
    ]


@dataclass(frozen=True)
class Claim:
    """A finding of the paper, and that of the simulated observers. `is_order`: it compares surfaces or settings."""

    text: str
    paper: str
    here: str
    agrees: bool
    is_order: bool


def claims(rows: Sequence[Result], falling: Sequence[Fall]) -> list[Claim]:
    """Return the paper's findings of its listeners, orders first, with those of simulated observers."""
    names = ("wood", "sandpaper", "leather")
    # Where even the finest is noticed, the limit lies beyond it.
    levels = {name: limit(rows, name, LINEAR, LEVELS) or math.inf for name in names}
    paper_levels = {name: limit(rows, name, LINEAR, PAPER_LEVELS) for name in names}
    cuts_db = {name: limit(rows, name, CUT, CUTS_DB) for name in names}
    heights_db = [-math.inf if value is None else value for value in cuts_db.values()]
    zero = {row.texture: row.is_noticed for row in rows if (row.family, row.parameter) == (CUT, 0)}
    worse = [each for each in falling if each.fine <= max(PAPER_LEVELS)]

    def order(text: str, holds: bool, here: str) -> Claim:
        return Claim(text, "yes", here, holds, is_order=True)

    found = [
        order(
            "leather bears fewer linear levels than wood and sandpaper",
            levels["leather"] < min(levels["wood"], levels["sandpaper"]),
            ", ".join(f"{name} {_level(value)}" for name, value in levels.items()),
        ),
        order(
            "b0 rises from wood over sandpaper to leather",
            heights_db == sorted(set(heights_db)) and len(set(heights_db)) == len(names),
            ", ".join(f"{name} {_cut(value)}" for name, value in cuts_db.items()),
        ),
        order(
            "a cut at the threshold, b0 = 0 dB, is noticed on wood and sandpaper",
            zero["wood"] and zero["sandpaper"],
            f"noticed on {pages.listed([name for name in names if zero[name]]) or 'none'}",
        ),
        order(
            "mean grades do not fall at every step to more linear levels",
            bool(worse),
            "; ".join(f"{each.texture}: {each.fine:g} worse than {each.coarse:g}" for each in worse) or "no such step",
        ),
    ]
    for name in names:
        paper, here = PUBLISHED[name].levels, paper_levels[name]
        text = f"{name}: fewest levels, of the paper's, that were not noticed"
        found.append(Claim(text, f"{paper}", "none" if here is None else f"{here:g}", here == paper, is_order=False))
    for name in names:
        paper_db, here_db = PUBLISHED[name].b0_db, cuts_db[name]
        text = f"{name}: highest b0 that was not noticed"
        found.append(Claim(text, _cut(paper_db), _cut(here_db), here_db == paper_db, is_order=False))
    return found


def _level(value: float) -> str:
    return f"{value:g}" if math.isfinite(value) else f"more than {max(LEVELS)}"


def _cut(value: float | None) -> str:
    return f"below {min(CUTS_DB):+g} dB" if value is None else f"{value:+g} dB"


def draw(path: Path, graded: Analysis) -> None:
    """Draw mean grades over levels and over the offset of the cut, a column for each of the paper's materials."""
    grades = {(each.texture, each.condition): each.mean for each in graded.ratings}
    names = list(PUBLISHED)
    figure = Figure(figsize=(9.6, 5.2), layout="constrained")
    figure.suptitle("Simulated observers, not people", fontsize=pictures.SMALL_POINTS, color=pictures.GREY)
    grid = figure.subplots(2, len(names), sharey=True, sharex="row")
    for column, name in enumerate(names):
        for row, (families, paper) in enumerate(
            (((LINEAR, LOG), PUBLISHED[name].levels), ((CUT,), PUBLISHED[name].b0_db))
        ):
            axes = grid[row, column]
            for family in families:
                _draw_grades(axes, family, {value: grades[name, f"{family} {value:g}"] for value in VALUES[family]})
            axes.axvline(paper, color=pictures.INK, linestyle=":", linewidth=1.2, label="the paper's limit")
            axes.set_title(name, fontsize=pictures.POINTS)
            axes.set_xlabel("b0 of the cut, dB" if row else "levels L", fontsize=pictures.SMALL_POINTS)
            axes.tick_params(labelsize=pictures.SMALL_POINTS)
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(color=pictures.PALE, linewidth=0.7)
            axes.set_ylim(-0.1, 3.1)
        grid[0, column].set_xscale("log", base=2)
        grid[0, column].set_xticks([4, 8, 16, 32, 64, 128], ["4", "8", "16", "32", "64", "128"])
    for axes in grid[:, 0]:
        axes.set_ylabel("mean grade", fontsize=pictures.SMALL_POINTS)
    grid[0, 0].legend(fontsize=pictures.SMALL_POINTS, frameon=False)
    with atomic_write(path) as partial:
        pictures.write(figure, partial)


def _draw_grades(axes: Axes, family: str, means: Mapping[float, statistics.Interval]) -> None:
    """Draw a line of mean grades with their intervals."""
    marker, colour = {LINEAR: ("o-", pictures.BLUE), LOG: ("s--", pictures.ORANGE), CUT: ("o-", pictures.BLUE)}[family]
    centre = np.array([each.value for each in means.values()], float)
    ends = np.array([(each.low, each.high) for each in means.values()], float)
    style: Any = {"color": colour, "markersize": 4, "linewidth": 1.2, "elinewidth": 0.8}
    axes.errorbar(list(means), centre, np.abs(ends.T - centre), fmt=marker, label=f"{family} levels", **style)


def markdown(graded: Analysis, rows: Sequence[Result], observers: int) -> str:
    """Return the page."""
    names = [each.name for each in graded.study.textures]
    falling = [fall for name in PUBLISHED for fall in falls(graded, name)]
    found = claims(rows, falling)
    return render(
        "okamoto_study",
        observers=observers,
        repetitions=REPETITIONS,
        pairs=PAIRS,
        gain_db=GAIN_DB,
        actuator=ACTUATOR,
        limit_hz=LIMIT_HZ,
        alpha=ALPHA,
        claims=found,
        orders=[each for each in found if each.is_order],
        measured=[name for name in names if name not in PUBLISHED],
        names=names,
        materials=list(PUBLISHED),
        steps=len(PUBLISHED) * (len(LEVELS) - 1),
        certain=[each for each in falling if each.p is not None and each.p < ALPHA],
        families=FAMILIES,
        cut=CUT,
        values=VALUES,
        max_levels=max(LEVELS),
        rows={(row.texture, row.family, row.parameter): row for row in rows},
        hidden=[each.mean.value for each in graded.ratings if each.condition == AGAIN],
        levels_db={each.texture: each.facts["level_db"] for each in graded.stimuli if each.condition == UNCOMPRESSED},
        limits={(name, family): limit(rows, name, family, VALUES[family]) for name in names for family in FAMILIES},
        falling=falling,
    )


def write(out: Path, profiles: Mapping[str, textures.Profile], observers: int) -> None:
    """Write OUT/simulated_study.md, and its table and picture in OUT/results. Raises StudyError, OSError."""
    with tempfile.TemporaryDirectory() as folder:
        graded, compared = judge(profiles, observers, Path(folder))
    rows = results(graded, compared)
    tables = results_folder(out)
    write_rows(tables / "simulated_study.csv", map(_rounded, rows), Result)
    draw(tables / "simulated_study.svg", graded)
    write_page(out / "simulated_study.md", markdown(graded, rows, observers))


def _rounded(row: Result) -> Result:
    values: Any = [float(f"{value:.4g}") if isinstance(value, float) else value for value in astuple(row)]
    return Result(*values)


@click.command()
@OUT
@click.option("--observers", type=click.IntRange(3), default=OBSERVERS, show_default=True, help="Simulate so many.")
@click.option(
    "--profiles",
    "folder",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Add measured height profiles, the CSV files of this folder.",
)
def main(out: Path, observers: int, folder: Path | None) -> None:
    """Let simulated observers take part in the texture paper's study, and compare their orderings with the paper's."""
    with errors_in_one_line():
        profiles = generated_profiles()
        for path in sorted(folder.glob("*.csv")) if folder else ():
            profiles[path.stem] = textures.load_profile(path)
        write(out, profiles, observers)
    click.echo(f"{out / 'simulated_study.md'}: {len(profiles)} surfaces, {observers} simulated observers")


if __name__ == "__main__":
    main()
