"""Compares the played texture with the sent one: DAC codes bit by bit, and the skin, recorded or modelled."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from vibrocast.codec.encoding import encode_recording
from vibrocast.harness.sensors import Recorder, recorded
from vibrocast.host import playback, player
from vibrocast.host.devices import Session
from vibrocast.host.figures import WIRE_FIGURES, Value
from vibrocast.host.picture import third_octave_levels
from vibrocast.host.playback import compare_skin, displacement_above_20_hz, high_passed
from vibrocast.host.report import Report
from vibrocast.textures import Recording


@dataclass(frozen=True)
class Spectrum:
    """Levels in third octaves, dB re 1 um peak, at `frequencies_hz`."""

    frequencies_hz: tuple[float, ...]
    sent_db: tuple[float, ...]
    residual_db: tuple[float, ...]


@dataclass(frozen=True)
class Fidelity:
    """How one texture came out.

    `report`: of the playback. Its `quality.snr_db` is of the decoded signal in the texture's unit. Its `quality.skin`
    is of the displacement above 20 Hz, which `source` measured or modelled. There the SNR of the codec is less for
    acceleration, which is integrated twice: the codec's noise at low frequencies weighs most then. `lag_ms`: within the
    recording.
    `drift_ppm`: of the recorder's clock.
    """

    report: Report
    source: str
    lag_ms: float
    drift_ppm: float
    spectrum: Spectrum

    def figures(self) -> Iterator[Value]:
        """Yield the figures of the comparison and of the losses; the delay of a file is not that of a live stream."""
        yield from (value for value in self.report.figures() if value.key not in ("latency_ms", *WIRE_FIGURES))
        yield Value("lag_ms", self.report.file, self.lag_ms)


def measure_fidelity(
    session: Session,
    texture: Recording,
    *,
    recorder: Recorder | None = None,
    sensor_name: str = "",
    progress: Callable[[float], None] | None = None,
) -> Fidelity:
    """Play the first channel of a texture and compare the skin with the sent signal.

    `recorder`: the sensor on that channel; None = the DAC's codes through the model of the actuator. Raises
    SensorError, AlignmentError, and whatever `host.playback.play` raises.
    """
    one = Recording(np.ascontiguousarray(texture.samples[:, :1]), texture.rate_hz, texture.unit, texture.name)
    encoding = encode_recording(one, live=True)

    def tell(now: player.Progress) -> None:
        if progress is not None:
            progress(now.position_s / (now.duration_s or 1.0))

    with recorded(recorder, session.controller, one.seconds) as finish:
        played = playback.play(session, texture.name, encoding.stream, encoding, progress=tell)
        sent, decoded, skin = played.traces
        if finish is None:
            moved, source = Recording(skin.values, skin.rate_hz, "um", "skin"), "the DAC's codes and a model"
        else:
            moved, source = finish(), sensor_name
    rate_hz = round(sent.rate_hz)
    moved_um = displacement_above_20_hz(moved, rate_hz)
    sent_um, decoded_um = (high_passed(signal.displacement_um[:, 0], rate_hz) for signal in (sent, decoded))
    quality, laid, aligned_um = compare_skin(sent_um, decoded_um, moved_um, rate_hz, drifts=finish is not None)
    frequencies_hz, sent_db = third_octave_levels(sent_um, rate_hz)
    _, residual_db = third_octave_levels(sent_um - aligned_um, rate_hz)
    return Fidelity(
        report=replace(played.report, quality=replace(played.report.quality, skin=quality)),
        source=source,
        lag_ms=1e3 * laid.lag_s,
        drift_ppm=laid.drift_ppm,
        spectrum=Spectrum(tuple(frequencies_hz.tolist()), tuple(sent_db.tolist()), tuple(residual_db.tolist())),
    )
