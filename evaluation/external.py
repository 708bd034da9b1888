"""Codecs that are programs of the user's: a TOML file says how they are called, and they code WAV files."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import soundfile
from msgspec import Meta, structs
from numpy.typing import NDArray

from vibrocast.errors import InputError, located
from vibrocast.toml_tables import Table, check_programs, convert, read_toml

PEAK = 0.8
"""Peak of the WAV file that a program is given: many codecs clip or saturate nearer to full scale."""
MAX_LAG_SAMPLES = 4096
"""Delays up to here are found by cross-correlation."""

_MAX_EXCESS_SAMPLES = 2 * MAX_LAG_SAMPLES
_MAX_SHORTFALL = 0.1
_PLACEHOLDER = re.compile(r"\{(\w*)\}")
_PLACEHOLDERS = ("input", "output", "input_folder", "output_folder", "scratch_folder", "setting", "rate_hz")

Command = tuple[str, ...]
_COMMANDS = "a list of a program and its arguments, or a list of such lists"
_Part = Annotated[str, Meta(pattern=r"\A[^\x00]*\Z")]
_Commands = Annotated[
    tuple[_Part | Annotated[tuple[_Part, ...], Meta(min_length=1)], ...], Meta(min_length=1, description=_COMMANDS)
]


class ProgramTable(Table, frozen=True):
    """A table of the list: `Program` has what the keys mean."""

    encoder: _Commands
    decoder: _Commands
    settings: Annotated[tuple[str | int | float, ...], Meta(min_length=1, description="a list of texts or numbers")] = (
        "",
    )
    label_rate_hz: Annotated[int, Meta(ge=1)] | None = None
    delay_samples: Annotated[int, Meta(ge=0)] | None = None
    coded_suffix: Annotated[str, Meta(pattern=r"\A\.\w+\Z", description="a text such as '.spx'")] = ".bin"
    timeout_s: Annotated[float, Meta(ge=1)] = 60.0


class Program(ProgramTable, frozen=True, kw_only=True):
    """A codec in programs of their own.

    `name`: of the curve. `file`: where it was listed. `encoder`, `decoder`: commands, run one after another, their
    arguments with {input}, {output}, {input_folder}, {output_folder}, {scratch_folder} (empty at first), {setting} and
    {rate_hz} to be filled in. `settings`: the set of rate points, coarsest first. `label_rate_hz`: what the WAV file is
    labelled with, None = the signal's own rate. `delay_samples`: what the decoder's output lags by, None = found by
    cross-correlation. `coded_suffix`: of the coded file's name. `timeout_s`: for each command.
    """

    name: str
    file: Path
    encoder: tuple[Command, ...]
    decoder: tuple[Command, ...]
    settings: tuple[str, ...] = ("",)


class Run(NamedTuple):
    """The result of coding: aligned samples (n, 1), the number of bytes, wall-clock seconds with process start."""

    decoded: NDArray[np.float64]
    size_bytes: int
    encode_s: float
    decode_s: float


def read_programs(path: Path, allow_programs: bool = False) -> list[Program]:
    """Read the list of programs: a table for each, named as its curve, with the fields of `Program` as keys.

    `allow_programs`: whether they may be started. Raises InputError where they may not, and where it is no such
    file; OSError where it cannot be read.
    """
    with located(path):
        programs = [_program(path, name, table) for name, table in read_toml(path, "list of programs").items()]
        check_programs({f"[{each.name}]": each.encoder[0][0] for each in programs}, allow_programs)
        return programs


def run(program: Program, setting: str, samples: NDArray[np.float64], rate_hz: int) -> Run:
    """Code and decode samples (n, 1) of any unit by the program, in a folder of its own that is removed afterwards.

    The WAV file is of 16 bit and peaks at PEAK. Samples that the decoder leaves out at the end, up to a tenth, count as
    silence. Raises InputError where a command is missing, fails, hangs, or leaves nothing usable; OSError where
    there is no room for the files.
    """
    if samples.ndim != 2 or samples.shape[1] != 1 or not len(samples) or not np.all(np.isfinite(samples)):
        raise InputError(f"{program.name}: samples of shape {samples.shape}; it takes one channel of finite numbers")
    scale = PEAK / (float(np.max(np.abs(samples))) or 1.0)
    label_hz = program.label_rate_hz or rate_hz
    with tempfile.TemporaryDirectory(prefix="vibrocast-") as folder:
        original, coded, decoded = (Path(folder, part) for part in ("original", "coded", "decoded"))
        for part in (original, coded, decoded):
            part.mkdir()
        original_file, coded_file, decoded_file = original / "signal.wav", coded / "signal", decoded / "signal.wav"
        coded_file = coded_file.with_suffix(program.coded_suffix)
        soundfile.write(original_file, samples * scale, label_hz, subtype="PCM_16")
        values = {"setting": setting, "rate_hz": str(label_hz)}
        encode_s = _run_commands(program, program.encoder, original_file, coded_file, values)
        size_bytes = sum(file.stat().st_size for file in coded.rglob("*") if file.is_file())
        if not size_bytes:
            raise InputError(f"{program.name}: the encoder wrote nothing; correct its arguments in {program.file}")
        decode_s = _run_commands(program, program.decoder, coded_file, decoded_file, values)
        output = _read_output(program, decoded, len(samples), label_hz)
    aligned = _aligned(samples[:, 0], output / scale, program.delay_samples)
    return Run(aligned[:, None], size_bytes, encode_s, decode_s)


def _program(path: Path, name: str, table: object) -> Program:
    """Return a program from its table. Raises ValueError."""
    with located(f"[{name}]"):
        if not isinstance(table, dict):
            raise ValueError(f"it must be a table of its own: begin it with [{name}]")
        read = structs.asdict(convert(table, ProgramTable))
        commands = {key: _commands(key, read[key]) for key in ("encoder", "decoder")}
        return Program(**{**read, **commands, "settings": tuple(map(str, read["settings"]))}, name=name, file=path)


def _commands(key: str, parts: tuple[str | Command, ...]) -> tuple[Command, ...]:
    """Return the commands of a list of lists, or of one command's parts. Raises ValueError."""
    texts = tuple(part for part in parts if isinstance(part, str))
    commands = tuple(part for part in parts if not isinstance(part, str))
    if texts and commands:
        raise ValueError(f"{key} must be {_COMMANDS}")
    named = {found for command in commands or (texts,) for part in command for found in _PLACEHOLDER.findall(part)}
    if unknown := sorted(named - set(_PLACEHOLDERS)):
        raise ValueError(f"{key} has {{{unknown[0]}}}; choose from {', '.join(_PLACEHOLDERS)}")
    return commands or (texts,)


def _run_commands(
    program: Program, commands: Sequence[Command], source: Path, target: Path, values: dict[str, str]
) -> float:
    """Run an encoder's or decoder's commands; return the seconds that they took. Raises InputError."""
    with tempfile.TemporaryDirectory(dir=source.parents[1]) as scratch:
        filled = {
            **values,
            "input": str(source),
            "output": str(target),
            "input_folder": str(source.parent),
            "output_folder": str(target.parent),
            "scratch_folder": scratch,
        }
        started = time.perf_counter()
        for command in commands:
            arguments = [_PLACEHOLDER.sub(lambda found: filled[found[1]], part) for part in command]
            _run_command(program, arguments, source.parents[1])
        return time.perf_counter() - started


def _run_command(program: Program, arguments: Sequence[str], folder: Path) -> None:
    executable = shutil.which(arguments[0])
    if executable is None:
        raise InputError(f"{program.name}: {arguments[0]} not found; install it or correct its path in {program.file}")
    with tempfile.TemporaryFile(dir=folder) as errors:
        try:
            process = subprocess.Popen(
                [os.path.abspath(executable), *arguments[1:]],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                start_new_session=True,
            )
        except OSError as error:
            raise InputError(f"{program.name}: {arguments[0]} cannot be started: {error.strerror}") from error
        try:
            code = process.wait(program.timeout_s)
        except subprocess.TimeoutExpired as error:
            raise InputError(
                f"{program.name}: {arguments[0]} did not end within {program.timeout_s:g} s; "
                f"raise timeout_s in {program.file} if it needs longer"
            ) from error
        finally:
            _kill_group(process)
        if code != 0:
            errors.seek(0)
            said = _last_line(errors.read())
            how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
            raise InputError(f"{program.name}: {arguments[0]} {how}{': ' * bool(said)}{said}")


def _kill_group(process: "subprocess.Popen[bytes]") -> None:
    """Kill a program that still runs, with all that it has started."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _last_line(text: bytes) -> str:
    lines = text.decode(errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "")[:200]


def _read_output(program: Program, folder: Path, samples: int, rate_hz: int) -> NDArray[np.float64]:
    """Return the samples (m,) of the one file that the decoder left. Raises InputError unless they fit."""
    files = [file for file in folder.rglob("*") if file.is_file()]
    if len(files) != 1:
        raise InputError(f"{program.name}: the decoder wrote {len(files)} files; correct its arguments")
    try:
        with soundfile.SoundFile(files[0]) as file:
            if file.channels != 1 or file.samplerate != rate_hz:
                raise InputError(
                    f"{program.name}: decoded to {file.channels} channels at {file.samplerate} Hz "
                    f"instead of one at {rate_hz} Hz; correct its arguments in {program.file}"
                )
            if not samples * (1 - _MAX_SHORTFALL) <= file.frames <= samples + _MAX_EXCESS_SAMPLES:
                raise InputError(
                    f"{program.name}: decoded to {file.frames} samples instead of {samples}; correct its arguments "
                    f"in {program.file}"
                )
            output: NDArray[np.float64] = file.read(dtype="float64")
    except soundfile.LibsndfileError as error:
        raise InputError(
            f"{program.name}: the decoder's output is no WAV file ({error.error_string}); correct its arguments"
        ) from error
    if not np.all(np.isfinite(output)):
        raise InputError(f"{program.name}: the decoder's output holds NaN or infinity; correct its arguments")
    return output


def _aligned(
    reference: NDArray[np.float64], output: NDArray[np.float64], delay_samples: int | None
) -> NDArray[np.float64]:
    """Return the output, its delay removed, cut or filled with silence to the length of the reference."""
    lag = _lag(reference, output) if delay_samples is None else delay_samples
    shifted = np.concatenate([np.zeros(max(-lag, 0)), output[max(lag, 0) :]])[: len(reference)]
    return np.pad(shifted, (0, len(reference) - len(shifted)))


def _lag(reference: NDArray[np.float64], output: NDArray[np.float64]) -> int:
    """Return by how much the output lags: the nearest peak of the cross-correlation, 0 for silence."""
    size = len(reference) + len(output) + MAX_LAG_SAMPLES
    spectrum = np.fft.rfft(output, size) * np.conj(np.fft.rfft(reference, size))
    correlation = np.fft.irfft(spectrum, size)
    lags = sorted(range(-MAX_LAG_SAMPLES, MAX_LAG_SAMPLES + 1), key=abs)
    return lags[int(np.argmax(correlation[lags]))]
