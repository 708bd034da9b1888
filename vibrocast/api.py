"""The public API: plain arrays and bytes in and out. Import it as `vibrocast`, which lists its names."""

import contextlib
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsFloat

from numpy.typing import ArrayLike

from vibrocast import extras, models, textures
from vibrocast.codec import CODECS, RUNTIMES, BlockCodec, CodecError, Setting, as_codec
from vibrocast.codec import Codec as Codec
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ, encode_recording
from vibrocast.codec.stream import Stream as Stream
from vibrocast.codec.stream import read_stream
from vibrocast.device_protocol.coded_stream import StreamError
from vibrocast.errors import VibrocastError as VibrocastError
from vibrocast.host import devices, playback, player, uploader
from vibrocast.host.devices import Session
from vibrocast.host.report import Report as Report
from vibrocast.host.stream_session import check_unit
from vibrocast.host.track_player import BackgroundPlayer, Command, Event, Source, TrackOptions, tracks_of
from vibrocast.output import actuator_files
from vibrocast.output.actuator import Actuator as Actuator
from vibrocast.textures import HIGHPASS_HZ, TextureError, arguments
from vibrocast.textures import Profile as Profile
from vibrocast.textures import Recording as Recording
from vibrocast.textures import load as load
from vibrocast.textures import load_profile as load_profile

if TYPE_CHECKING:
    from vibrocast.codec.metrics import Quality

_MAX_STREAM_RATE_HZ = 200_000
_MAX_LOOPS = 1_000_000

TrackSource = str | Path | Stream | Recording
Progress = Callable[[float], None]
"""Called with the part of the work that is done, from 0 to 1."""


def encode(  # noqa: PLR0913 - a name for each option reads better than an object of options
    samples: ArrayLike | Recording,
    rate_hz: SupportsFloat | None = None,
    unit: str | None = None,
    *,
    columns: str | Sequence[str | int] | None = None,
    codec: str | None = None,
    rate_bps: float | None = None,
    snr_db: float | None = None,
    model: str | Path | models.Model | None = None,
    setting: Setting | None = None,
    stream_rate_hz: int = DEFAULT_STREAM_RATE_HZ,
    highpass_hz: float | None = HIGHPASS_HZ,
    random_access: bool = False,
    touch: float | None = None,
    progress: Progress | None = None,
) -> Stream:
    """Encode a recording, or an array of samples, into a coded stream.

    Without `rate_bps` and `snr_db`, the target is an SNR of 14.8 dB, unless `setting` or `model` fixes the quality, or
    the codec keeps no waveform.

    Args:
        samples: A Recording, an array (n,) or (n, channels) of any real dtype, or a DataFrame of pandas or Polars. Its
            columns of times, counts and axes are known by name, as in a text file.
        rate_hz: Sample rate of an array in Hz. A Recording states its own, and so do times in a DataFrame.
        unit: Unit of an array: "m/s^2", "g", "nm", "um", "mm" or "drive", the drive signal of an actuator, where 1.0 is
            full scale. None means "full scale" of unknown size. A Recording states its own.
        columns: Names or numbers, from 1, of the channels of a DataFrame or an array to take: "x,z", or ["x", 3].
        codec: A name in `codecs()`. None: the codec of `model`, or "mdct".
        rate_bps: Target size of the whole stream, in bits per second of signal.
        snr_db: Target SNR of every channel in dB. Give this or `rate_bps`, not both.
        model: Name, folder or image of a trained model. None: the built-in tables, or a model that ships.
        setting: Parameters of the codec by name, as `codecs()` describes them.
        stream_rate_hz: Sample rate of the stream in Hz, 2800 by default. The samples are resampled to it.
        highpass_hz: Corner of the high-pass before coding, 20 Hz by default. It applies to acceleration and to "full
            scale". None keeps the whole band.
        random_access: Add packets that decode alone, for a link that loses packets.
        touch: Strength from 0, flat, to 1 by which the error is shaped over frequency for touch. None: 0.25 for a
            physical unit and a codec that can, else 0.
        progress: Function to call with the part of the search that is done, from 0 to 1.

    Returns:
        The stream. Its `quality` states the SNR reached, also at the skin, and the energy removed.

    Raises:
        TextureError: The samples, rate or unit cannot be used.
        CodecError: The codec, setting or target cannot be used; TargetUnreachable is one of these.
        StreamError: The samples are too many for one stream.
        ModelError: There is no such model.
    """
    arguments.of_type("codec", codec, str, "a name in `codecs()`")
    arguments.of_type("setting", setting, Mapping, "a mapping of parameters to values")
    _check_callable(progress)
    encoding = encode_recording(
        _recording(samples, rate_hz, unit, columns),
        stream_rate_hz=arguments.whole_number("stream_rate_hz", stream_rate_hz, 1, _MAX_STREAM_RATE_HZ),
        codec_name=codec,
        rate_bps=arguments.optional_number("rate_bps", rate_bps),
        snr_db=arguments.optional_number("snr_db", snr_db),
        setting=setting,
        model=_model(model),
        live=random_access,
        touch=arguments.optional_number("touch", touch),
        progress=progress,
        highpass_hz=textures.highpass_of(unit, arguments.optional_number("highpass_hz", highpass_hz)),
    )
    return encoding.stream


def decode(
    data: bytes | str | Path | Stream,
    *,
    model: str | Path | models.Model | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Decode a stream to samples, with the codec's delay removed.

    Args:
        data: A Stream, its bytes, or the path of a .vct file.
        model: The model of a stream that was coded for one that does not ship.
        progress: Function to call with the part that is done, from 0 to 1.

    Returns:
        A Recording: float64 samples (n, channels) in the stream's unit.

    Raises:
        StreamError: The data is damaged, or a height profile; call `Stream.profile` for that.
        CodecError: The codec is unknown, or the model is another.
        OSError: The file cannot be read.
    """
    _check_callable(progress)
    name = Path(data).stem if isinstance(data, str | os.PathLike) else "decoded"
    return _stream("data", data, model).recording(name, progress)


def measure(
    reference: ArrayLike | Recording,
    decoded: ArrayLike | Recording,
    rate_hz: SupportsFloat | None = None,
    unit: str | None = None,
    *,
    highpass_hz: float | None = HIGHPASS_HZ,
) -> "Quality":
    """Compare decoded samples with their reference.

    Both are compared after the same high-pass as before coding. Without the extra [bench], ST-SIM and SPQI are None,
    and a warning says so.

    Args:
        reference: A Recording, or an array (n,) or (n, channels).
        decoded: The same, of the same shape.
        rate_hz: Sample rate of arrays in Hz. A Recording states its own.
        unit: Unit of arrays, as in `encode`. A Recording states its own.
        highpass_hz: Corner of the high-pass, 20 Hz by default. None compares the whole band.

    Returns:
        SNR and PSNR in dB, ST-SIM, SPQI and two spectral distances.

    Raises:
        ValueError: The shapes differ, or a value is NaN or infinite.
        TextureError: Rates or units differ.
    """
    from vibrocast.codec import metrics

    perceptual = True
    try:
        extras.require("bench", "vibromaf")
    except extras.MissingExtraError as error:
        perceptual = False
        warnings.warn(f"ST-SIM and SPQI are not measured: {error}", stacklevel=2)

    x, y = (each if isinstance(each, Recording) else _recording(each, rate_hz, unit) for each in (reference, decoded))
    if (x.rate_hz, x.unit) != (y.rate_hz, y.unit):
        raise TextureError(
            f"`decoded` is in {y.unit} at {y.rate_hz:g} Hz, and `reference` in {x.unit} at {x.rate_hz:g} Hz",
            action="pass both in one unit, at one rate",
            parameter="decoded",
        )
    corner_hz = arguments.optional_number("highpass_hz", highpass_hz)
    pair = [textures.highpass(each, corner_hz).recording.samples for each in (x, y)]
    return metrics.measure(pair[0], pair[1], x.rate_hz, x.unit, perceptual)


def render(
    stream: bytes | str | Path | Stream,
    actuator: str | Path | Actuator = "piezo-stack",
    *,
    gain_db: float = 0.0,
    unit: str | None = None,
) -> Recording:
    """Compute the displacement at the skin that a stream causes.

    The integer output stage of a controller computes the DAC codes, with compensation and limits. The model of the
    actuator turns them into displacement.

    Args:
        stream: A Stream, its bytes, or the path of a .vct file.
        actuator: A name such as "piezo-stack", "lra" or "voice-coil", an Actuator, or a TOML file that describes one.
        gain_db: Change of level in dB.
        unit: "drive" for a stream in "full scale" that is the drive signal of an actuator.

    Returns:
        A Recording in um: float64 (n, channels) at 4 times the DAC's rate, aligned with the recording.

    Raises:
        StreamError: The stream is damaged.
        CodecError: The unit or the level cannot be played.
        InputError: There is no such actuator, or its file is wrong.
    """
    return playback.at_the_skin(_playable(stream, unit, gain_db), _actuator(actuator))


class Connection:
    """An open session with a controller. `connect` opens and closes it.

    Attributes:
        controller: The requests of the wire protocol, for programs that need more than the methods here.
    """

    def __init__(self, opened: Session) -> None:
        self.controller = opened.controller
        self._session = opened
        self._playing: BackgroundPlayer | None = None

    def play(
        self,
        stream: bytes | str | Path | Stream,
        *,
        gain_db: float = 0.0,
        unit: str | None = None,
        loops: int = 1,
        progress: Callable[[player.Progress], None] | None = None,
    ) -> Report:
        """Play a stream to its end.

        The host reads back the decoded samples and the DAC codes, and compares both with its own.

        Args:
            stream: A Stream, its bytes, or the path of a .vct file.
            gain_db: Change of level in dB.
            unit: "drive" for a stream in "full scale" that is the drive signal of an actuator.
            loops: How often to play it.
            progress: Function to call with a player.Progress from time to time.

        Returns:
            The figures of the playback.

        Raises:
            CodecError: The unit or the level cannot be played.
            StreamError: The stream is damaged, or the controller cannot play it.
            ControllerError: The controller rejected a request.
            TransportError: The connection failed.
        """
        chosen = _playable(stream, unit, gain_db)
        _check_callable(progress)
        name = str(stream) if isinstance(stream, str | os.PathLike) else "stream"
        passes = arguments.whole_number("loops", loops, 1, _MAX_LOOPS)
        return playback.play(self._session, name, chosen, loops=passes, progress=progress).report

    def status(self) -> dict[str, Any]:
        """Return the properties and the state of the controller as a dictionary, ready for JSON.

        Raises:
            ControllerError: The controller rejected the request.
            TransportError: The connection failed.
        """
        return devices.facts(self.controller)

    def upload(self, model: str | Path | models.Model) -> None:
        """Upload a trained model to the controller, verify it, start it and confirm it.

        Args:
            model: Name, folder or image of a model.

        Raises:
            ModelError: There is no such model.
            ControllerError: The controller rejected the model.
            TransportError: The connection failed.
        """
        chosen = _model(model)
        if chosen is None:
            raise models.ModelError(
                "`model` is None", action="pass the name, the folder or the image of a model", parameter="model"
            )
        uploader.flash(self.controller, chosen.image)

    def start(
        self,
        tracks: TrackSource | Sequence[TrackSource],
        *,
        gain_db: float = 0.0,
        unit: str | None = None,
        loops: int = 1,
        shuffle: bool = False,
        on_event: Callable[[Event], None] | None = None,
    ) -> None:
        """Begin to play tracks one after another, and return at once; a list that plays before ends.

        A recording is coded while it plays. A track that cannot be played is an Event, and the list goes on. Until
        `wait` or `stop` returns, only `pause`, `resume`, `seek`, `next`, `previous` and `gain_db` may be called.

        Args:
            tracks: Streams, Recordings, and paths of files, folders and .m3u lists.
            gain_db: Change of level in dB.
            unit: "drive" for tracks in "full scale" that are the drive signal of an actuator.
            loops: How often the list plays; 0: without end.
            shuffle: Whether it plays in random order.
            on_event: Function to call with each Event, in the player's thread.

        Raises:
            InputError: A list or a folder names no track.
        """
        self.stop()
        several = [tracks] if isinstance(tracks, str | Path | Stream | Recording) else tracks
        sources: list[Source] = []
        for each in several:
            sources += tracks_of([Path(each)]) if isinstance(each, str | Path) else [each]
        options = TrackOptions(facts={"unit": unit}, gain_db=gain_db, loops=loops, shuffle=shuffle)
        self._playing = BackgroundPlayer(self._session, sources, options, on_event)

    def pause(self) -> None:
        """Stay at the position; the output rests."""
        self._command("pause")

    def resume(self) -> None:
        """Go on after `pause`."""
        self._command("resume")

    def seek(self, seconds: float) -> None:
        """Move within the track by so many seconds."""
        self._command("seek", arguments.number("seconds", seconds))

    def next(self) -> None:
        """Play the next track."""
        self._command("next")

    def previous(self) -> None:
        """Play the track before, or this one from its beginning if more than 2 s of it have played."""
        self._command("previous")

    @property
    def gain_db(self) -> float:
        """The change of level since `start`, in dB; a new value is reached in a ramp."""
        return 0.0 if self._playing is None else self._playing.player.gain_db

    @gain_db.setter
    def gain_db(self, gain_db: float) -> None:
        self._command("gain", arguments.number("gain_db", gain_db) - self.gain_db)

    @property
    def plays(self) -> bool:
        """Whether a list that `start` began still plays, or has ended and nobody has waited for it."""
        return self._playing is not None

    def wait(self) -> None:
        """Wait until all tracks have been played.

        Raises:
            ControllerError: The controller rejected a request.
            TransportError: The connection failed.
        """
        playing, self._playing = self._playing, None
        if playing is not None:
            playing.wait()

    def stop(self) -> None:
        """Stop the playback and bring the output to rest. Raises as `wait`."""
        if self._playing is not None:
            self._command("stop")
            self.wait()
        else:
            self.controller.stop()

    def _command(self, word: str, number: float = 0.0) -> None:
        if self._playing is None:
            raise VibrocastError("nothing plays", action="call `start` first")
        self._playing.remote.send(Command(word, number))


@contextlib.contextmanager
def connect(
    address: str = "sim", *, actuator: str | Path | Actuator | None = None, runtime: str | None = None
) -> Iterator[Connection]:
    """Open a session with a controller, and close it at the end of the `with` block.

    Args:
        address: "sim", another name that `vibrocast devices` lists, "serial:PORT[@BAUD]", "usb:VID:PID[:SERIAL]" or
            `audio:CARD[:CHANNELS][@VOLTS]`.
        actuator: A name, an Actuator or a TOML file. A sound card or a simulated controller drives it; for a real
            controller it is the model of the actuator. None: as the controller says; a sound card needs one.
        runtime: "core" or "onnx": the decoder that a simulated controller uses. None: as the model says.

    Yields:
        The session.

    Raises:
        TransportError: The port or the device cannot be opened.
        ControllerError: No controller answers, or it speaks another version of the protocol.
    """
    if not isinstance(address, str):
        raise arguments.wrong_type("address", address, 'text such as "sim"')
    if runtime not in (None, *RUNTIMES):
        raise CodecError(f"`runtime` is {runtime!r}", action=f"pass one of {', '.join(RUNTIMES)}", parameter="runtime")
    chosen = None if actuator is None else _actuator(actuator)
    with devices.open_session(address, runtime, chosen) as opened:
        connection = Connection(opened)
        try:
            yield connection
        finally:
            if connection.plays:
                connection.stop()


def codecs() -> Mapping[str, Codec]:
    """Return the codecs by name: built-in ones, those of other packages, and those that you registered."""
    return CODECS


def register(codec: BlockCodec | type[BlockCodec] | Codec) -> Codec:
    """Add a codec to `codecs()` in this process, or replace one that you registered.

    Other processes, such as the workers of `vibrocast bench`, do not know it. For these, install a package with an
    entry point in the group `vibrocast.codecs`.

    Args:
        codec: An object or a class with the attributes and methods of BlockCodec, or a Codec.

    Returns:
        The codec as `codecs()` lists it.

    Raises:
        CodecError: An attribute or method is missing, or the name is taken.
    """
    try:
        registered = as_codec(codec)
        CODECS.add(registered)
    except CodecError as error:
        raise CodecError("`codec` cannot be registered", str(error), parameter="codec") from error
    return registered


def _recording(
    samples: ArrayLike | Recording,
    rate_hz: SupportsFloat | None,
    unit: str | None,
    columns: str | Sequence[str | int] | None = None,
) -> Recording:
    if isinstance(samples, Recording):
        if rate_hz is not None or unit is not None or columns is not None:
            raise TextureError(
                f"{samples.name}: the recording states its rate and unit",
                action="leave out `rate_hz`, `unit`, `columns`",
                parameter=("rate_hz", "unit", "columns"),
            )
        return samples
    if isinstance(samples, str | os.PathLike):
        raise TextureError(f"{samples}: `samples` is a path", action="pass `vibrocast.load` of it", parameter="samples")
    arguments.of_type("unit", unit, str, 'text such as "m/s^2"')
    return textures.from_array(samples, arguments.optional_number("rate_hz", rate_hz), unit, columns=columns)


def _stream(name: str, data: bytes | str | Path | Stream, model: str | Path | models.Model | None) -> Stream:
    if isinstance(data, Stream):
        if model is not None:
            raise StreamError("a Stream has its model", action="leave out `model`", parameter="model")
        return data
    if not isinstance(data, str | os.PathLike | bytes | bytearray | memoryview):
        raise arguments.wrong_type(name, data, "a Stream, its bytes or the path of a .vct file")
    chosen = _model(model)
    image = None if chosen is None else chosen.image
    if isinstance(data, bytes | bytearray | memoryview):
        return Stream.from_bytes(bytes(data), image)
    return read_stream(Path(data), image)


def _playable(data: bytes | str | Path | Stream, unit: str | None, gain_db: float) -> Stream:
    stream = _stream("stream", data, None)
    if unit not in (None, "drive"):
        raise CodecError(
            f"`unit` is {unit!r}",
            action='pass "drive" for the drive signal of an actuator, or leave it out',
            parameter="unit",
        )
    if unit == "drive" and stream.header.unit != "full scale":
        raise CodecError(
            f"the stream states its unit, {stream.header.unit}", action="leave out `unit`", parameter="unit"
        )
    check_unit(stream.header.unit, unit)
    return stream.with_gain(arguments.number("gain_db", gain_db))


def _check_callable(progress: object) -> None:
    if progress is not None and not callable(progress):
        raise arguments.wrong_type("progress", progress, "a function of one argument")


def _model(model: str | Path | models.Model | None) -> models.Model | None:
    arguments.of_type("model", model, (str, os.PathLike, models.Model), "a name, a path or a Model")
    return model if model is None or isinstance(model, models.Model) else models.find(str(model))


def _actuator(actuator: str | Path | Actuator) -> Actuator:
    if isinstance(actuator, Actuator):
        return actuator
    if not isinstance(actuator, str | os.PathLike):
        raise arguments.wrong_type("actuator", actuator, "a name, an Actuator or a TOML file")
    return actuator_files.find(actuator)
