"""Plays the stimuli of a study on a controller, on a sound card or nowhere: one interface for the session."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np

from vibrocast.codec.encoding import encode_profile
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.coded_stream import StreamError
from vibrocast.device_protocol.messages import State, Status
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host import hand_playback, playback, player
from vibrocast.host.controller import ControllerError
from vibrocast.host.devices import Session
from vibrocast.host.hand_playback import Movement, back_and_forth
from vibrocast.host.report import Report
from vibrocast.host.stream_session import carried, check_limits, configure_steps, fitted
from vibrocast.output.actuator import Actuator, Codes
from vibrocast.output.rendering import render
from vibrocast.output.sound_card import Card
from vibrocast.study.sample_player import SamplePlayer
from vibrocast.study.stimuli import UNCODED_SNR_DB, limited_samples, stream_sha256
from vibrocast.study.study_file import Hand
from vibrocast.study.trials import Played, Stimulus, StimulusPlayer

# A controller that has not come to rest after this time is given up; its watchdog stops it.
_STOP_WITHIN_S = 5.0


class _Stopped(Exception):
    """Raised in the thread that plays, to end a stimulus before its time."""


class _Playing:
    """A stimulus under way on a controller.

    `stopping`: whether it is to end before its time. `begun`: when it began at the skin, in UTC and as `time.monotonic`
    counts; `rested_s`: when the actuator had come to rest, as that counts. `status`: the last one.
    """

    def __init__(self, stimulus: Stimulus, play: Callable[["_Playing"], None]) -> None:
        self.stimulus, self.asked_s = stimulus, time.monotonic()
        self.stopping = False
        self.rested_s: float | None = None
        self.begun: tuple[datetime, float] | None = None
        self.status: Status | None = None
        self.thread = threading.Thread(target=play, args=(self,), name="stimulus", daemon=True)
        self.thread.start()

    def follow(self, position_s: float | None, status: Status | None = None) -> None:
        """Take in where it is, None before and after it plays. Raises _Stopped where it is to end."""
        self.status = status or self.status
        if self.begun is None and position_s is not None:
            self.begun = datetime.now(UTC) - timedelta(seconds=position_s), time.monotonic() - position_s
        if self.rested_s is None and status is not None and status.state == State.FINISHED:
            self.rested_s = time.monotonic()
        if self.stopping:
            raise _Stopped


class ControllerPlayer(StimulusPlayer):
    """Plays on a controller session, which nobody else uses meanwhile.

    One thread at a time talks to the controller. What was played is read back and compared with the same computed here.
    `switch` stops and starts, because a controller plays one stream at a time: about 0.4 s lie between. Some streams no
    controller decodes, such as one that is coded as a whole file. Such a stream is decoded here and sent as
    `limits.carried` says. That error lies far below the stream's own.
    """

    def __init__(self, session: Session) -> None:
        super().__init__()
        self._session = session
        self._playing: _Playing | None = None
        self._error: Exception | None = None
        self._carried: dict[str, Stream] = {}

    def prepare(self, stimuli: Sequence[Stimulus]) -> None:
        """Offer each stream to the controller; code again what it rejects. Raises as `start`."""
        controller = self._session.controller
        for stimulus in stimuli:
            stream = stimulus.stream
            try:
                check_limits(controller, stream.header.channels, stream.header.rate_hz)
            except StreamError as error:
                raise ControllerError(f"{stimulus.key}: {error}") from error
            try:
                sent = fitted(controller, stream)
                controller.run(configure_steps(controller, sent.header, 1, packets=len(sent.packets)))
                controller.stop()
            except (StreamError, ControllerError) as error:
                if isinstance(error, ControllerError) and error.code is None:
                    raise
                self._carried[stream_sha256(stream)] = carried(stream)

    def start(self, stimulus: Stimulus) -> None:
        """Play from the beginning; the one before ramps down first. Raises ControllerError, TransportError."""
        self.stop()
        self._raise_error()
        self._playing = _Playing(stimulus, self._play)

    def stop(self) -> None:
        """End the stimulus that plays, and wait for its thread. Never raises for a device that is gone."""
        now, self._playing = self._playing, None
        if now is not None:
            now.stopping = True
            now.thread.join(_STOP_WITHIN_S)

    def playing(self) -> str | None:
        """Return the key of the stimulus that plays, None at rest. Raises ControllerError, TransportError."""
        self._raise_error()
        now = self._playing
        return now.stimulus.key if now is not None and now.thread.is_alive() and now.rested_s is None else None

    def _raise_error(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _play(self, now: _Playing) -> None:
        """Play one stimulus in its own thread, and note what was played."""
        stimulus, report = now.stimulus, None
        try:
            with suppress(_Stopped):
                now.follow(None)
                report = self._perform(now, self._carried.get(stream_sha256(stimulus.stream), stimulus.stream))
            now.status = self._session.controller.request_status()
        except (ControllerError, TransportError) as error:
            self._error = error
        except (StreamError, ValueError) as error:
            self._error = ControllerError(f"{stimulus.key} cannot be played: {error}")
        if now.begun is None or now.status is None:
            return
        begun_utc, begun_s = now.begun
        self._played.append(
            Played(
                stimulus=stimulus.key,
                stream_sha256=stream_sha256(stimulus.stream),
                started_utc=begun_utc.isoformat(timespec="microseconds"),
                latency_ms=1000 * (begun_s - now.asked_s),
                gain_db=stimulus.gain_db,
                limited=limited_samples(now.status),
                underruns=now.status.underruns,
                seconds=(now.rested_s or time.monotonic()) - begun_s,
                as_computed=None if report is None else report.dac_equals_offline,
            )
        )

    def _perform(self, now: _Playing, stream: Stream) -> Report:
        """Play to the end, and compare. Raises _Stopped, and as `playback.play`."""

        def follow(progress: player.Progress) -> None:
            moves = progress.status.state == State.PLAYING
            now.follow(progress.position_s if moves else None, progress.status)

        stimulus = now.stimulus
        return playback.play(self._session, stimulus.key, stream, loops=stimulus.loops, progress=follow).report


class HandPlayer(ControllerPlayer):
    """Plays stimuli over position: under the controller's own sensor of the hand, or under the strokes of `hand`.

    A stimulus that is coded over time, for a hand at `hand.speed_mm_s`, is a height profile at that speed. It is
    decoded here and sent as a profile in the default codec at UNCODED_SNR_DB. The controller repeats it at its ends.
    `seconds`: duration of a presentation. A controller without a sensor gets strokes there and back, one a beat.
    """

    def __init__(self, session: Session, hand: Hand, seconds: float) -> None:
        super().__init__(session)
        self._speed_mm_s = hand.speed_mm_s
        # The highest speed of a cosine is pi / 2 times its mean.
        whole = back_and_forth(hand.stroke_mm, math.pi / 2 * hand.speed_mm_s, math.ceil(seconds / (2 * hand.stroke_s)))
        within = whole.times_s <= seconds
        self._movement = Movement(whole.times_s[within], whole.positions_mm[within])

    def prepare(self, stimuli: Sequence[Stimulus]) -> None:
        """Make a profile of each stimulus, and load it once. Raises ControllerError, TransportError."""
        for stimulus in stimuli:
            recording = stimulus.stream.recording()
            over_position = replace(recording, rate_hz=1000 * recording.rate_hz / self._speed_mm_s)
            try:
                profile = encode_profile(over_position, snr_db=UNCODED_SNR_DB, touch=0).stream
                hand_playback.load(self._session.controller, profile)
            except (ControllerError, ValueError) as error:
                raise ControllerError(f"{stimulus.key} as a height profile: {error}") from error
            finally:
                self._session.controller.stop()
            self._carried[stream_sha256(stimulus.stream)] = profile

    def _perform(self, now: _Playing, stream: Stream) -> Report:
        """Play under the hand to the end, and compare. Raises _Stopped, and as `hand_playback.play`."""

        def follow(part: float) -> None:
            now.follow(0.0 if part > 0 else None)

        key = now.stimulus.key
        return hand_playback.play_and_compare(self._session, key, stream, self._movement, progress=follow).report


class CardPlayer(StimulusPlayer):
    """Plays on a sound card: each stimulus is rendered once, by the integer code of controllers, at the card's rate.

    `switch` goes on at the same place without a gap. `actuator` is the one behind the card, whose DAC is the card;
    `channels` are the card's, from 1: a stimulus of one channel plays on all of them. Raises TransportError and
    MissingExtraError.
    """

    def __init__(self, card: Card, channels: Sequence[int], actuator: Actuator) -> None:
        super().__init__()
        self._actuator, self._channels = actuator, len(channels)
        self._samples = SamplePlayer(card, channels, actuator)
        self._rendered: dict[str, tuple[Codes, int]] = {}
        self._known: dict[str, Stimulus] = {}
        self._counted = self._samples.underruns, self._samples.limited

    def prepare(self, stimuli: Sequence[Stimulus]) -> None:
        """Render each stimulus, and wait until the card plays. Raises as `start`.

        Raises ControllerError for a stimulus that the card's channels cannot play.
        """
        self._samples.wait_for_begin()
        for stimulus in stimuli:
            self._codes(stimulus)

    def start(self, stimulus: Stimulus) -> None:
        """Play from the beginning; the one before fades out meanwhile. Raises TransportError."""
        self._samples.start(*self._codes(stimulus))

    def switch(self, stimulus: Stimulus) -> None:
        """Go on at the same place in another stimulus. Raises TransportError."""
        self._samples.switch(*self._codes(stimulus))

    def stop(self) -> None:
        """Bring the output to rest."""
        self._samples.stop()

    def playing(self) -> str | None:
        """Return the key of the stimulus that plays, None at rest. Raises TransportError if the card is gone."""
        sha256 = self._samples.playing()
        return None if sha256 is None else self._known[sha256].key

    def take_played(self) -> list[Played]:
        """Return what has been played since the last call."""
        counts = self._samples.underruns, self._samples.limited
        underruns, limited = (now - before for now, before in zip(counts, self._counted, strict=True))
        self._counted = counts
        taken = []
        for each in self._samples.take_played():
            stimulus = self._known[each.key]
            begun_utc = datetime.fromtimestamp(each.started_s, UTC)
            taken.append(
                Played(
                    stimulus=stimulus.key,
                    stream_sha256=each.key,
                    started_utc=begun_utc.isoformat(timespec="microseconds"),
                    latency_ms=1000 * self._samples.latency_s,
                    gain_db=stimulus.gain_db,
                    limited=self._rendered[each.key][1] + limited,
                    underruns=underruns,
                    seconds=each.frames / self._actuator.dac_rate_hz,
                )
            )
        return taken

    def close(self) -> None:
        """Bring the output to rest, and release the card."""
        self._samples.close()

    def _codes(self, stimulus: Stimulus) -> tuple[str, Codes]:
        """Return the hash of a stimulus and its codes int16 (n, channels), rendered once. Raises ControllerError."""
        stream = stimulus.stream
        sha256 = stream_sha256(stream)
        if sha256 not in self._rendered:
            if stream.header.channels not in (1, self._channels):
                raise ControllerError(
                    f"{stimulus.key}: {stream.header.channels} channels on {self._channels} of the sound card; name as "
                    "many in its address"
                )
            delay = stream.delay_samples
            codes, counts = render(stream.header, stream.decode_integers(), delay, self._actuator, loops=stimulus.loops)
            on_all = np.ascontiguousarray(np.broadcast_to(codes, (len(codes), self._channels)))
            self._rendered[sha256] = on_all, limited_samples(counts)
        self._known[sha256] = stimulus
        return sha256, self._rendered[sha256][0]


class SilentPlayer(StimulusPlayer):
    """Plays nothing, for simulated observers, rehearsals and tests: every stimulus is over at once."""

    def prepare(self, stimuli: Sequence[Stimulus]) -> None:
        """Do nothing."""

    def start(self, stimulus: Stimulus) -> None:
        """Note that a stimulus begins."""
        now_utc = datetime.now(UTC).isoformat(timespec="microseconds")
        sha256 = stream_sha256(stimulus.stream)
        self._played.append(Played(stimulus.key, sha256, now_utc, None, stimulus.gain_db, 0, 0, stimulus.seconds))

    def stop(self) -> None:
        """Do nothing."""

    def playing(self) -> str | None:
        """Return None: nothing ever plays."""
        return None
