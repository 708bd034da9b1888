"""Leads a simulated observer through a study: the same session as a person's, without a device."""

import math
from collections.abc import Sequence
from pathlib import Path

from vibrocast.host.playback import at_the_skin
from vibrocast.output.actuator import Actuator
from vibrocast.study.device_player import SilentPlayer
from vibrocast.study.observer import Observer, ObserverSettings, Skin
from vibrocast.study.session import Session
from vibrocast.study.study_file import Study
from vibrocast.study.trials import Break, Message, Question, Stimulus, Trial

SIMULATED = "simulated observer"
"""The device's name in the results of one."""
_MAX_SKIN_S = 2.0


class SkinOf:
    """The skin's displacement of each stimulus at each level, computed once for all observers of a study."""

    def __init__(self, stimuli: Sequence[Stimulus], actuator: Actuator) -> None:
        self._stimuli = {each.key: each for each in stimuli}
        self._actuator = actuator
        self._skins: dict[tuple[str, float], Skin] = {}

    def __call__(self, key: str, gain_db: float) -> Skin:
        """Return the skin of a stimulus; at most the first seconds, which are as the rest."""
        if (key, gain_db) not in self._skins:
            stimulus = self._stimuli[key]
            loops = min(stimulus.loops, math.ceil(_MAX_SKIN_S / stimulus.stream.seconds))
            recording = at_the_skin(stimulus.stream.with_gain(gain_db), self._actuator, loops=loops)
            samples = recording.samples[: round(_MAX_SKIN_S * recording.rate_hz)]
            self._skins[key, gain_db] = Skin(samples, recording.rate_hz)
        return self._skins[key, gain_db]


def simulate_participant(
    study: Study,
    stimuli: Sequence[Stimulus],
    skin_of: SkinOf,
    participant: int,
    folder: Path,
    settings: ObserverSettings | None = None,
) -> None:
    """Let one simulated observer answer all trials that are left. Raises as Session."""
    observer = Observer(study.seed, participant, settings)
    now_s = [0.0]

    def sleep(seconds: float) -> None:
        now_s[0] += seconds

    player = SilentPlayer()
    session = Session(study, stimuli, participant, folder, player, SIMULATED, clock=lambda: now_s[0], sleep=sleep)
    try:
        while not session.has_ended:
            screen = session.screen()
            if isinstance(screen, Trial):
                skins = {
                    each.label: None if each.stimulus is None else skin_of(each.stimulus, each.gain_db)
                    for each in screen.intervals
                }
                for each in screen.intervals[:1] if screen.in_order else screen.intervals:
                    session.play(each.label)
                    session.wait_until_quiet()
                session.answer(observer.answer(study.method, screen, skins))
            elif isinstance(screen, Question):
                session.reply(screen.options[0] if screen.options else SIMULATED)
            elif isinstance(screen, Break):
                now_s[0] += screen.seconds
                session.go_on()
            elif isinstance(screen, Message):
                session.go_on()
    finally:
        session.close()
