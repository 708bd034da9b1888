"""Fuzzes the firmware: builds the targets of firmware/fuzz, and looks for inputs that they do not take.

`python -m tests.firmware.fuzzing` does so with libFuzzer (`make fuzz`); what it finds stays in firmware/build/fuzz.
"""

import os
import re
import subprocess
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import click

FIRMWARE = Path(__file__).parents[2] / "firmware"
FUZZ = FIRMWARE / "fuzz"
CORPUS = FUZZ / "corpus.zip"
CODECS = ("mdct", "dct", "slp", "eva", "parametric")
TARGETS = (*CODECS, "streams", "frames", "messages", "headers", "images", "output", "profile", "flash", "controller")
ENGINE = FUZZ / "engine.c"
FLAGS = ["-std=c99", "-g", "-O1", "-Wall", "-Wextra", "-Werror", "-fno-sanitize-recover=all", f"-I{FUZZ}"]
COUNTING = "-fsanitize-coverage=inline-8bit-counters"
"""The option of Clang by which the engine sees which code an input reaches."""

_FOLDERS = [*(FIRMWARE / "src" / name for name in ("core", "controller")), FUZZ]
# A small controller, which is quick to reset for each input.
_SIZES = {
    "VC_CHANNELS": 2,
    "VC_MAX_CHANNELS": 4,
    "VC_BUFFER_SAMPLES": 4096,
    "VC_BUFFER_PACKETS": 32,
    "VC_CAPTURE_SAMPLES": 1000,
}
# One input of a target takes some milliseconds; a computer may be busy.
_INPUT_SECONDS = 10
_MARGIN_SECONDS = 240


class FaultError(Exception):
    """A target that stopped, with its output."""


@dataclass(frozen=True)
class Counts:
    """The inputs that a target took, the seconds that they took, and the edges of the program that they reached."""

    target: str
    inputs: int
    seconds: int
    edges: int


def build(compiler: list[str], sanitisers: str, program: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Compile libFuzzer's program, where `sanitisers` have "fuzzer" among them, or else that of the engine."""
    sources = [path for folder in _FOLDERS for path in sorted(folder.glob("*.c"))]
    if "fuzzer" in sanitisers:
        sources.remove(ENGINE)
    sizes = [f"-D{name}={value}" for name, value in _SIZES.items()]
    includes = [f"-I{FIRMWARE / 'include'}"]
    command = [*compiler, *FLAGS, f"-fsanitize={sanitisers}", *options, *sizes, *includes, *map(str, sources)]
    return subprocess.run([*command, "-o", str(program)], capture_output=True, text=True)


def corpus(target: str) -> dict[str, bytes]:
    """Return the inputs of a target, by name."""
    with zipfile.ZipFile(CORPUS) as archive:
        names = [name for name in archive.namelist() if name.startswith(f"{target}/")]
        return {name.removeprefix(f"{target}/"): archive.read(name) for name in names}


def run_engine(program: Path, target: str, inputs: list[bytes], seconds: int, seed: int, found: Path) -> Counts:
    """Run a target over inputs, and for some seconds over changed ones. Raises FaultError, and writes `found` then."""
    piped = b"".join(len(data).to_bytes(4, "little") + data for data in inputs)
    command = [str(program), str(seconds), str(seed), str(found)]
    environment = os.environ | {"FUZZ_TARGET": target, "ASAN_OPTIONS": "abort_on_error=1"}
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment
    ) as engine:
        try:
            output, errors = engine.communicate(piped, timeout=seconds + _MARGIN_SECONDS)
        except subprocess.TimeoutExpired:
            engine.terminate()  # it writes the input that it is at
            output, errors = engine.communicate()
    if engine.returncode != 0:
        raise FaultError(f"{target}, seed {seed}: exit {engine.returncode}, {found}\n{errors.decode(errors='replace')}")
    ran, edges = map(int, re.findall(r"\d+", output.decode()))
    return Counts(target, ran, seconds, edges)


def run_libfuzzer(program: Path, target: str, seconds: int, folder: Path) -> Counts:
    """Look for inputs with libFuzzer for some seconds, and keep those that reach new code. Raises FaultError."""
    kept = folder / target
    kept.mkdir(exist_ok=True)
    for name, data in corpus(target).items():
        (kept / name).write_bytes(data)
    limits = [f"-max_total_time={seconds}", f"-timeout={_INPUT_SECONDS}", "-rss_limit_mb=4096"]
    command = [str(program), *limits, f"-artifact_prefix={kept}-", "-print_final_stats=1", str(kept)]
    environment = os.environ | {"FUZZ_TARGET": target}
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", env=environment)
    if done.returncode != 0:
        raise FaultError(f"{target}: the input is beside {kept}\n{done.stderr[-4000:]}")
    return libfuzzer_counts(target, done.stderr)


def libfuzzer_counts(target: str, log: str) -> Counts:
    """Return the counts at the end of libFuzzer's log."""
    (inputs, seconds), *_ = re.findall(r"^Done (\d+) runs in (\d+) second", log, re.MULTILINE)
    edges = re.findall(r" cov: (\d+) ", log)[-1]
    return Counts(target, int(inputs), int(seconds), int(edges))


def in_parallel(run: Callable[[str, int], Counts], targets: tuple[str, ...], seconds: int) -> list[Counts]:
    """Run targets, as many at a time as there are processors, each for its share of the seconds that all take."""
    processors = min(len(targets), os.cpu_count() or 1)
    share = max(1, seconds * processors // len(targets))
    with ThreadPoolExecutor(processors) as pool:
        return list(pool.map(lambda target: run(target, share), targets))


@click.command()
@click.option("--seconds", default=3600, show_default=True, help="Time for all targets together.")
@click.argument("names", metavar="[TARGET]...", nargs=-1, type=click.Choice(TARGETS))
def main(seconds: int, names: tuple[str, ...]) -> None:
    """Look for inputs that a target of the firmware does not take, all targets if none is named. Needs clang."""
    folder = FIRMWARE / "build" / "fuzz"
    folder.mkdir(parents=True, exist_ok=True)
    program = folder / "fuzz"
    try:
        built = build(["clang"], "fuzzer,address,undefined", program)
    except FileNotFoundError as error:
        raise click.ClickException("libFuzzer comes with clang: install clang and its runtime libraries") from error
    if built.returncode != 0:
        raise click.ClickException(built.stderr)
    try:
        found = in_parallel(
            lambda target, share: run_libfuzzer(program, target, share, folder), names or TARGETS, seconds
        )
    except FaultError as error:
        raise click.ClickException(f"{error}\nmend it, and add the input to tests/firmware/make_corpus.py") from error
    for counts in found:
        click.echo(f"{counts.target}: {counts.inputs} inputs in {counts.seconds} s, {counts.edges} edges")


if __name__ == "__main__":
    main()
