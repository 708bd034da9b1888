"""Fuzzes the firmware: builds the targets of firmware/fuzz, replays the corpus, or looks for new inputs with libFuzzer.

`python -m tests.firmware.fuzzing` does the latter (`make fuzz`); what it finds stays in firmware/build/fuzz.
"""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import click

FIRMWARE = Path(__file__).parents[2] / "firmware"
CORPUS = FIRMWARE / "fuzz" / "corpus.zip"
TARGETS = ("frames", "messages", "images", "streams", "flash", "controller")

_FOLDERS = [FIRMWARE / "core", FIRMWARE / "controller", FIRMWARE / "fuzz"]
# A small controller, which is quick to reset for each input.
_SIZES = {
    "VC_CHANNELS": 2,
    "VC_MAX_CHANNELS": 4,
    "VC_BUFFER_SAMPLES": 4096,
    "VC_BUFFER_PACKETS": 32,
    "VC_CAPTURE_SAMPLES": 1000,
}
_FLAGS = ["-std=c99", "-g", "-O1", "-Wall", "-Wextra", "-Werror", "-fno-sanitize-recover=all"]


def build(compiler: list[str], sanitisers: str, program: Path) -> subprocess.CompletedProcess[str]:
    """Compile libFuzzer's program, where `sanitisers` have "fuzzer" among them, or else the one that replays."""
    sources = [path for folder in _FOLDERS for path in sorted(folder.glob("*.c"))]
    if "fuzzer" in sanitisers:
        sources.remove(FIRMWARE / "fuzz" / "replay.c")
    sizes = [f"-D{name}={value}" for name, value in _SIZES.items()]
    includes = [f"-I{folder}" for folder in _FOLDERS]
    command = [*compiler, *_FLAGS, f"-fsanitize={sanitisers}", *sizes, *includes, *map(str, sources)]
    return subprocess.run([*command, "-o", str(program)], capture_output=True, text=True)


def corpus(target: str) -> dict[str, bytes]:
    """Return the inputs of a target, by name."""
    with zipfile.ZipFile(CORPUS) as archive:
        names = [name for name in archive.namelist() if name.startswith(f"{target}/")]
        return {name.removeprefix(f"{target}/"): archive.read(name) for name in names}


def replay(program: Path, target: str, inputs: list[bytes], copies: int) -> subprocess.CompletedProcess[bytes]:
    """Run a target over inputs and over changed copies of each."""
    piped = b"".join(len(data).to_bytes(4, "little") + data for data in inputs)
    environment = os.environ | {"FUZZ_TARGET": target}
    return subprocess.run([str(program), str(copies)], input=piped, capture_output=True, env=environment, timeout=300)


@click.command()
@click.option("--seconds", default=60, show_default=True, help="Time for each target.")
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
    for target in names or TARGETS:
        found = folder / target
        found.mkdir(exist_ok=True)
        for name, data in corpus(target).items():
            (found / name).write_bytes(data)
        click.echo(f"{target}: {seconds} s")
        command = [str(program), f"-max_total_time={seconds}", "-timeout=10", f"-artifact_prefix={found}-", str(found)]
        done = subprocess.run(
            [*command, "-verbosity=0", "-print_final_stats=1"], env=os.environ | {"FUZZ_TARGET": target}
        )
        if done.returncode != 0:
            sys.exit(
                f"{target} failed: the input is beside {found}; mend it and add it to tests/firmware/make_corpus.py"
            )


if __name__ == "__main__":
    main()
