"""The user's recordings: every codec at three of its settings, graded as the hard signals are."""

from functools import partial

from vibrocast.evaluation.stability.maps import Group, Map, RatePoint, Scope, hardest, three_rate_points
from vibrocast.evaluation.stability.signals import (
    SIGNALS,
    THREE_RATE_POINTS,
    decoded,
    judge,
    place_at_level,
    texture_snr_db,
    with_bits,
)
from vibrocast.evaluation.stability.trials import Measured, Trial
from vibrocast.textures import Recording

MAX_S = 60.0


def measure(rate_point: RatePoint, recording: Recording) -> Measured:
    """Code a recording, at most its first MAX_S, and grade the decoded samples. Raises CodecError."""
    rate_hz = round(recording.rate_hz)
    samples = recording.samples[: round(MAX_S * rate_hz)]
    heard, stream = decoded(samples, rate_hz, rate_point, recording.unit)
    return with_bits(judge(samples, heard, texture_snr_db(rate_point)), stream, heard)


def _trials(scope: Scope) -> list[Trial]:
    return [
        Trial(
            RECORDINGS.name,
            method.name,
            recording.name,
            f"{level}: {rate_point.text}",
            None,
            partial(measure, rate_point, recording),
        )
        for method in scope.methods
        for level, rate_point in three_rate_points(method).items()
        for recording in scope.recordings
    ]


RECORDINGS = Map(
    name="recordings",
    group=Group.SIGNALS,
    title="Your recordings",
    tried=f"The first {MAX_S:g} s of each recording, at its own rate, are coded as a whole stream and decoded.",
    rule=SIGNALS.rule,
    trials=_trials,
    message=lambda cells: f"Hardest to code: {hardest(cells)}",
    place=place_at_level,
    caption=THREE_RATE_POINTS,
)
