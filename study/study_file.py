"""The study file: stimuli, method, order, breaks and questions of a listening study, in TOML.

docs/reference/toml_files.md lists its keys.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, field

from vibrocast import codec, textures
from vibrocast.errors import located
from vibrocast.host.bench_file import TextureTable
from vibrocast.textures import Recording
from vibrocast.textures.generate import SURFACES
from vibrocast.toml_tables import Table, Text, check_names, convert, one_of, read_each, read_toml, within

METHODS = (
    "degradation",
    "same_different",
    "abx",
    "two_alternative",
    "mushra",
    "paired_comparison",
    "staircase",
)
CONDITION, REFERENCE, HIDDEN_REFERENCE, ANCHOR = ROLES = ("condition", "reference", "hidden reference", "anchor")
# Muschter et al., IEEE Trans. Haptics 14(2), 2021, take two anchors, as ITU-R BS.1534-3 does.
MUSHRA_ANCHORS = 2
MIN_LEVELS = 3

Name = Annotated[str, Meta(pattern=r"\A[^\s/=\x00-\x1f\x7f](?:[^/=\x00-\x1f\x7f]{0,38}[^\s/=\x00-\x1f\x7f])?\Z",
                           description="a name of 1 to 40 characters without / and =")]  # fmt: skip
Seconds = Annotated[float, within(0.05, 60, "duration in s")]
Paragraph = Annotated[str, Meta(min_length=1, max_length=2000, description="a text of at most 2000 characters")]


class StudyTexture(TextureTable, frozen=True, kw_only=True):
    """An entry of [[textures]]: a file, a generator or a generated surface, under a name."""

    name: Name
    surface: Annotated[str, one_of(sorted(SURFACES))] | None = None
    hand_speed_mm_s: Annotated[float, within(1e-3, 1e4, "speed of the hand in mm/s")] | None = None

    def load(self, folder: Path) -> Recording:
        """Return the recording; names of files are relative to `folder`. Raises ValueError."""
        if self.surface is not None:
            return self._surface()
        options = self.options()
        if self.hand_speed_mm_s is not None:
            options["hand_speed_mm_s"] = self.hand_speed_mm_s
        if self.generate is not None:
            return textures.GENERATORS[self.generate](**options)
        return textures.load_for_actuators(folder / str(self.file), **options)

    def check(self, folder: Path) -> None:
        """Raise ValueError for keys that do not go together, or a file that is not there."""
        if self.surface is None:
            self.options()
        else:
            for key in ("file", "generate", "unit", "full_scale", "columns", "reduce", "key"):
                if getattr(self, key) is not None:
                    raise ValueError(f"{key} does not go with surface; leave one out")
            if self.hand_speed_mm_s is None:
                raise ValueError("hand_speed_mm_s is missing; give the speed of the hand over the surface in mm/s")
        names = (self.file,) if isinstance(self.file, str) else self.file or ()
        for name in names:
            if not (folder / name).exists():
                raise ValueError(f"file {folder / name} does not exist; correct its name")

    def _surface(self) -> Recording:
        """Return the displacement of a probe over a generated surface, um."""
        assert self.hand_speed_mm_s is not None, "checked"
        choices: dict[str, Any] = {"seed": self.seed, "seconds": self.seconds, "rate_hz": self.rate_hz}
        given = {key: value for key, value in choices.items() if value is not None}
        profile = textures.surface_profile(str(self.surface), hand_speed_mm_s=self.hand_speed_mm_s, **given)
        return profile.recording(self.hand_speed_mm_s)


class Condition(Table, frozen=True, kw_only=True):
    """An entry of [[conditions]]: how a texture is coded. Without `codec` and `model` it is the recording itself.

    `role`: one of ROLES. `textures`: the names of those that it is for; None = all. `touch`: as in `vibrocast.encode`.
    `lowpass_hz`: an anchor's corner. `gain_db`: a change of level on purpose.
    """

    name: Name
    role: Annotated[str, one_of(ROLES)] = CONDITION
    textures: Annotated[tuple[Name, ...], Meta(min_length=1)] | None = None
    codec: Text | None = None
    model: Text | None = None
    setting: dict[str, str | int | float] = field(default_factory=dict)
    rate_bps: Annotated[float, within(1, 1e7, "rate in bit/s")] | None = None
    snr_db: Annotated[float, within(-20, 120, "SNR in dB")] | None = None
    touch: Annotated[float, within(0, 1, "strength of the shape for touch")] | None = None
    lowpass_hz: Annotated[float, within(5, 5000, "corner of a low-pass in Hz")] | None = None
    gain_db: Annotated[float, within(-60, 60, "change of level in dB")] = 0.0

    def __post_init__(self) -> None:
        if self.rate_bps is not None and self.snr_db is not None:
            raise ValueError("rate_bps and snr_db are both given; leave one out")
        if self.codec is not None and self.codec not in codec.CODECS:
            raise ValueError(f"there is no codec {self.codec!r}; `vibrocast codecs` lists them")
        coded = self.codec is not None or self.model is not None
        choices = (self.rate_bps, self.snr_db, self.touch)
        if not coded and (self.setting or any(each is not None for each in choices)):
            raise ValueError("setting, rate_bps, snr_db and touch need a codec; add codec")

    @property
    def is_coded(self) -> bool:
        """Whether a codec is part of the condition."""
        return self.codec is not None or self.model is not None


class MaskingNoise(Table, frozen=True):
    """[masking_noise]: noise that the participant hears, so that nobody hears the actuator.

    `level_db`: its RMS re the full scale of the sound output; peaks lie up to 16 dB higher. `spectrum`: white has the
    same power in each Hz, and pink in each octave.
    """

    level_db: Annotated[float, within(-80, -16, "level in dB re full scale")] = -30.0
    spectrum: Literal["white", "pink"] = "white"


class Hand(Table, frozen=True):
    """[hand]: the pace at which the hand strokes; the page shows it. `plays`: whether stimuli play by its position."""

    speed_mm_s: Annotated[float, within(1, 1000, "speed in mm/s")]
    stroke_mm: Annotated[float, within(5, 500, "length of a stroke in mm")] = 100.0
    plays: bool = False

    @property
    def stroke_s(self) -> float:
        """The duration of a stroke in s."""
        return self.stroke_mm / self.speed_mm_s


class Staircase(Table, frozen=True, kw_only=True):
    """[staircase]: how the level follows the answers, in dB of gain of the stimulus.

    `rule`: "N down 1 up" (Levitt 1971) or "bayesian" (Watson and Pelli 1983). `steps_db`: after each reversal the next
    one; the last one stays. `intervals`: alternatives of each trial.
    """

    rule: Annotated[str, Meta(pattern=r"\A([1-4] down 1 up|bayesian)\Z", description="N down 1 up, or bayesian")] = (
        "2 down 1 up"
    )
    start_db: Annotated[float, within(-80, 40, "first level in dB")] = 0.0
    lowest_db: Annotated[float, within(-120, 40, "lowest level in dB")] = -60.0
    highest_db: Annotated[float, within(-80, 40, "highest level in dB")] = 0.0
    steps_db: Annotated[tuple[Annotated[float, within(0.1, 20, "step in dB")], ...], Meta(min_length=1)] = (8, 4, 2)
    reversals: Annotated[int, within(2, 50, "reversals until it ends")] = 8
    max_trials: Annotated[int, within(5, 500, "most trials")] = 80

    def __post_init__(self) -> None:
        if not self.lowest_db < self.highest_db or not self.lowest_db <= self.start_db <= self.highest_db:
            raise ValueError("start_db must lie from lowest_db to highest_db; correct one of the three")


class StudyQuestion(Table, frozen=True, kw_only=True):
    """An entry of [[questions]]: asked before or after the trials. Without `options` the answer is a line of text."""

    name: Name
    text: Paragraph
    options: tuple[Text, ...] = ()
    when: Literal["before", "after"] = "before"


class StudyTables(Table, frozen=True, kw_only=True):
    """The keys of a study file."""

    name: Name
    title: Text
    method: Annotated[str, one_of(METHODS)]
    seed: Annotated[int, within(0, 2**32 - 1)] = 1
    repetitions: Annotated[int, within(1, 100, "repetitions of each trial")] = 1
    order: Literal["balanced", "random"] = "balanced"
    textures_per_participant: Annotated[int, within(1, 100, "textures of each participant")] | None = None
    practice_trials: Annotated[int, within(0, 50, "trials before the first that counts")] = 0
    trials_per_block: Annotated[int, within(1, 1000, "trials from break to break")] = 20
    break_seconds: Annotated[float, within(0, 3600, "least length of a break in s")] = 30.0
    max_plays: Annotated[int, within(1, 100, "plays of each interval")] | None = None
    stimulus_seconds: Seconds = 5.0
    pause_seconds: Annotated[float, within(0, 10, "pause between intervals in s")] = 0.5
    max_seconds: Annotated[float, within(0.5, 600, "time for an answer in s")] | None = None
    feedback_in_practice: bool = True
    match_levels: bool = True
    max_limited_difference: Annotated[float, within(0, 1, "part of the samples")] = 0.01
    gain_db: Annotated[float, within(-120, 120, "change of level in dB")] = 0.0
    stream_rate_hz: Annotated[int, within(500, 50_000, "sample rate of the streams in Hz")] = 2800
    actuator: Text | None = None
    question: Text | None = None
    welcome: Paragraph | None = None
    instructions: Paragraph | None = None
    masking_noise: MaskingNoise | None = None
    hand: Hand | None = None
    staircase: Staircase | None = None
    questions: tuple[StudyQuestion, ...] = ()
    textures: Annotated[tuple[StudyTexture, ...], Meta(min_length=1)]
    conditions: Annotated[tuple[Condition, ...], Meta(min_length=1)]

    def __post_init__(self) -> None:
        check_names("textures", [each.name for each in self.textures])
        check_names("conditions", [each.name for each in self.conditions])
        check_names("questions", [each.name for each in self.questions])
        if (self.textures_per_participant or 0) > len(self.textures):
            raise ValueError(
                f"textures_per_participant is {self.textures_per_participant}, and there are {len(self.textures)} "
                "[[textures]]; lower it, or add textures"
            )
        names = [each.name for each in self.textures]
        for condition in self.conditions:
            if unknown := [name for name in condition.textures or () if name not in names]:
                raise ValueError(
                    f"condition {condition.name} is for {unknown[0]!r}, and no [[textures]] is named so; choose of "
                    f"{', '.join(names)}"
                )
            if condition.textures is not None and (condition.role != CONDITION or self.method == "paired_comparison"):
                raise ValueError(
                    f"condition {condition.name}: a condition for some textures goes with the role {CONDITION!r}, and "
                    "not with paired_comparison; drop textures"
                )
        if self.hand is not None and self.hand.plays:
            for texture in self.textures:
                if texture.hand_speed_mm_s != self.hand.speed_mm_s:
                    raise ValueError(
                        f"texture {texture.name}: stimuli play by position, so its hand_speed_mm_s must be that of "
                        f"[hand], {self.hand.speed_mm_s:g}; correct one of the two"
                    )
        roles = [each.role for each in self.conditions]
        for role in (REFERENCE, HIDDEN_REFERENCE):
            if roles.count(role) > 1:
                raise ValueError(f"{roles.count(role)} [[conditions]] have the role {role!r}; only one can")
        if self.method not in ("paired_comparison", "staircase") and REFERENCE not in roles:
            raise ValueError(f'{self.method} needs a reference; add role = "reference" to one of [[conditions]]')
        if self.method == "mushra" and roles.count(ANCHOR) != MUSHRA_ANCHORS:
            raise ValueError(f'mushra needs two anchors, not {roles.count(ANCHOR)}; give role = "anchor" to two')
        if self.method == "paired_comparison" and len(self.conditions) < MIN_LEVELS:
            raise ValueError(f"paired_comparison needs at least {MIN_LEVELS} [[conditions]]; add some")
        if self.method != "paired_comparison" and CONDITION not in roles:
            raise ValueError('none of [[conditions]] has the role "condition", so nothing is rated; add one')
        if (self.method == "staircase") != (self.staircase is not None):
            raise ValueError("the table [staircase] and the method staircase belong together; add or drop one")


class Study(StudyTables, frozen=True, kw_only=True):
    """A study file as it was read. `folder` is the file's, for names of files; `sha256` is of the file's bytes."""

    folder: str
    sha256: str

    @property
    def reference(self) -> Condition | None:
        """The condition that all others are compared with; None in a study without."""
        return next((each for each in self.conditions if each.role == REFERENCE), None)

    def conditions_of(self, texture: str) -> tuple[Condition, ...]:
        """Return the conditions of a texture."""
        return tuple(each for each in self.conditions if each.textures is None or texture in each.textures)

    def of_role(self, *roles: str, texture: str | None = None) -> tuple[str, ...]:
        """Return the names of the conditions of some roles; of one texture or of all."""
        conditions = self.conditions if texture is None else self.conditions_of(texture)
        return tuple(each.name for each in conditions if each.role in roles)

    def recordings(self) -> Mapping[str, Recording]:
        """Return each texture's recording by name. Raises InputError, which names the table."""
        loaded = {}
        for number, texture in enumerate(self.textures, 1):
            with located(f"[[textures]] {number}"):
                loaded[texture.name] = texture.load(Path(self.folder))
        return loaded


def read_study(path: Path, with_files: bool = True) -> Study:
    """Read a study file. Raises InputError, and OSError where it cannot be read.

    `with_files`: whether the files that it names must be there; its copy in a results folder needs none.
    """
    with located(path):
        document = read_toml(path, "study file")
        tables = convert(document, StudyTables)
        if with_files:
            read_each("textures", tables.textures, lambda each: each.check(path.parent))
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    values = {key: getattr(tables, key) for key in tables.__struct_fields__}
    return Study(**values, folder=str(path.parent), sha256=sha256)
