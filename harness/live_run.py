"""Streams a texture live, for as long as a test needs, and watches each minute."""

from collections.abc import Callable
from dataclasses import dataclass

from vibrocast.codec.live_format import recording_format
from vibrocast.device_protocol.messages import Status
from vibrocast.harness.latency import looped
from vibrocast.host import live
from vibrocast.host.live_watch import CodedSignal, LiveQuality, Minute, Timing, Watch
from vibrocast.host.playback import Member
from vibrocast.textures import Recording


@dataclass(frozen=True)
class LiveRun:
    """A live stream that has ended. `playout_delay_ms`: how long its packets should lie at the controller."""

    result: live.LiveResult
    playout_delay_ms: float
    minutes: tuple[Minute, ...]
    quality: LiveQuality
    timing: Timing


def run_live(
    member: Member,
    texture: Recording,
    seconds: float = 10.0,
    *,
    rate_hz: int = 2800,
    playout_delay_s: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> LiveRun:
    """Stream the first channel of a texture in real time, again and again until `seconds` are full.

    `playout_delay_s`: None = as `live.LiveStream` chooses. `progress` takes the seconds so far. Raises as
    `live.LiveStream`, and as `CodedSignal.quality`.
    """
    controller = member.controller
    source = looped(texture, seconds, rate_hz)
    stream = live.LiveStream(controller, recording_format(source), playout_delay_s=playout_delay_s)
    watch, coded = Watch(stream), CodedSignal(stream)

    def note(status: Status) -> None:
        watch.note(status)
        if progress is not None:
            progress(stream.seconds)

    result = live.play(stream, coded.blocks(watch.blocks(source.samples)), progress=note)
    watch.close()
    quality = coded.quality(member, None, result)
    return LiveRun(result, 1e3 * stream.playout_delay_s, tuple(watch.minutes), quality, watch.timing(member))
