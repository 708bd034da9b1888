"""Puts simulated observers through the texture paper's listening study: `python -m studies.okamoto_study`."""

import csv
import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from studies import page
from studies.texture_paper import HAND_SPEED_MM_S, STRETCH_MM, generated_profiles
from vibrocast import textures
from vibrocast.evaluation import pictures
from vibrocast.files import atomic_write
from vibrocast.output.actuator import ACTUATORS
from vibrocast.study import statistics, stimuli
from vibrocast.study.analysis import ALPHA
from vibrocast.study.methods import MAIN, Answered, design
from vibrocast.study.observer import INTEGRATION_S, Observer, Skin
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
INTEGRATIONS_S = (0.2, 0.02, INTEGRATION_S, 0.005)
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
    with TABLES.open(newline="", encoding="utf-8") as file:
        return [
            Published(
                row["texture"], row["algorithm"].removesuffix("_db"), *map(float, (row["level"], row["t9"], row["p"]))
            )
            for row in csv.DictReader(file)
        ]


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


def limits(simulated: Simulated, table: Sequence[Published]) -> list[Limit]:
    """Return the limits of all textures, among the paper's conditions."""
    found = []
    for texture, family in itertools.product(TEXTURES, FAMILIES):
        rows = [row for row in table if (row.texture, row.family) == (texture, family)]
        if rows:
            studies = np.array([simulated.tests[row.key][1] for row in rows]).T
            values = [row.parameter for row in rows]
            counts = Counter(limit(dict(zip(values, each, strict=True)), family) for each in studies.tolist())
            paper = limit({row.parameter: row.is_noticed for row in rows}, family)
            percent = {value: 100 * count / len(studies) for value, count in counts.most_common()}
            found.append(Limit(texture, family, paper, percent))
    return found


def agreeing_percent(found: Sequence[Limit]) -> float:
    """Return in how many per cent of all studies and limits the paper's came out."""
    return float(np.mean([each.percent.get(each.paper, 0.0) for each in found]))


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
        finer = min(row.parameter for row in table if row.texture == texture and row.family == LINEAR
                    and row.parameter > levels)  # fmt: skip
        grades = [simulated.grades[texture, f"{LINEAR} {each:g}"].mean(axis=1) for each in (levels, finer)]
        worse = grades[0] - grades[1]
        found.append(Similar(texture, levels, finer, np.percentile(worse, SPREAD), 100 * float(np.mean(worse <= 0))))
    return found


def orders(simulated: Simulated, table: Sequence[Published]) -> dict[str, float]:
    """Return the orders that the paper reports, with the per cent of studies that have them."""
    studies = len(simulated.grades[TEXTURES[0], AGAIN])
    holds: dict[str, list[bool]] = {}
    for study in range(studies):

        def reached(texture: str, family: str, beyond: float, study: int = study) -> float:
            rows = [row for row in table if (row.texture, row.family) == (texture, family)]
            found = limit({row.parameter: bool(simulated.tests[row.key][1][study]) for row in rows}, family)
            return beyond if found is None else found

        levels, cuts = ([reached(name, *way) for name in TEXTURES] for way in ((LINEAR, np.inf), (CUT, -np.inf)))
        grades = [
            [simulated.grades[name, f"{LINEAR} {value}"][study].mean() for value in (14, 12, 10, 8, 6, 5, 4)]
            for name in TEXTURES
        ]
        noticed = [bool(simulated.tests[name, f"{CUT} 0"][1][study]) for name in ("wood", "sandpaper")]
        for text, is_so in (
            ("leather bears fewer linear levels than wood and sandpaper", levels[2] < min(levels[:2])),
            ("b0 rises from wood over sandpaper to leather", cuts[0] < cuts[1] < cuts[2]),
            ("a cut at the threshold, b0 = 0 dB, is noticed on wood and sandpaper", all(noticed)),
            ("some coarser linear levels get a better mean grade", any(np.any(np.diff(each) < 0) for each in grades)),
        ):
            holds.setdefault(text, []).append(bool(is_so))
    return {text: 100 * float(np.mean(each)) for text, each in holds.items()}


class Stage:
    """The stimuli of the study, prepared once, as simulated observers feel them."""

    def __init__(self, folder: Path) -> None:
        actuator = ACTUATORS["piezo-stack"]
        for name, profile in generated_profiles().items():
            count = round(1000 * STRETCH_MM / profile.spacing_um)
            textures.save_profile(folder / f"{name}.csv", replace(profile, heights_um=profile.heights_um[:count]))
        self.graded, self.compared = (
            _with_profiles(read_study(EXAMPLES / name), folder) for name in ("okamoto.toml", "okamoto_pairs.toml")
        )
        prepared = stimuli.prepare(self.graded, actuator)
        skin_of = SkinOf(prepared, actuator)
        self.facts = {(each.texture, each.condition): each.facts for each in prepared}
        self._skins = {each.key: skin_of(each.key, 0.0) for each in prepared}
        self._heights = {
            (each.texture, each.condition): each.stream.with_gain(-each.gain_db).decode() for each in prepared
        }

    def energy_db(self, key: Key) -> float:
        """Return the energy of a coded texture over that of the uncompressed one."""
        coded, whole = (float(np.sum(self._heights[key[0], name] ** 2)) for name in (key[1], UNCOMPRESSED))
        return 10 * float(np.log10(coded / whole)) if coded else -np.inf

    def simulate(
        self, study: Study, seeds: Iterable[int], integration_s: float
    ) -> dict[Key, list[dict[int, list[int]]]]:
        """Let PARTICIPANTS take part once for each seed; return answers of each stimulus by study and participant."""
        skins: Mapping[str, Skin] = {
            key: replace(skin, integration_s=integration_s) for key, skin in self._skins.items()
        }
        found: dict[Key, list[dict[int, list[int]]]] = {}
        seeds = list(seeds)
        for number, seed in enumerate(seeds):
            drawn = msgspec.structs.replace(study, seed=seed)
            for participant in range(1, PARTICIPANTS + 1):
                observer, trials = Observer(seed, participant), design(drawn, participant)
                history: list[Answered] = []
                while (trial := trials.next_trial(history)) is not None:
                    felt = {each.label: skins[str(each.stimulus)] for each in trial.intervals}
                    values = observer.answer(study.method, trial, felt)
                    history.append(Answered(trial, Answer(values, 0.0, {})))
                    if trial.phase == MAIN:
                        key = trial.texture, str(trial.facts["condition"])
                        by_study = found.setdefault(key, [{} for _ in seeds])
                        by_study[number].setdefault(participant, []).append(values[0])
        return found

    def grades(self, seeds: Iterable[int], integration_s: float = INTEGRATION_S) -> Simulated:
        """Return the grades of simulated studies, one for each seed."""
        answers = self.simulate(self.graded, seeds, integration_s)
        return Simulated(
            {
                key: np.array([[np.mean(own) for _, own in sorted(people.items())] for people in by_study])
                for key, by_study in answers.items()
            }
        )

    def sensitivities(self, seeds: Iterable[int]) -> list[Sensitivity]:
        """Return d' at the paper's limits by each formula, from pairs that are the same and that differ."""
        answers = self.simulate(self.compared, seeds, INTEGRATION_S)
        rows = []
        for texture, family in itertools.product(TEXTURES, (LINEAR, CUT)):
            ((condition, by_study),) = [
                (name, own) for (of, name), own in answers.items() if of == texture and name.startswith(family)
            ]
            value = condition.split()[1]
            for model in MODELS:
                found = []
                for different, same in zip(by_study, answers[texture, UNCOMPRESSED], strict=True):
                    hits, false_alarms = (list(itertools.chain(*each.values())) for each in (different, same))
                    rates = statistics.rates(sum(hits), len(hits), sum(false_alarms), len(false_alarms))
                    found.append(statistics.sensitivity_same_different(*rates, model))
                spread = map(float, np.percentile(found, SPREAD))
                rows.append(Sensitivity(texture, family, float(value), model, *SENSITIVITIES[family], *spread))
        return rows


def _with_profiles(study: Study, folder: Path) -> Study:
    """Return a study with the surfaces of the page on the texture paper."""
    named = tuple(StudyTexture(name=name, file=f"{name}.csv", hand_speed_mm_s=HAND_SPEED_MM_S) for name in TEXTURES)
    return msgspec.structs.replace(study, textures=named, folder=str(folder))


def results(stage: Stage, simulated: Simulated, table: Sequence[Published]) -> list[Result]:
    """Return a row for each condition of the paper's tables."""
    rows = []
    for row in table:
        t, noticed = simulated.tests[row.key]
        low, median, high = np.percentile(t, SPREAD).tolist()
        rows.append(
            Result(
                texture=row.texture,
                family=row.family,
                parameter=row.parameter,
                paper_t=row.t,
                paper_p=row.p,
                t_low=low,
                t=median,
                t_high=high,
                noticed_percent=100 * float(np.mean(noticed)),
                grade=float(np.mean(simulated.grades[row.key])),
                energy_db=stage.energy_db(row.key),
                snr_db=stage.facts[row.key]["snr_db"] or 0.0,
            )
        )
    return rows


@dataclass(frozen=True)
class Integration:
    """How simulated studies agree with the paper under another time of integration."""

    integration_s: float
    agreeing: Values
    rho: Values
    noticed_percent: float


def integrations(
    stage: Stage, simulated: Simulated, table: Sequence[Published], seeds: Sequence[int]
) -> list[Integration]:
    """Return the agreement for each of INTEGRATIONS_S, and who notices sandpaper with four linear levels.

    `simulated`: the studies with the observer's own.
    """
    found = []
    for integration_s in INTEGRATIONS_S:
        other = simulated if integration_s == INTEGRATION_S else stage.grades(seeds, integration_s)
        agreeing, rho = (np.percentile(each, SPREAD) for each in other.agreement(table))
        noticed = 100 * float(np.mean(other.tests["sandpaper", f"{LINEAR} 4"][1]))
        found.append(Integration(integration_s, agreeing, rho, noticed))
    return found


STYLES: Mapping[str, tuple[str, str]] = {
    LINEAR: ("o", pictures.BLUE),
    LOG: ("s", pictures.ORANGE),
    CUT: ("o", pictures.BLUE),
}
"""Marker and colour of each family; the paper's values are hollow and of the same shape."""


def _axes_style(axes: Axes) -> None:
    axes.tick_params(labelsize=pictures.SMALL_POINTS)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color=pictures.PALE, linewidth=0.7)


def draw_t(path: Path, rows: Sequence[Result]) -> None:
    """Draw t of the paper and of the simulated studies over levels and over b0, a column for each texture."""
    figure = Figure(figsize=(9.6, 5.6), layout="constrained")
    figure.suptitle("Simulated observers, not people: 5 to 95 % of the studies", fontsize=pictures.POINTS)
    grid = figure.subplots(2, len(TEXTURES), sharey=True, sharex="row")
    for (line, families), (column, texture) in itertools.product(
        enumerate(((LINEAR, LOG), (CUT,))), enumerate(TEXTURES)
    ):
        axes = grid[line, column]
        for family, shift in zip(families, (-0.12, 0.12), strict=False):
            own = [row for row in rows if (row.texture, row.family) == (texture, family)]
            if not own:
                continue
            marker, colour = STYLES[family]
            x = np.array([row.parameter for row in own]) + (shift if family != CUT else 0.0)
            t = np.array([(row.t, row.t - row.t_low, row.t_high - row.t) for row in own]).T
            style: Any = {"color": colour, "markersize": 4, "elinewidth": 1.0, "linewidth": 0.8}
            name = "threshold cut" if family == CUT else f"{family} levels"
            axes.errorbar(x, t[0], t[1:], fmt=f"{marker}-", label=f"{name}: simulated", **style)
            axes.plot(
                x, [row.paper_t for row in own], marker, markersize=7, markerfacecolor="none",
                markeredgecolor=pictures.INK, label=f"{name}: the paper",
            )  # fmt: skip
        axes.axhline(CRITICAL_T, color=pictures.INK, linestyle=":", linewidth=1.0)
        axes.set_yscale("symlog", linthresh=3, linscale=1.2)
        axes.set_yticks([0, 1, 2, 3, 5, 10, 20], ["0", "1", "2", "3", "5", "10", "20"])
        axes.set_title(texture, fontsize=pictures.POINTS)
        axes.set_xlabel("b0 of the cut, dB" if line else "levels L", fontsize=pictures.SMALL_POINTS)
        _axes_style(axes)
        if column == 0:
            axes.set_ylabel("t, 9 degrees of freedom", fontsize=pictures.SMALL_POINTS)
            axes.legend(fontsize=pictures.SMALL_POINTS, frameon=False)
    with atomic_write(path) as partial:
        pictures.write(figure, partial)


FORMULAS: Mapping[str, tuple[str, str, str]] = {
    "yes_no": ("z(H) - z(F)", "o", pictures.BLUE),
    "independent": ("independent observation", "s", pictures.ORANGE),
    "differencing": ("differencing", "^", pictures.GREEN),
}
"""Name, marker and colour of each formula of d'."""


def draw_sensitivities(path: Path, rows: Sequence[Sensitivity]) -> None:
    """Draw d' at the paper's limits by each formula, with the paper's ranges."""
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.set_title("Simulated observers, not people: 5 to 95 % of the studies", fontsize=pictures.POINTS)
    places = list(dict.fromkeys((row.texture, row.family, row.parameter) for row in rows))
    for place, key in enumerate(places):
        for row in rows:
            if (row.texture, row.family, row.parameter) == key:
                name, marker, colour = FORMULAS[row.formula]
                y = place + 0.22 * (1 - MODELS.index(row.formula))
                axes.fill_between(
                    [row.paper_low, row.paper_high], place - 0.4, place + 0.4, color=pictures.PALE,
                    label="the paper's range" if place == 0 and row.formula == MODELS[0] else None,
                )  # fmt: skip
                axes.errorbar(
                    row.value, y, xerr=[[row.value - row.low], [row.high - row.value]], fmt=marker, color=colour,
                    markersize=5, elinewidth=1.0, label=name if place == 0 else None,
                )  # fmt: skip
    axes.set_yticks(range(len(places)), [f"{texture}, {_setting(family, value)}" for texture, family, value in places])
    axes.invert_yaxis()
    axes.set_xlabel("d'", fontsize=pictures.SMALL_POINTS)
    _axes_style(axes)
    axes.legend(fontsize=pictures.SMALL_POINTS, frameon=False)
    with atomic_write(path) as partial:
        pictures.write(figure, partial)


def _setting(family: str, value: float) -> str:
    return f"b0 {value:+g} dB" if family == CUT else f"{family} L = {value:g}"


def markdown(
    rows: Sequence[Result],
    simulated: Simulated,
    table: Sequence[Published],
    sensitivities: Sequence[Sensitivity],
    integrated: Sequence[Integration],
    studies: int,
) -> str:
    """Return the page."""
    agreeing, rho = simulated.agreement(table)
    found = limits(simulated, table)
    noticed = sum(row.is_noticed for row in table)
    return page.render(
        "okamoto_study",
        rows={(row.texture, row.family, row.parameter): row for row in rows},
        table=table,
        studies=studies,
        participants=PARTICIPANTS,
        agreeing=np.percentile(agreeing, SPREAD),
        rho=np.percentile(rho, SPREAD),
        constant=max(noticed, len(table) - noticed),
        limits=found,
        limits_percent=agreeing_percent(found),
        similar=similar(simulated, table),
        orders=orders(simulated, table),
        sensitivities=sensitivities,
        formulas={key: name for key, (name, *_) in FORMULAS.items()},
        integrated=integrated,
        chosen_s=INTEGRATION_S,
        textures=TEXTURES,
        families=FAMILIES,
        cut=CUT,
        values={family: sorted({row.parameter for row in table if row.family == family}) for family in FAMILIES},
        setting=_setting,
        alpha=ALPHA,
        hidden=[float(np.mean(simulated.grades[name, AGAIN])) for name in TEXTURES],
    )


@page.study
@click.option("--studies", type=click.IntRange(2), default=STUDIES, show_default=True, help="Simulate so many.")
def main(studies: int, out: Path) -> None:
    """Let simulated observers take part in the texture paper's study, and compare them with its tables."""
    table, seeds = read_tables(), range(1, studies + 1)
    with TemporaryDirectory() as folder:
        stage = Stage(Path(folder))
        simulated = stage.grades(seeds)
        rows, sensitivities = results(stage, simulated, table), stage.sensitivities(seeds)
        integrated = integrations(stage, simulated, table, seeds)
    tables = page.results_folder(out)
    draw_t(tables / "simulated_study.svg", rows)
    draw_sensitivities(tables / "simulated_study_sensitivity.svg", sensitivities)
    text = markdown(rows, simulated, table, sensitivities, integrated, studies)
    short = [page.rounded(row, ".4g") for row in rows]
    short_sensitivities = [page.rounded(row, ".4g") for row in sensitivities]
    page.publish(
        out,
        "simulated_study",
        text,
        [("simulated_study.csv", short, Result), ("simulated_study_sensitivity.csv", short_sensitivities, Sensitivity)],
    )


if __name__ == "__main__":
    main()
