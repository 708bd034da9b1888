"""One stream on the controller: jitter buffer, decoding and concealment, drive, DAC, and the capture of both ends."""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec import CodecError, Decoded, Decoder
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader, packet_sequence
from vibrocast.device_protocol.messages import Configure, ErrorCode, State, Status, Tap
from vibrocast.output.actuator import Actuator, Codes
from vibrocast.output.profile import Profile, min_samples, rendered
from vibrocast.output.rendering import Dac, Drive, recording_end
from vibrocast.simulated_device.refusal import Refusal

# Bounds the memory that small packets could take; credit never goes beyond it.
BUFFER_PACKETS = 1024
# What bounds the work of a loop, which begins afresh and decodes padding in each iteration.
SHORTEST_ITERATION_SECONDS = 0.003
DECODED_PER_PLAYED = 16
# Playing begins with what is there when data has not come for so long: what is missing of the prebuffer was lost.
LONGEST_WAIT_US = 1_000_000

_TAKING_DATA = (State.BUFFERING, State.ARMED, State.PLAYING, State.PAUSED)
_LARGEST_COUNT = 2**32 - 1


class CaptureRing:
    """The last `capacity` samples (n, channels) of a signal, by their number since the start."""

    def __init__(self, capacity: int, channels: int) -> None:
        self.end = 0
        self._samples = np.zeros((capacity, channels), np.int16)

    def write(self, samples: NDArray[np.int16]) -> None:
        """Append samples int16 (n, channels)."""
        capacity = len(self._samples)
        self.end += len(samples)
        kept = samples[max(0, len(samples) - capacity) :]
        self._samples[np.arange(self.end - len(kept), self.end) % capacity] = kept

    def read(self, offset: int, count: int) -> tuple[int, NDArray[np.int16]]:
        """Return up to `count` samples from `offset` or, where those are gone, from the oldest; and their offset."""
        first = min(max(offset, self.end - len(self._samples), 0), self.end)
        last = min(first + count, self.end)
        return first, self._samples[np.arange(first, last) % len(self._samples)]


class Playback:
    """A configured stream, from its packets to DAC codes; time comes from outside, on the controller's own clock.

    Packets are counted over all iterations. `make_decoder` gives the fresh decoder that each iteration begins with.
    Raises Refusal for what cannot be played.
    """

    def __init__(
        self,
        configure: Configure,
        header: StreamHeader,
        make_decoder: Callable[[], Decoder],
        actuator: Actuator,
        buffer_samples: int,
        capture_samples: int,
        profile_samples: int,
        hand_delay_us: int,
    ) -> None:
        self.state = State.BUFFERING
        self.stream = configure.stream
        self.channels = header.channels
        self._header = header
        self._prebuffer_samples = configure.prebuffer_samples
        self.live = configure.packets == 0
        # In one iteration; None: a live stream whose end has not been said.
        self._packets = configure.packets or None
        self._make_decoder = make_decoder
        try:
            self._decoder = make_decoder()
        except CodecError as error:
            raise Refusal(ErrorCode.UNKNOWN_CODEC, str(error)) from error
        self._packet_samples = self._decoder.packet_samples
        self._recording_end = recording_end(header, self._decoder.delay_samples)
        output, delay_samples = header, self._decoder.delay_samples
        if header.spatial:
            output, delay_samples = rendered(header, actuator), 0
        try:
            self._drive = Drive(output, actuator, configure.compensation, delay_samples)
        except ValueError as error:
            raise Refusal(ErrorCode.BEYOND_LIMITS, str(error)) from error
        hold_samples = self._drive.drive_samples(delay_samples)
        self._dac = Dac(output, actuator, configure.gain, configure.compensation, hold_samples)
        self._dac_rate_hz = actuator.dac_rate_hz
        self.captures = {tap: CaptureRing(capture_samples, self.channels) for tap in Tap}
        self._buffer_packets = min(BUFFER_PACKETS, buffer_samples // self._packet_samples)
        self._refuse_misfits()
        self._profile: Profile | None = None
        self._hand_delay_us = hand_delay_us
        if header.spatial:
            self._refuse_profile(configure.first_packet, profile_samples)
            self._profile = Profile(header.rate_hz, header.samples or 0, self.channels, actuator.dac_rate_hz)
        self.set_loops(configure.loops)
        self._buffer: dict[int, bytes] = {}
        self._first = self._next = configure.first_packet
        self._newest = self._first - 1
        self._position = self._first * self._packet_samples
        self._pending = np.zeros((0, self.channels), np.int32)  # drive made and not yet played
        self._ramp: Codes = np.zeros((0, self.channels), np.int16)  # the way to rest, played before anything else
        self._drained = False  # all drive is made
        self._start_us = 0
        self._rest_from_us = 0
        self._waiting_since_us = 0
        self._clock_from_us = 0
        self._clock_samples = 0
        self._starved = False
        self._underruns = 0
        self._lost_packets = 0

    @property
    def free_us(self) -> int:
        """When the DAC has come to rest, and recovered as far as its power limit asks, if no more is played."""
        return self._rest_from_us + math.ceil(self._dac.recovery_samples * 1_000_000 / self._dac_rate_hz)

    @property
    def credit_until(self) -> int:
        """The position up to which data may be sent."""
        return (self._next + self._buffer_packets) * self._packet_samples

    @property
    def room_samples(self) -> int:
        """What the buffer holds in packets of this stream: the first credit."""
        return self._buffer_packets * self._packet_samples

    def add(self, iteration: int, packets: Sequence[bytes], time_us: int) -> None:
        """Sort in packets; drop those that come twice, too late, beyond credit or beyond the end, or are malformed."""
        if self.state not in _TAKING_DATA:
            return
        for packet in packets:
            try:
                sequence, _ = packet_sequence(packet)
            except StreamError:
                continue
            if iteration if self._packets is None else sequence >= self._packets:
                continue
            index = iteration * (self._packets or 0) + sequence
            end = self._end()
            if self._next <= index < self._next + self._buffer_packets and (end is None or index < end):
                self._buffer.setdefault(index, packet)
                self._newest = max(self._newest, index)
                self._waiting_since_us = time_us
        while self._profile is not None and self._next in self._buffer:
            self._profile.load(self._decode_next())

    def position(self, hand_us: int, position_nm: int, time_us: int) -> None:
        """Take where the hand was at a time of the controller's clock, at most the present one; 0: now."""
        if self._profile is not None and self.state in _TAKING_DATA:
            self._underruns += self._profile.position(min(hand_us or time_us, time_us), position_nm)

    def start(self, start_us: int, time_us: int) -> None:
        """Arm: play from `start_us` on, or as soon as the prebuffer is there if that is later."""
        self.state = State.ARMED
        self._start_us = max(start_us, time_us)
        self._waiting_since_us = time_us

    def pause(self) -> None:
        """Ramp down and hold the position."""
        self.state = State.PAUSED
        self._ramp_down()

    def resume(self) -> None:
        """Fade in where `pause` held, or the hand is."""
        self.state = State.PLAYING
        if self._profile is not None:
            self._profile.begin()

    def stop(self, state: State) -> None:
        """Ramp down at once, drop the stream and stay in `state`. The captures remain."""
        if self.state == State.PLAYING:
            self._ramp_down()
        self.state = state
        self._buffer.clear()
        self._pending = self._pending[:0]

    def set_loops(self, loops: int) -> None:
        """Set all iterations, those played counted; 0 = until stopped. Raises Refusal where one is too short for it."""
        if loops != 1:
            self._refuse_short_iterations()
        self._loops = loops

    def set_gain(self, gain: float) -> None:
        """Move to another gain, along a ramp."""
        self._dac.set_gain(gain)

    def end_live(self, packets: int) -> None:
        """State how many packets the live stream has; if more have been decoded, it ends with those."""
        self._packets = max(packets, self._next)

    def advance(self, time_us: int) -> Codes:
        """Return the DAC codes int16 (n, channels) that are due up to this time and were not returned before."""
        if self.state == State.ARMED:
            self._begin_if_ready(time_us)
        due = (time_us - self._clock_from_us) * self._dac_rate_hz // 1_000_000 - self._clock_samples
        pieces = [self._ramp[:0]]
        while due > 0:
            if len(self._ramp):
                piece, self._ramp = self._ramp[:due], self._ramp[due:]
            elif self.state == State.PLAYING and self._has_drive(due):
                piece, self._pending = self._dac.play(self._pending[:due]), self._pending[due:]
            elif self.state == State.PLAYING and not self._dac.at_rest:
                self._ramp_down()
                continue
            else:
                break
            due -= len(piece)
            self._clock_samples += len(piece)
            pieces.append(piece)
        codes = np.concatenate(pieces)
        if len(codes):
            played_us = math.ceil(self._clock_samples * 1_000_000 / self._dac_rate_hz)
            self._rest_from_us = self._clock_from_us + played_us
        if due > 0:  # at rest: the time that passes here owes no samples later
            self._clock_from_us, self._clock_samples = time_us, 0
            if self.state == State.PLAYING:
                self.state = State.FINISHED
                self._buffer.clear()
        self.captures[Tap.DAC].write(codes)
        return codes

    def flush(self, time_us: int) -> Codes:
        """Return what is left of the ramp to rest after `stop`; the DAC takes all of it now."""
        codes, self._ramp = self._ramp, self._ramp[:0]
        if len(codes):
            self._rest_from_us = time_us + math.ceil(len(codes) * 1_000_000 / self._dac_rate_hz)
        self.captures[Tap.DAC].write(codes)
        return codes

    def status(self, device_time_us: int, bad_frames: int) -> Status:
        """Return what a Status message says."""
        pending = 0
        if self._profile is None:
            pending = math.ceil(len(self._pending) * self._header.rate_hz / self._dac_rate_hz)
        self._position = max(self._position, self._next * self._packet_samples - pending)
        counts = self._dac.counts
        return Status(
            state=self.state,
            stream=self.stream,
            device_time_us=device_time_us,
            position=self._position,
            credit_until=self.credit_until,
            buffered_samples=len(self._buffer) * self._packet_samples + pending,
            bad_frames=min(_LARGEST_COUNT, bad_frames),
            underruns=min(_LARGEST_COUNT, self._underruns),
            lost_packets=min(_LARGEST_COUNT, self._lost_packets),
            compensation_clipped=min(_LARGEST_COUNT, counts.compensation_clipped),
            voltage_limited=min(_LARGEST_COUNT, counts.voltage_limited),
            slew_limited=min(_LARGEST_COUNT, counts.slew_limited),
            power_limited=min(_LARGEST_COUNT, counts.power_limited),
        )

    def _refuse_misfits(self) -> None:
        """Raise Refusal for what the header, or the buffer, has no room for."""
        packets, packet_samples, end = self._packets or 0, self._packet_samples, self._recording_end
        if end is not None and packets * packet_samples >= end + 2 * packet_samples:
            raise Refusal(
                ErrorCode.BAD_VALUE,
                f"{packets} packets of {packet_samples} samples are too many for the {self._header.samples} samples "
                "that the stream header announces",
            )
        room = self.room_samples
        if not room or self._prebuffer_samples > room:
            raise Refusal(
                ErrorCode.BEYOND_LIMITS,
                f"a prebuffer of {self._prebuffer_samples} samples in packets of {packet_samples}; the buffer has room "
                f"for {room} samples in such packets",
            )

    def _refuse_profile(self, first_packet: int, profile_samples: int) -> None:
        """Raise Refusal for a profile that cannot be loaded as a whole, or not be rendered."""
        samples, end = self._header.samples, self._recording_end
        if samples is None or end is None or first_packet or (self._packets or 0) * self._packet_samples < end:
            raise Refusal(
                ErrorCode.BAD_VALUE,
                "a profile is loaded as a whole: its header says its length, and its packets hold all of it",
            )
        if samples > profile_samples // self.channels:
            raise Refusal(
                ErrorCode.BEYOND_LIMITS,
                f"a profile of {samples} samples; there is room for {profile_samples} in all channels together",
            )
        least = min_samples(self._header.rate_hz, self._dac_rate_hz)
        if not least or samples < least:
            raise Refusal(
                ErrorCode.BEYOND_LIMITS,
                f"a profile of {samples} samples; at its pitch it needs {least} to be rendered at 300 mm/s",
            )

    def _refuse_short_iterations(self) -> None:
        """Raise Refusal if an iteration plays too little of what it decodes, or too shortly, to be repeated."""
        if self._header.spatial:
            raise Refusal(ErrorCode.BAD_VALUE, "a profile repeats by itself as the hand goes on: loops is 1")
        if self.live:
            raise Refusal(ErrorCode.BAD_VALUE, "a live stream cannot loop")
        decoded = (self._packets or 0) * self._packet_samples
        end = decoded if self._recording_end is None else min(decoded, self._recording_end)
        played = end - self._decoder.delay_samples
        needed = max(SHORTEST_ITERATION_SECONDS * self._header.rate_hz, decoded / DECODED_PER_PLAYED)
        if played < needed:
            raise Refusal(
                ErrorCode.BAD_VALUE,
                f"an iteration would play {max(0, played)} of the {decoded} samples in its packets, and needs to play "
                f"{math.ceil(needed)} to be repeated: send a longer one that holds several repeats",
            )

    def _end(self) -> int | None:
        """Return the number of packets in all, None while it is open."""
        if self._packets is None or self._loops == 0:
            return None
        iterations_begun = max(0, self._next - 1) // max(1, self._packets) + 1
        return self._packets * max(self._loops, iterations_begun)

    def _begin_if_ready(self, time_us: int) -> None:
        buffered_samples = (self._newest + 1 - self._next) * self._packet_samples
        if self._profile is not None:
            ready = self._next == self._packets
        else:
            ready = (
                buffered_samples >= self._prebuffer_samples
                or self._newest + 1 == self._end()
                or time_us - self._waiting_since_us > LONGEST_WAIT_US
            )
        if not ready:
            # The prebuffer has not come in time: it begins when it is there.
            self._start_us = max(self._start_us, time_us)
        elif self._start_us <= time_us:
            self.state = State.PLAYING
            self._clock_from_us, self._clock_samples = self._start_us, 0

    def _has_drive(self, count: int) -> bool:
        """Decode until `count` samples of drive are there, or fewer at the end; return whether there are any.

        Of a profile, render what is under the hand at the times of the next `count` samples.
        """
        if self._profile is not None:
            samples = range(self._clock_samples, self._clock_samples + count)
            times_us = (self._clock_from_us + sample * 1_000_000 // self._dac_rate_hz for sample in samples)
            heights = self._profile.render(max(0, time_us - self._hand_delay_us) for time_us in times_us)
            self._pending = self._drive.push(heights)
            return True
        while len(self._pending) < count and not self._drained:
            end = self._end()
            if end is not None and self._next >= end:
                made = self._drive.finish()
                self._drained = True
            else:
                made = self._drive.push(self._decode_next())
            self._pending = np.concatenate((self._pending, made))
        return len(self._pending) > 0

    def _decode_next(self) -> Decoded:
        """Return the part to be played of the next packet, int16 (n, channels), or of what conceals its loss."""
        index = self._next
        self._next += 1
        iteration, number = divmod(index, self._packets) if self._packets else (0, index)
        if number == 0 and iteration > 0:
            self._decoder = self._make_decoder()
            self._drive.join()
        packet = self._buffer.pop(index, None)
        starved = packet is None and not self._buffer
        self._underruns += starved and not self._starved
        self._starved = starved
        decoded = self._decode(packet) if packet is not None else None
        if decoded is None:
            self._lost_packets += 1
            decoded = self._decoder.conceal()
        self.captures[Tap.DECODED].write(decoded)
        # Iterations join without a gap: a later one begins behind the codec's delay, each ends with the recording.
        first = self._decoder.delay_samples if iteration > 0 or self._profile is not None else 0
        end = None if self.live else self._recording_end
        last = None if end is None else max(0, end - number * self._packet_samples)
        return decoded[max(0, first - number * self._packet_samples) : last]

    def _decode(self, packet: bytes) -> Decoded | None:
        try:
            return self._decoder.decode(packet)
        except CodecError:
            return None

    def _ramp_down(self) -> None:
        if not len(self._ramp):
            self._ramp = self._dac.ramp_down()
