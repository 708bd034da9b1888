"""Streams a live source to a controller: blocks are coded as they come, and each packet is sent at once."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vibrocast import codec, models
from vibrocast.codec import Signal, SignalFormat
from vibrocast.codec.encoding import chosen_codec
from vibrocast.codec.rate_control import added_bytes
from vibrocast.codec.source import REFRESH_S as RATE_CONTROLLED_REFRESH_S
from vibrocast.codec.stream import image_hash
from vibrocast.device_protocol.coded_stream import StreamHeader, renumbered
from vibrocast.device_protocol.messages import EndStream, Start, State, Status
from vibrocast.device_protocol.transports import DeviceGone, TransportError
from vibrocast.errors import InputError
from vibrocast.host.controller import ANSWER_TIMEOUT_S, ConnectionLost, Controller, ControllerError, WireFaults
from vibrocast.host.link import STATUS_INTERVAL_S, Link, frame_bytes
from vibrocast.host.player import RECONNECT_S
from vibrocast.host.stream_session import check_limits, check_packet, configure_steps, stopped_on_error

# How long a packet lies on the controller before it is needed: sending may be late by this. All of it is delay.
PLAYOUT_DELAY_S = 0.01
# Of the least delay: the chain of codec, output and playout delay takes less than 10 ms.
LOW_DELAY_PLAYOUT_S = 0.002
LOW_DELAY_RATE_HZ = 8000
REFRESH_S = 0.25
# A source hands over blocks of at most this, so that the controller is heard between them.
MAX_BLOCK_S = 0.01
# The share of the link's capacity that a stream may take, so that its packets do not queue.
LINK_SHARE = 0.9

# The clocks of controller and source drift apart. The stream starts again when they differ by the playout delay on one
# side, or by _MAX_GROWTH_S on the other, for _OUT_OF_STEP_S.
_MAX_GROWTH_S = 0.02
_OUT_OF_STEP_S = 0.25
# How long the end is waited for: until all that was sent should have been played, or for _MAX_LEFT_S, and _END_S more.
_MAX_LEFT_S, _END_S = 30.0, 5.0
# A live source may deliver its backlog at once: what it kept while this computer was too busy to take it, or still
# started. One that is ahead of time by more than so much is not live.
_MAX_KEPT_S = 30.0
_POLL_S = 0.005
_END_ASK_S = 0.1
_ASK_S = 0.5
# Silence takes the place of a source that is late when this part of the playout delay is left.
_SILENCE_LEFT = 0.5
# When silence has been played for so long, the stream ends, and the next one waits for the source.
_REST_S = 0.1
# A source that gives nothing for so long pauses, also where nothing is played yet.
_PAUSE_S = 0.5
_MIN_READ_S = 0.001
# Out of step so soon, a source is so by what it has kept before.
_KEPT_S = 1.0
# A link this many times as fast as needed requires no longer playout delay.
_AMPLE = 8
# Part of the queue on the link that one packet drains.
_DRAINED = 0.25
# How much earlier than it is needed a rate-controlled packet has to come.
_GUARD_S = 0.005


@dataclass(frozen=True)
class LiveResult:
    """The result of live streaming.

    `status`: the last one. `underruns`: of all streams. `packets`: of all signal. `lost_packets`: those that the
    actuator should have had and did not, also because the stream began again. `dropped_packets`: the lost packets that
    the host did not send, because they would have been late. `streams`: more than one if it started again: clocks had
    drifted apart, the source had paused, or the connection was lost. `seconds`: of signal. `payload_bytes`: of all
    packets that were sent. `wire_bytes`: all that went to the controller with them, frames and requests included.
    `pauses`: of the source, in which silence was played. `left_out_packets`: too old when the source gave them after a
    pause. `reconnects`: of the link. `device_restarts`: of the controller, which lost its session.
    """

    status: Status
    underruns: int
    packets: int
    lost_packets: int
    dropped_packets: int
    wire_faults: WireFaults
    streams: int
    seconds: float
    payload_bytes: int
    wire_bytes: int
    pauses: int
    left_out_packets: int
    reconnects: int
    device_restarts: int

    @property
    def payload_bps(self) -> float:
        """Bits a second of the packets."""
        return 8 * self.payload_bytes / self.seconds if self.seconds else 0.0

    @property
    def wire_adds(self) -> float:
        """Bytes that frames and requests add, relative to the packets."""
        return self.wire_bytes / self.payload_bytes - 1 if self.payload_bytes else 0.0

    @property
    def wire_bps(self) -> float:
        """Bits a second of all that was sent."""
        return 8 * self.wire_bytes / self.seconds if self.seconds else 0.0


@dataclass(frozen=True)
class LiveCoding:
    """How a live stream is coded.

    `codec_name`: None = that of the model, or the default. `model`: a trained model, which the controller must run.
    `touch`: as in `codec.encoding.encode_recording`. `policy`: controls the quality, None = all packets are of the
    setting's. A policy with a rate follows the link: quality falls before a packet is late, and rises again. The host
    never sends a late packet.
    `packet_samples`: the least samples per channel in a packet, rounded up to the codec's blocks. None: with a rate,
    the shortest packet to which the wire adds at most 12 %, within `max_packet_s`; else one block.
    `refresh_packets`: from one refresh to the next, None = those of REFRESH_S, or of RATE_CONTROLLED_REFRESH_S.
    """

    codec_name: str | None = None
    setting: codec.Setting | None = None
    model: models.Model | None = None
    touch: float | None = None
    policy: codec.RatePolicy | None = None
    packet_samples: int | None = None
    max_packet_s: float = math.inf
    refresh_packets: int | None = None


class LiveStream:
    """A live stream on a controller: `send` blocks, `finish` it; playing begins with the first packet.

    `coding`: how it is coded.
    `playout_delay_s`: how long packets wait at the controller. None: PLAYOUT_DELAY_S, or a quarter of a packet if that
    is more. With a policy on a link that is not much faster than needed, the delay covers its fall to half.
    `payload_bytes`, `frame_bytes`: of all packets sent, and of the frames that hold them.
    `header`, `stream`, `packets_sent` (dropped ones included), `status`: of the stream under way. `earlier`: the last
    status of each of those before this one. `on_packets`: is called with packets before they are sent.
    Raises CodecError, InputError, ControllerError, TransportError, and StreamError for a stream that the controller
    rejects.
    """

    def __init__(
        self,
        controller: Controller,
        signal_format: SignalFormat,
        *,
        coding: LiveCoding | None = None,
        playout_delay_s: float | None = None,
    ) -> None:
        check_limits(controller, signal_format.channels, signal_format.rate_hz)
        coding = coding or LiveCoding()
        self.controller = controller
        self.format = signal_format
        self._given_playout_delay_s = playout_delay_s
        self.policy = policy = coding.policy
        self.payload_bytes = self.frame_bytes = self.dropped_packets = 0
        self._given_samples = self._given_before = self._unplayed_packets = 0
        self.pauses = self.reconnects = self._left_out_packets = self._left_out_silence = 0
        self._last_samples = np.zeros(signal_format.channels)
        self._silent_samples = 0  # since the source gave its last ones
        self._heard_s = math.inf
        self._pauses = self._has_paused = False  # now; before or in this stream
        self._wire_bytes: int | None = None
        self.earlier: list[Status] = []
        self._codec, self._model = chosen_codec(coding.codec_name, coding.model), coding.model
        given = coding.setting or {}
        shape = codec.shape_setting(self._codec, coding.touch, signal_format.rate_hz, signal_format.unit, given)
        setting = {**shape, **given}
        self.setting = (
            self._codec.complete(setting) if policy else self._codec.live(setting, signal_format, self._model)
        )
        self._target_bps = policy.bits_per_second if policy else None
        # To how many samples it is rounded up, an encoder says.
        encoder = self._make_encoder(codec.Framing(self._packet_samples(coding.packet_samples, coding.max_packet_s), 1))
        self.packet_samples = encoder.packet_samples
        self.packet_s = self.packet_samples / signal_format.rate_hz
        refresh_s = REFRESH_S if policy is None else RATE_CONTROLLED_REFRESH_S
        check_packet(controller, self.packet_samples)
        refresh_packets = coding.refresh_packets
        if refresh_packets is None:
            refresh_packets = max(1, math.floor(refresh_s / self.packet_s))
        self._framing = codec.Framing(self.packet_samples, refresh_packets)
        if policy is None:
            # The first block that is ever coded takes longer than others, and would make all of the stream later by
            # that; what controls its rate has coded some already.
            encoder.encode(np.zeros((self.packet_samples, self.format.channels)))
        self.on_packets: Callable[[Sequence[bytes]], None] | None = None
        self._heard_samples = 0
        self._since_s = controller.clock()
        self._configure()
        self._wire_bytes_before = controller.bytes_sent
        self._faults_before = controller.wire_faults
        self._device_restarts_before = controller.device_restarts

    @property
    def codec_name(self) -> str:
        """The name of the codec."""
        return self._codec.name

    @property
    def stream(self) -> int:
        """The number of the stream under way."""
        return self._session.number

    @property
    def status(self) -> Status:
        """The last status of the stream under way."""
        return self._session.status

    @property
    def link_bytes_per_second(self) -> float:
        """The bytes a second that the link carries, as far as it is known."""
        return self._link.bytes_per_second

    @property
    def delay_samples(self) -> int:
        """Samples per channel by which the decoded signal lags the source."""
        return self._encoder.delay_samples

    @property
    def underruns(self) -> int:
        """Underruns of all streams so far."""
        return sum(status.underruns for status in (*self.earlier, self.status))

    @property
    def seconds(self) -> float:
        """Seconds of signal that the source has given so far."""
        return self._given_samples / self.format.rate_hz

    def begin_again(self, is_silent: bool = False) -> None:
        """Set up another stream in place of the one under way; its first packet will start it.

        `is_silent`: all but silence has been played.
        """
        before = self.status
        self._configure()
        self.earlier.append(before)
        given_packets = math.ceil((self._given_samples - self._given_before) / self.packet_samples)
        played_packets = before.position // self.packet_samples
        unplayed_packets = max(0, given_packets - played_packets)
        if self._has_paused:
            self._left_out_packets += 0 if is_silent else unplayed_packets
        else:
            self._unplayed_packets += unplayed_packets
        self._unplayed_packets += before.lost_packets
        self._has_paused = False
        self._given_before = self._given_samples

    def _packet_samples(self, asked: int | None, max_packet_s: float) -> int:
        """Return the samples in a packet, to be rounded up to whole blocks: asked for, for the rate, or the fewest."""
        if asked is None and self._target_bps is not None:
            rate_hz = self.format.rate_hz
            return codec.rate_controlled_framing(self._target_bps, rate_hz, max_packet_s).packet_samples
        return asked or 1

    def _make_encoder(self, framing: codec.Framing) -> codec.Encoder:
        """Make the stream's first encoder; what it learns of a policy's least holds for all later ones."""
        model = self._model
        if self.policy is None:
            return self._codec.make_encoder(self.setting, self.format, framing, model, None)
        return codec.rate_controlled_encoder(self._codec, self.setting, self.format, framing, model, self.policy)

    def _begin_encoder(self, first: int) -> None:
        """Make an encoder that begins with packet `first`, a refresh."""
        model = self._model
        self._encoder = self._codec.make_encoder(self.setting, self.format, self._framing, model, self.policy)
        if self.policy is not None:
            tables = None if model is None else model.tables
            decoder = codec.decoder(self._codec.identifier, self._encoder.configuration, self.format.channels, tables)
            self.policy.begin(decoder, self.policy.min_bytes, self.packet_s)
        self._gathered = 0
        self._refreshed_at = first
        self._refresh_is_due = False

    def _configure(self) -> None:
        self._begin_encoder(0)
        self.header = StreamHeader(
            self._codec.identifier,
            self.format.rate_hz,
            None,
            self.format.unit,
            self.format.gains,
            self._encoder.configuration,
            b"" if self._model is None else image_hash(self._model.image),
        )
        self._session = self.controller.run(configure_steps(self.controller, self.header, self.packet_samples))
        self._link = Link(self.controller, self.stream)
        self._link.needed = (self._target_bps or math.inf) / 8 / LINK_SHARE
        self.playout_delay_s = (
            self._default_playout_delay_s() if self._given_playout_delay_s is None else self._given_playout_delay_s
        )
        self.packets_sent = 0
        self._plays_from_s: float | None = None
        self._ask_s = 0.0
        self._out_of_step_since_s: float | None = None

    def _default_playout_delay_s(self) -> float:
        """Return the delay with which packets stay in time if the link falls to half, as soon as that can be known.

        A packet that is under way then takes 2 LINK_SHARE of its duration. So does one that is sent behind it before
        that can be seen, which takes up to two Status, and it is needed a duration after the first one would have come.
        A link that is far faster than it needs to be leaves room for that. Without a policy, a long packet gets more
        than a short one, because more is lost with it.
        """
        if self.policy is None or self._link.bytes_per_second >= _AMPLE * self._link.needed:
            return max(PLAYOUT_DELAY_S, self.packet_s / 4)
        return max(self.packet_s + 2 * STATUS_INTERVAL_S, (3 * LINK_SHARE - 1) * self.packet_s)

    def code(self, samples: Signal) -> list[bytes]:
        """Code samples (n, channels) in the format's unit; return the packets that they complete. Raises CodecError."""
        self._gathered = (self._gathered + len(samples)) % self.packet_samples
        packets = self._encoder.encode(samples / np.array(self.format.gains))
        return [renumbered(packet, self._refreshed_at) for packet in packets]

    def send_packets(self, packets: Sequence[bytes]) -> None:
        """Send packets at once, each in a frame of its own; Start goes with the first, so that none waits for it."""
        if self.on_packets is not None:
            self.on_packets(packets)
        for packet in packets:
            now_s, bytes_before = self._link.now_s(self.controller.clock()), self.controller.bytes_sent
            self._session.send((packet,))
            self.frame_bytes += self.controller.bytes_sent - bytes_before
            start_bytes = frame_bytes(Start()) if self._plays_from_s is None else 0
            arrives_s = self._link.send(self.packets_sent, len(packet) + added_bytes(packet) + start_bytes, now_s)
            if self._plays_from_s is None:
                # From here on the packets come as evenly as the samples do, so the playout delay stays as it begins.
                self._plays_from_s = arrives_s - self._link.seconds(start_bytes) + self.playout_delay_s
                answer_s = ANSWER_TIMEOUT_S + self._link.answer_s(now_s)
                self.controller.ask(Start(round(1e6 * self._plays_from_s)), answer_s)
            self.packets_sent += 1
            self.payload_bytes += len(packet)

    def send(self, samples: Signal) -> None:
        """Code and send samples (n, channels), receive; start again if the clocks are out of step.

        No samples: the source has none now. Just before the controller would have nothing to play, silence is sent.
        """
        if len(samples):
            self._last_samples, self._heard_s = samples[-1], self.controller.clock()
            self._heard_samples += len(samples)
            self._pauses, self._silent_samples = False, 0
            self._send_samples(samples)
        else:
            self._pause()
        self.keep_up()

    def _pause(self) -> None:
        """Bridge the time until the source gives samples again."""
        now_s = self.controller.clock()
        if now_s >= self._ask_s:
            self._ask()  # the watchdog hears of the host
        is_due = self.spare_s <= 0
        if is_due or now_s - self._heard_s > _PAUSE_S:
            self.pauses += not self._pauses
            self._pauses = self._has_paused = True
        if is_due and self._silent_samples > (_REST_S + self.playout_delay_s) * self.format.rate_hz:
            self.begin_again(is_silent=True)
            self._has_paused = True  # what the source has kept may come now
        elif is_due:
            silence = np.linspace(self._last_samples, np.zeros(self.format.channels), self.left_samples + 1)[1:]
            self._last_samples = silence[-1]
            self._silent_samples += len(silence)
            self._send_samples(silence)

    def _send_samples(self, samples: Signal) -> None:
        start = 0
        while start < len(samples):
            self._wait_for_room()
            end = start + self.left_samples
            self.send_packets(self.coded(samples[start:end]))
            start = end

    def _wait_for_room(self) -> None:
        """Wait while the source is ahead and the controller's buffer is full, but no longer than it may be ahead."""
        while (
            self._out_of_step_since_s is not None
            and self.controller.clock() - self._out_of_step_since_s <= _OUT_OF_STEP_S
            and (self.packets_sent + 1) * self.packet_samples > self._session.credit_until
        ):
            self.poll(_POLL_S)

    def keep_up(self) -> None:
        """Receive messages; start again if the clocks are out of step."""
        self.poll(0)
        since_s = self._out_of_step_since_s
        out_of_step = since_s is not None and self.controller.clock() - since_s > _OUT_OF_STEP_S
        if out_of_step:
            self._reject_flood()
            if not (self._has_paused or self.earlier) and self.status.position < _KEPT_S * self.format.rate_hz:
                # What a source has kept until it was heard comes at once, as after a pause; no wire has lost it.
                self.pauses += 1
                self._has_paused = True
        if out_of_step or self.status.state == State.WATCHDOG:
            self.begin_again()

    @property
    def left_samples(self) -> int:
        """How many samples complete the next packet."""
        return self.packet_samples - self._gathered

    def coded(self, samples: Signal) -> list[bytes]:
        """Code what completes the next packet, or less; return that packet, unless it would come too late."""
        self._given_samples += len(samples)
        if len(samples) == self.left_samples and not self._fits():
            self._drop()
            return []
        self._refresh()
        return self.code(samples)

    def _fits(self) -> bool:
        """Return whether the next packet can come in time; set the policy's rate to match.

        A packet may take LINK_SHARE of its own duration on the link, less a part of the queue there. So the queue
        shrinks over some packets without a jump in quality, until they come as early as at first.
        """
        now_s = self._link.now_s(self.controller.clock())
        if self.status.state == State.PLAYING:
            self._link.wait(now_s)
        queue_s = self._link.queue_s(now_s)
        left_s = self._left_s(now_s)
        if self.policy is None:
            return left_s > 0
        min_s = self._link.seconds(self.policy.min_bytes)
        if left_s <= min_s:
            return False
        seconds = min(left_s, max(min_s, LINK_SHARE * self.packet_s - _DRAINED * queue_s))
        if self._target_bps is not None:
            carried_bps = 8 * seconds * self._link.bytes_per_second / self.packet_s
            # A little above the policy's least, which rounding would put out of reach.
            least_bps = 1.001 * self.policy.min_bits_per_second
            self.policy.bits_per_second = min(self._target_bps, max(least_bps, carried_bps))
        return True

    def _left_s(self, now_s: float) -> float:
        """Return for how long the next packet may be on the link; infinite before the first one is sent."""
        if self._plays_from_s is None:
            return math.inf
        guard_s = 0.0 if self.policy is None else min(_GUARD_S, self.playout_delay_s / 2)
        return self._plays_from_s + self.packets_sent * self.packet_s - now_s - self._link.queue_s(now_s) - guard_s

    @property
    def spare_s(self) -> float:
        """How much longer the source may take for the next packet; infinite before the first one is sent.

        Silence comes as early as samples do, so that a busy computer does not make it late.
        """
        min_s = 0.0 if self.policy is None else self._link.seconds(self.policy.min_bytes)
        ahead_s = self.playout_delay_s * (1.0 if self._silent_samples else _SILENCE_LEFT)
        return self._left_s(self._link.now_s(self.controller.clock())) - min_s - ahead_s

    def _drop(self) -> None:
        """Leave out the next packet, which would come too late; the one behind it is a refresh."""
        self.packets_sent += 1
        if self._silent_samples:
            self._left_out_silence += 1
        else:
            self.dropped_packets += 1
        if self.controller.clock() >= self._ask_s:
            # Nothing else would tell when what is under way has come, as it comes too late to be played.
            self._link.asking()
            self._ask()
        self._gathered = 0
        self._refresh_is_due = True

    def _ask(self) -> None:
        self._ask_s = self.controller.clock() + min(_ASK_S, self.controller.description.limits.watchdog_ms / 4000)
        self.controller.ask_status()

    def _refresh(self) -> None:
        """Make an encoder if a refresh is due: not for each dropped packet, as a host that is late has no time."""
        if self._refresh_is_due and not self._gathered:
            self._begin_encoder(self.packets_sent)

    def _reject_flood(self) -> None:
        """Raise InputError for a source that does not keep its own rate: what is ahead of time would be lost."""
        gave_s = self._heard_samples / self.format.rate_hz
        took_s = self.controller.clock() - self._since_s
        if gave_s - took_s > _MAX_KEPT_S:
            raise InputError(
                f"the source is not live: it gave {gave_s:.1f} s of signal in {took_s:.1f} s; play a recording with "
                "`vibrocast play`"
            )

    def poll(self, timeout_s: float) -> None:
        """Receive messages for at most `timeout_s`."""
        if isinstance(self.controller.poll(timeout_s), Status):
            self._link.flushed()
        before = self.status
        if (status := self._session.news()) is None:
            return
        lost = status.lost_packets - before.lost_packets
        self._link.hear(status, self.packet_samples, self.controller.clock())
        if status.state == State.PLAYING and status.position:
            self._plays_from_s = status.device_time_us / 1e6 - status.position / self.format.rate_hz
        if lost and self.policy is not None and status.position > self._refreshed_at * self.packet_samples:
            self._refresh_is_due = True  # the controller is silent until one comes
        device_s = status.device_time_us / 1e6
        behind = status.position > self._link.arrived_by(device_s) * self.packet_samples
        behind = behind and not self._link.is_late(device_s)  # that is the link's doing, not the clocks'
        max_s = self.playout_delay_s + self.packet_samples / self.format.rate_hz + _MAX_GROWTH_S
        too_long = status.buffered_samples > max_s * self.format.rate_hz
        if status.state != State.PLAYING or not (behind or too_long):
            self._out_of_step_since_s = None
        elif self._out_of_step_since_s is None:
            self._out_of_step_since_s = self.controller.clock()

    def finish(self) -> LiveResult:
        """Send what is left and the end, wait until it has been played, and return what happened."""
        self._refresh()
        self.send_packets([renumbered(packet, self._refreshed_at) for packet in self._encoder.finish()])
        if self.packets_sent:
            self.controller.request(EndStream(self.stream, self.packets_sent), Status)
        else:
            self.controller.stop()
        self._session.news()
        self._wire_bytes = self.controller.bytes_sent - self._wire_bytes_before
        if self.packets_sent:
            self._wait_for_the_end()
        return self.result()

    def result(self) -> LiveResult:
        """Return what has happened so far."""
        streams = [*self.earlier, self.status]
        wire_bytes = self._wire_bytes
        if wire_bytes is None:
            wire_bytes = self.controller.bytes_sent - self._wire_bytes_before
        packets = math.ceil(self.seconds / self.packet_s)
        return LiveResult(
            status=self.status,
            underruns=sum(status.underruns for status in streams),
            packets=packets,
            # A controller that hears of the end too late also counts packets that there never were.
            lost_packets=max(
                0, min(packets, self._unplayed_packets + self.status.lost_packets - self._left_out_silence)
            ),
            dropped_packets=self.dropped_packets,
            wire_faults=self.controller.wire_faults.since(self._faults_before),
            streams=len(streams),
            seconds=self.seconds,
            payload_bytes=self.payload_bytes,
            wire_bytes=wire_bytes,
            pauses=self.pauses,
            left_out_packets=self._left_out_packets,
            reconnects=self.reconnects,
            device_restarts=self.controller.device_restarts - self._device_restarts_before,
        )

    def _wait_for_the_end(self) -> None:
        left_samples = self.packets_sent * self.packet_samples - self.status.position
        deadline_s = self.controller.clock() + min(left_samples / self.format.rate_hz, _MAX_LEFT_S) + _END_S
        ask_s = 0.0
        ended = (State.FINISHED, State.STOPPED, State.WATCHDOG)
        while self.controller.clock() < deadline_s:
            if self.status.state in ended:
                return
            if self.controller.clock() >= ask_s:
                self.controller.ask_status()
                ask_s = self.controller.clock() + _END_ASK_S
            self.controller.poll(_POLL_S)
            self._session.news()
        if self.controller.request_status().state in ended:  # it may be this computer that was too busy to hear of it
            self._session.news()
            return
        raise ControllerError(
            f"the stream's end has not been played {_END_S:g} s after its time; restart the controller"
        )


def play(
    stream: LiveStream,
    blocks: Iterable[Signal],
    *,
    reconnect_s: float = RECONNECT_S,
    progress: Callable[[Status], None] | None = None,
) -> LiveResult:
    """Stream blocks (n, channels), each as soon as the iterator yields it, to its end; return what happened.

    Whatever is raised, KeyboardInterrupt included, the controller is stopped first. A broken connection is opened again
    for `reconnect_s`, and the stream begun again; where the source has kept blocks meanwhile, once more when it has
    caught up. Raises as `LiveStream`.
    """
    with stopped_on_error(stream.controller):
        for block in blocks:
            try:
                stream.send(block)
            except (TransportError, ConnectionLost):
                _go_on(stream, reconnect_s)
                stream.reconnects += 1
            if progress is not None:
                progress(stream.status)
        return stream.finish()


def _go_on(stream: LiveStream, within_s: float) -> None:
    """Connect again and begin another stream, as often as it takes. Raises the last error after `within_s`."""
    clock = stream.controller.clock
    deadline_s = clock() + within_s
    while True:
        stream.controller.reconnect(max(0.0, deadline_s - clock()))
        try:
            stream.begin_again()
            return
        except (TransportError, ConnectionLost) as error:
            if isinstance(error, DeviceGone) or clock() >= deadline_s:
                raise


def heard(stream: LiveStream, read: Callable[[float], Signal | None]) -> Iterator[Signal]:
    """Yield what a source gives as it comes, and blocks without samples while it pauses.

    `read` waits for at most so many seconds; it returns samples (n, channels), which may be none, and None at the end.
    """
    while (samples := read(max(_MIN_READ_S, min(stream.spare_s, MAX_BLOCK_S)))) is not None:
        yield samples


def paced(
    stream: LiveStream, samples: Signal, sleep: Callable[[float], None] | None = None
) -> Iterator[tuple[float, Signal]]:
    """Yield blocks of samples (n, channels), each when its last sample would have been taken, and with that time.

    Blocks end where packets do, so that none waits for a part of the next. Times are in seconds of the controller
    session's clock; `sleep` waits in between, None = the session's.
    """
    sleep = sleep or stream.controller.sleep
    controller, rate_hz = stream.controller, stream.format.rate_hz
    parts = math.ceil(stream.packet_samples / (MAX_BLOCK_S * rate_hz))
    began_s = controller.clock()
    start = number = 0
    while start < len(samples):
        number += 1
        end = min(len(samples), number * stream.packet_samples // parts)
        due_s = began_s + end / rate_hz
        sleep(max(0.0, due_s - controller.clock()))
        yield due_s, samples[start:end]
        start = end
