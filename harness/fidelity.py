"""Compares the played texture with the sent one: DAC codes bit by bit, and the skin, recorded or modelled."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vibrocast.codec.encoding import encode_recording
from vibrocast.harness.sensors import Recorder, recorded
from vibrocast.host import playback, player
from vibrocast.host.picture import third_octave_levels
from vibrocast.host.session import Session
from vibrocast.host.skin_quality import compare_skin, displacement_above_20_hz, high_passed
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

    `as_decoded`, `as_computed`: whether the samples that the controller decoded, and the codes that went to the DAC,
    are bit for bit what the host computes; None where the controller has no read-back. `coding_snr_db`: of the decoded
    signal, in the texture's unit; `decoded_snr_db`: of the same as displacement above 20 Hz, for which acceleration is
    integrated twice: the codec's noise at low frequencies weighs most then. The rest is of that displacement at the
    skin, which `source` measured or modelled: `snr_db` and `st_sim` compare it with the texture, `playing_snr_db` with
    the decoded signal, which leaves the codec out. `weighted_snr_db`: weighted by the threshold of touch.
    `gain`: at the skin over sent. `lag_ms`: within the recording. `drift_ppm`: of the recorder's clock. `packets`: that
    were sent; `underruns`, `lost_packets`: while it played.
    """

    texture: str
    source: str
    as_decoded: bool | None
    as_computed: bool | None
    coding_snr_db: float | None
    decoded_snr_db: float | None
    snr_db: float | None
    weighted_snr_db: float | None
    st_sim: float | None
    playing_snr_db: float | None
    gain: float
    lag_ms: float
    drift_ppm: float
    packets: int
    underruns: int
    lost_packets: int
    spectrum: Spectrum


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
    report = played.report
    return Fidelity(
        texture=texture.name,
        source=source,
        as_decoded=report.decoded_equals_offline,
        as_computed=report.dac_equals_offline,
        coding_snr_db=encoding.quality.snr_db,
        decoded_snr_db=quality.decoded_snr_db,
        snr_db=quality.snr_db,
        weighted_snr_db=quality.weighted_snr_db,
        st_sim=quality.st_sim,
        playing_snr_db=quality.playing_snr_db,
        gain=laid.gain,
        lag_ms=1e3 * laid.lag_s,
        drift_ppm=laid.drift_ppm,
        packets=report.packets,
        underruns=report.underruns,
        lost_packets=report.lost_packets,
        spectrum=Spectrum(tuple(frequencies_hz.tolist()), tuple(sent_db.tolist()), tuple(residual_db.tolist())),
    )
