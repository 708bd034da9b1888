"""The queue to a sound card: in order, exact, and at rest within the slew limit where it runs dry."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.output.actuator import VOICE_COIL, Actuator, Codes
from vibrocast.output.code_queue import CodeQueue, fade_frames, within_slew

ACTUATOR = replace(VOICE_COIL, dac_rate_hz=48_000)
SLOW = replace(ACTUATOR, slew_volts_per_second=300.0)
"""It takes longer than a fade from full drive to rest."""


def smooth(frames: int, actuator: Actuator, seed: int) -> Codes:
    """Codes that begin at rest and keep the slew limit."""
    steps = np.random.default_rng(seed).integers(-actuator.code_step_limit, actuator.code_step_limit + 1, (frames, 2))
    walk = np.zeros(2, np.int64)
    codes = []
    for step in steps:
        walk = np.clip(walk + step, -20_000, 20_000)
        codes.append(walk)
    return np.array(codes, np.int16)


@given(
    pieces=st.lists(st.integers(1, 900), min_size=1, max_size=6),
    takes=st.lists(st.integers(1, 700), min_size=1, max_size=12),
)
def test_codes_come_out_as_they_went_in(pieces: list[int], takes: list[int]) -> None:
    queue = CodeQueue(ACTUATOR, 2)
    codes = smooth(sum(pieces), ACTUATOR, 0)
    for piece in np.split(codes, np.cumsum(pieces)[:-1]):
        queue.put(piece)
    takes = takes[: int(np.searchsorted(np.cumsum(takes), len(codes), side="right"))]
    taken = [queue.take(frames) for frames in takes]
    assert np.array_equal(np.concatenate([codes[:0], *taken]), codes[: sum(takes)])
    assert queue.taken == sum(takes)
    assert queue.underruns == 0


@given(
    supplies=st.lists(st.integers(0, 1500), min_size=1, max_size=15),
    actuator=st.sampled_from([ACTUATOR, SLOW]),
    seed=st.integers(0, 100),
)
def test_where_it_runs_dry_no_step_exceeds_the_slew_limit(supplies: list[int], actuator: Actuator, seed: int) -> None:
    queue = CodeQueue(actuator, 2)
    queue.playing = True
    codes = smooth(sum(supplies), actuator, seed)
    out = []
    for piece in np.split(codes, np.cumsum(supplies)[:-1]):
        queue.put(piece)
        out.append(queue.take(480))
    queue.playing = False
    while not queue.at_rest:
        out.append(queue.take(480))
    played = np.concatenate(out).astype(np.int64)
    assert np.abs(np.diff(played, axis=0, prepend=0, append=0)).max(initial=0) <= actuator.code_step_limit
    assert np.abs(played).max(initial=0) <= np.abs(codes.astype(np.int64)).max(initial=0)


def test_an_underrun_is_counted_once_and_rests_within_five_milliseconds() -> None:
    queue = CodeQueue(ACTUATOR, 1)
    queue.playing = True
    queue.put(np.full((100, 1), 4000, np.int16))
    out = queue.take(480)
    assert (out[:100] == 4000).all()
    assert (np.diff(out[99 : 100 + 240, 0].astype(int)) <= 0).all()
    assert not out[100 + fade_frames(ACTUATOR) :].any()
    queue.put(np.full((480, 1), 4000, np.int16))
    again = queue.take(480)[:, 0].astype(int)
    assert again[0] < 20 and (np.diff(again[:240]) >= 0).all() and (again[240:] == 4000).all()
    assert (queue.underruns, queue.taken) == (1, 580)


def test_silence_that_runs_out_is_no_underrun() -> None:
    queue = CodeQueue(ACTUATOR, 1)
    queue.put(np.zeros((10, 1), np.int16))
    assert not queue.take(480).any()
    assert (queue.underruns, queue.taken) == (0, 10)


@given(st.lists(st.integers(-32768, 32767), min_size=1, max_size=50), st.integers(16, 40_000))
def test_limited_steps_reach_what_stays(values: list[int], step: int) -> None:
    codes = np.array([*values, *[values[-1]] * (65536 // step + 1)], np.int16)[:, None]
    limited = within_slew(codes, np.zeros(1, np.int64), step)
    assert np.abs(np.diff(limited.astype(np.int64), axis=0, prepend=0)).max() <= step
    assert limited[-1] == codes[-1]
