"""Puts simulated observers through the texture paper's listening study: `python -m studies.okamoto_study`."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
import polars as pl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from studies import page
from studies.texture_paper import HAND_SPEED_MM_S, PAPER_LEVELS, STRETCH_MM, generated_profiles
from vibrocast import textures
from vibrocast.evaluation import pictures
from vibrocast.evaluation.points import read_rows
from vibrocast.output.actuator import ACTUATORS
from vibrocast.study import statistics, stimuli
from vibrocast.study.analysis import ALPHA
from vibrocast.study.methods import MAIN, Answered, design
from vibrocast.study.observer import Observer
from vibrocast.study.simulation import SkinOf
from vibrocast.study.study_file import Study, StudyTexture, read_study
from vibrocast.study.trials import Answer

TABLES = Path(__file__).parent / "data" / "okamoto_tables.csv"
"""Tables 2 to 4 of S. Okamoto and Y. Yamada, IEEE Transactions on Haptics 6(1), 2013: t with DEGREES, and p."""
DEGREES = 9
"""Of freedom: ten people graded each texture."""
EXAMPLES = Path(__file__).parents[1] / "examples" / "studies"
PARTICIPANTS = 15
STUDIES = 100
"""Simulated studies of the design. Each has its own people, orders and noise, so their spread is that of the method."""
TEXTURES = ("wood", "sandpaper", "leather")
LINEAR, LOG, CUT = FAMILIES = ("linear", "log", "cut")
AGAIN, UNCOMPRESSED = "uncompressed again", "uncompressed"
EXCEPTIONS = {"wood": 8, "sandpaper": 10, "leather": 12}
"""Linear levels that the paper names as unexpectedly similar to the original."""
SENSITIVITIES = {LINEAR: (0.67, 0.87), CUT: (0.60, 1.15)}
"""The paper's ranges of d' at the limits of okamoto_pairs.toml: two people, 20 presentations of each condition."""
MODELS: tuple[statistics.Model, ...] = ("yes_no", "independent", "differencing")
CRITICAL_T = float(stats.t.ppf(1 - ALPHA / 2, DEGREES))
"""From this t on, a difference counts as noticed."""
SPREAD = (5, 50, 95)
"""Percentiles over the studies."""

Key = tuple[str, str]
"""Texture and condition."""
Values = NDArray[np.float64]


@dataclass(frozen=True)
class Published:
    """A row of the paper's Tables 2 to 4: a texture under a condition, its t and p."""

    texture: str
    family: str
    parameter: float
    t: float
    p: float

    @property
    def key(self) -> Key:
        """Texture and condition, as the study file names it."""
        return self.texture, f"{self.family} {self.parameter:g}"

    @property
    def is_noticed(self) -> bool:
        """Whether the test finds a difference."""
        return self.p < ALPHA


def read_tables() -> list[Published]:
    """Return the rows of TABLES."""
    return read_rows(TABLES, Published)


@dataclass(frozen=True)
class Result:
    """One texture under one condition. Of t and of the percentiles: over STUDIES simulated studies.

    `paper_t`, `paper_p`: from the paper's tables. `noticed_percent`: of the studies. `grade`: the mean, 0 = same to 3 =
    different. `energy_db`: of the coded texture over the uncompressed one. `snr_db`: against the uncompressed one.
    """

    texture: str
    family: str
    parameter: float
    paper_t: float
    paper_p: float
    t_low: float
    t: float
    t_high: float
    noticed_percent: float
    grade: float
    energy_db: float
    snr_db: float


@dataclass(frozen=True)
class Sensitivity:
    """d' of a condition at the paper's limits by one formula, in studies: the median and the 5 and 95 % percentiles."""

    texture: str
    family: str
    parameter: float
    formula: str
    paper_low: float
    paper_high: float
    low: float
    value: float
    high: float


@dataclass(frozen=True)
class Simulated:
    """Simulated studies: grades (studies, people) of each stimulus, and its t and whether it is noticed, (studies,)."""

    grades: Mapping[Key, Values]

    @cached_property
    def tests(self) -> Mapping[Key, tuple[Values, NDArray[np.bool_]]]:
        """t against the hidden reference, 0 where all people agree, and whether it is noticed."""
        found = {}
        for key, grades in self.grades.items():
            pairs = [statistics.t_test(each) for each in grades - self.grades[key[0], AGAIN]]
            t = np.array([0.0 if each is None else each for each, _ in pairs])
            found[key] = t, (t > 0) & np.array([p is not None and p < ALPHA for _, p in pairs])
        return found

    def agreement(self, table: Sequence[Published]) -> tuple[Values, Values]:
        """Return in how many rows of the table significance agrees, and Spearman's rho of t, both (studies,)."""
        noticed = np.array([self.tests[row.key][1] for row in table])
        paper = np.array([row.is_noticed for row in table])[:, None]
        t = np.array([self.tests[row.key][0] for row in table])
        rho = [float(stats.spearmanr(each, [row.t for row in table]).statistic) for each in t.T]
        return np.sum(noticed == paper, axis=0).astype(float), np.array(rho)


def limit(noticed: Mapping[float, bool], family: str) -> float | None:
    """Return the coarsest value from which on nothing is noticed, from the finest one on; None if that is noticed."""
    found = None
    for value in sorted(noticed, reverse=family != CUT):
        if noticed[value]:
            break
        found = value
    return found


@dataclass(frozen=True)
class Limit:
    """The limit of a texture: the paper's, and in which per cent of studies it came out as each value, most first."""

    texture: str
    family: str
    paper: float | None
    percent: Mapping[float | None, float]


def limits_of(simulated: Simulated, table: Sequence[Published], texture: str, family: str) -> list[float | None]:
    """Return the limit of a texture in each study, and last the paper's; none where the paper has no such rows."""
    rows = [row for row in table if (row.texture, row.family) == (texture, family)]
    studies = [*zip(*(simulated.tests[row.key][1] for row in rows), strict=True), [row.is_noticed for row in rows]]
    values = [row.parameter for row in rows]
    return [limit(dict(zip(values, each, strict=True)), family) for each in studies] if rows else []


def limits(simulated: Simulated, table: Sequence[Published]) -> list[Limit]:
    """Return the limits of all textures, among the paper's conditions."""
    found = []
    for texture, family in product(TEXTURES, FAMILIES):
        if every := limits_of(simulated, table, texture, family):
            *own, paper = every
            percent = {value: 100 * count / len(own) for value, count in Counter(own).most_common()}
            found.append(Limit(texture, family, paper, percent))
    return found


@dataclass(frozen=True)
class Similar:
    """Linear levels that the paper names as unexpectedly similar to the original.

    `worse`: by how much the mean grade is worse than that of the next finer levels; percentiles SPREAD over the
    studies. `percent`: of the studies in which it is not worse.
    """

    texture: str
    levels: int
    finer: float
    worse: Values
    percent: float


def similar(simulated: Simulated, table: Sequence[Published]) -> list[Similar]:
    """Return EXCEPTIONS as simulated observers grade them."""
    found = []
    for texture, levels in EXCEPTIONS.items():
        linear = [row.parameter for row in table if (row.texture, row.family) == (texture, LINEAR)]
        finer = min(each for each in linear if each > levels)
        grades = [simulated.grades[texture, f"{LINEAR} {each:g}"].mean(axis=1) for each in (levels, finer)]
        worse = grades[0] - grades[1]
        found.append(Similar(texture, levels, finer, np.percentile(worse, SPREAD), 100 * float(np.mean(worse <= 0))))
    return found


def orders(simulated: Simulated, table: Sequence[Published]) -> dict[str, float]:
    """Return the orders that the paper reports, with the per cent of studies that have them."""

    def reached(family: str, beyond: float) -> Values:
        """Return the limits (studies, textures); `beyond`: where everything is noticed."""
        every = [limits_of(simulated, table, texture, family)[:-1] for texture in TEXTURES]
        return np.array([[beyond if each is None else each for each in own] for own in every]).T

    levels, cuts = reached(LINEAR, np.inf), reached(CUT, -np.inf)
    grades = [
        [simulated.grades[texture, f"{LINEAR} {value}"].mean(axis=1) for value in PAPER_LEVELS] for texture in TEXTURES
    ]
    noticed = [simulated.tests[texture, f"{CUT} 0"][1] for texture in ("wood", "sandpaper")]
    holds = {
        "leather bears fewer linear levels than wood and sandpaper": levels[:, 2] < levels[:, :2].min(axis=1),
        "b0 rises from wood over sandpaper to leather": np.all(np.diff(cuts) > 0, axis=1),
        "a cut at the threshold, b0 = 0 dB, is noticed on wood and sandpaper": np.all(noticed, axis=0),
        "some coarser linear levels get a better mean grade": np.any(np.diff(grades, axis=1) < 0, axis=(0, 1)),
    }
    return {text: 100 * float(np.mean(each)) for text, each in holds.items()}


class Stage:
    """The stimuli of the study, prepared once, as simulated observers feel them."""

    def __init__(self, folder: Path) -> None:
        actuator = ACTUATORS["piezo-stack"]
        for name, profile in generated_profiles().items():
            count = round(1000 * STRETCH_MM / profile.spacing_um)
            textures.save_profile(folder / f"{name}.csv", replace(profile, heights_um=profile.heights_um[:count]))
        # The surfaces of the page on the texture paper.
        named = tuple(StudyTexture(name=name, file=f"{name}.csv", hand_speed_mm_s=HAND_SPEED_MM_S) for name in TEXTURES)
        self.graded, self.compared = (
            msgspec.structs.replace(read_study(EXAMPLES / name), textures=named, folder=str(folder))
            for name in ("okamoto.toml", "okamoto_pairs.toml")
        )
        prepared = {(each.texture, each.condition): each for each in stimuli.prepare(self.graded, actuator)}
        skin_of = SkinOf(tuple(prepared.values()), actuator)
        self._skins = {each.key: skin_of(each.key, 0.0) for each in prepared.values()}
        self.snr_db = {key: each.facts["snr_db"] or 0.0 for key, each in prepared.items()}
        self._energies = {
            key: float(np.sum(each.stream.with_gain(-each.gain_db).decode() ** 2)) for key, each in prepared.items()
        }

    def energy_db(self, key: Key) -> float:
        """Return the energy of a coded texture over that of the uncompressed one."""
        coded, whole = self._energies[key], self._energies[key[0], UNCOMPRESSED]
        return 10 * float(np.log10(coded / whole)) if coded else -np.inf

    def simulate(self, study: Study, seeds: Sequence[int]) -> pl.DataFrame:
        """Let PARTICIPANTS take part once for each seed; return the answers.

        Columns: `seed`, `participant`, `texture`, `condition`, and `value` of the answer.
        """
        rows = []
        for seed, participant in product(seeds, range(1, PARTICIPANTS + 1)):
            observer = Observer(seed, participant)
            trials = design(msgspec.structs.replace(study, seed=seed), participant)
            history: list[Answered] = []
            while (trial := trials.next_trial(history)) is not None:
                felt = {each.label: self._skins[str(each.stimulus)] for each in trial.intervals}
                values = observer.answer(study.method, trial, felt)
                history.append(Answered(trial, Answer(values, 0.0, {})))
                if trial.phase == MAIN:
                    rows.append((seed, participant, trial.texture, trial.facts["condition"], values[0]))
        return pl.DataFrame(rows, ["seed", "participant", "texture", "condition", "value"], orient="row")

    def grades(self, seeds: Sequence[int]) -> Simulated:
        """Return the grades of simulated studies, one for each seed."""
        answers = self.simulate(self.graded, seeds)
        person = answers.group_by("texture", "condition", "seed", "participant").agg(pl.col("value").mean())
        stimulus = person.sort("seed", "participant").group_by("texture", "condition", maintain_order=True)
        grades = {key: own["value"].to_numpy().reshape(len(seeds), -1) for key, own in stimulus}
        return Simulated({(str(texture), str(condition)): own for (texture, condition), own in grades.items()})

    def sensitivities(self, seeds: Sequence[int]) -> list[Sensitivity]:
        """Return d' at the paper's limits by each formula, from pairs that are the same and that differ."""
        answers = self.simulate(self.compared, seeds)
        stimulus = answers.group_by("texture", "condition", "seed").agg(pl.col("value").sum(), pl.len())
        rows = []
        for texture, family in product(TEXTURES, (LINEAR, CUT)):
            own = stimulus.filter(texture=texture).sort("seed")
            different = own.filter(pl.col("condition").str.starts_with(family))
            counts = [each.select("value", "len").rows() for each in (different, own.filter(condition=UNCOMPRESSED))]
            rates = [statistics.rates(*hits, *false_alarms) for hits, false_alarms in zip(*counts, strict=True)]
            for model in MODELS:
                found = [statistics.sensitivity_same_different(*each, model) for each in rates]
                value, spread = float(different["condition"][0].split()[1]), np.percentile(found, SPREAD).tolist()
                rows.append(Sensitivity(texture, family, value, model, *SENSITIVITIES[family], *spread))
        return rows


def results(stage: Stage, simulated: Simulated, table: Sequence[Published]) -> list[Result]:
    """Return a row for each condition of the paper's tables."""
    rows = []
    for row in table:
        t, noticed = simulated.tests[row.key]
        low, median, high = np.percentile(t, SPREAD).tolist()
        noticed_percent, grade = 100 * float(np.mean(noticed)), float(np.mean(simulated.grades[row.key]))
        paper, quality = (row.t, row.p), (stage.energy_db(row.key), stage.snr_db[row.key])
        key = row.texture, row.family, row.parameter
        rows.append(Result(*key, *paper, low, median, high, noticed_percent, grade, *quality))
    return rows


NO_PEOPLE = "Simulated observers, not people: 5 to 95 % of the studies"
STYLES: Mapping[str, tuple[str, str, float]] = {
    LINEAR: ("o", pictures.BLUE, -0.12),
    LOG: ("s", pictures.ORANGE, 0.12),
    CUT: ("o", pictures.BLUE, 0.0),
}
"""Marker, colour and shift along x of each family; the paper's values are hollow and of the same shape."""


@contextmanager
def _figure(path: Path, width_in: float, height_in: float) -> Iterator[Figure]:
    """Yield a figure to draw on, which is written when the block succeeds. Raises OSError."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    yield figure
    for axes in figure.axes:
        axes.tick_params(labelsize=pictures.SMALL_POINTS)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color=pictures.PALE, linewidth=0.7)
    pictures.write(figure, path)


def draw_t(path: Path, rows: Sequence[Result]) -> None:
    """Draw t of the paper and of the simulated studies over levels and over b0, a column for each texture."""
    with _figure(path, 9.6, 5.6) as figure:
        figure.suptitle(NO_PEOPLE, fontsize=pictures.POINTS)
        grid = figure.subplots(2, len(TEXTURES), sharey=True, sharex="row")
        for (line, families), (column, texture) in product(enumerate(((LINEAR, LOG), (CUT,))), enumerate(TEXTURES)):
            axes = grid[line, column]
            for family in families:
                _draw_family(axes, family, [row for row in rows if (row.texture, row.family) == (texture, family)])
            axes.axhline(CRITICAL_T, color=pictures.INK, linestyle=":", linewidth=1.0)
            axes.set_yscale("symlog", linthresh=3, linscale=1.2)
            axes.set_yticks([0, 1, 2, 3, 5, 10, 20], ["0", "1", "2", "3", "5", "10", "20"])
            axes.set_title(texture, fontsize=pictures.POINTS)
            axes.set_xlabel("b0 of the cut, dB" if line else "levels L", fontsize=pictures.SMALL_POINTS)
        for axes in grid[:, 0]:
            axes.set_ylabel("t, 9 degrees of freedom", fontsize=pictures.SMALL_POINTS)
            axes.legend(fontsize=pictures.SMALL_POINTS, frameon=False)


def _draw_family(axes: Axes, family: str, rows: Sequence[Result]) -> None:
    """Draw the conditions of a family on a texture; nothing for a family that it lacks."""
    if rows:
        marker, colour, shift = STYLES[family]
        x = np.array([row.parameter for row in rows]) + shift
        t = np.array([(row.t, row.t - row.t_low, row.t_high - row.t) for row in rows]).T
        style: Any = {"color": colour, "markersize": 4, "elinewidth": 1.0, "linewidth": 0.8}
        name = "threshold cut" if family == CUT else f"{family} levels"
        axes.errorbar(x, t[0], t[1:], fmt=f"{marker}-", label=f"{name}: simulated", **style)
        hollow: Any = {"markersize": 7, "markerfacecolor": "none", "markeredgecolor": pictures.INK}
        axes.plot(x, [row.paper_t for row in rows], marker, label=f"{name}: the paper", **hollow)


FORMULAS: Mapping[str, tuple[str, str, str]] = {
    "yes_no": ("z(H) - z(F)", "o", pictures.BLUE),
    "independent": ("independent observation", "s", pictures.ORANGE),
    "differencing": ("differencing", "^", pictures.GREEN),
}
"""Name, marker and colour of each formula of d'."""


def draw_sensitivities(path: Path, rows: Sequence[Sensitivity]) -> None:
    """Draw d' at the paper's limits by each formula, with the paper's ranges."""
    with _figure(path, 7.2, 3.4) as figure:
        axes = figure.subplots()
        axes.set_title(NO_PEOPLE, fontsize=pictures.POINTS)
        places = list(dict.fromkeys((row.texture, row.family, row.parameter) for row in rows))
        for row in rows:
            place = places.index((row.texture, row.family, row.parameter))
            name, marker, colour = FORMULAS[row.formula]
            range_name, label = ("the paper's range", name) if place == 0 else (None, None)
            axes.fill_between(
                [row.paper_low, row.paper_high],
                place - 0.4,
                place + 0.4,
                color=pictures.PALE,
                label=range_name if row.formula == MODELS[0] else None,
            )
            y, width = place + 0.22 * (1 - MODELS.index(row.formula)), [[row.value - row.low], [row.high - row.value]]
            style: Any = {"color": colour, "markersize": 5, "elinewidth": 1.0}
            axes.errorbar(row.value, y, xerr=width, fmt=marker, label=label, **style)
        names = [f"{texture}, {setting(family, value)}" for texture, family, value in places]
        axes.set_yticks(range(len(places)), names)
        axes.invert_yaxis()
        axes.set_xlabel("d'", fontsize=pictures.SMALL_POINTS)
        axes.legend(fontsize=pictures.SMALL_POINTS, frameon=False)


def setting(family: str, value: float) -> str:
    """Return a condition as the page names it."""
    return f"b0 {value:+g} dB" if family == CUT else f"{family} L = {value:g}"


def markdown(
    rows: Sequence[Result],
    simulated: Simulated,
    table: Sequence[Published],
    sensitivities: Sequence[Sensitivity],
) -> str:
    """Return the page."""
    agreeing, rho = simulated.agreement(table)
    found = limits(simulated, table)
    noticed = sum(row.is_noticed for row in table)
    return page.render(
        "okamoto_study",
        globals(),
        rows={(row.texture, row.family, row.parameter): row for row in rows},
        table=table,
        agreeing=np.percentile(agreeing, SPREAD),
        rho=np.percentile(rho, SPREAD),
        constant=max(noticed, len(table) - noticed),
        limits=found,
        limits_percent=float(np.mean([each.percent.get(each.paper, 0.0) for each in found])),
        similar=similar(simulated, table),
        orders=orders(simulated, table),
        sensitivities=sensitivities,
        values={family: sorted({row.parameter for row in table if row.family == family}) for family in FAMILIES},
        setting=setting,
        hidden=[float(np.mean(simulated.grades[name, AGAIN])) for name in TEXTURES],
    )


@page.study
def main(out: Path) -> None:
    """Let simulated observers take part in the texture paper's study, and compare them with its tables."""
    table, seeds = read_tables(), range(1, STUDIES + 1)
    with TemporaryDirectory() as folder:
        stage = Stage(Path(folder))
        simulated = stage.grades(seeds)
        rows, sensitivities = results(stage, simulated, table), stage.sensitivities(seeds)
    name, folder_of_tables = "simulated_study", page.results_folder(out)
    draw_t(folder_of_tables / f"{name}.svg", rows)
    draw_sensitivities(folder_of_tables / f"{name}_sensitivity.svg", sensitivities)
    text = markdown(rows, simulated, table, sensitivities)
    tables: list[tuple[str, Sequence[Any], type[Any]]] = [
        (f"{name}.csv", [page.rounded(row, ".4g") for row in rows], Result),
        (f"{name}_sensitivity.csv", [page.rounded(row, ".4g") for row in sensitivities], Sensitivity),
    ]
    page.publish(out, "papers", text, tables)


if __name__ == "__main__":
    main()
