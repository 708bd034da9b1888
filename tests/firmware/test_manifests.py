"""The C library for Arduino and PlatformIO, and the versions that all its manifests state."""

import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from click.testing import CliRunner

from tests.firmware.test_small import coded
from vibrocast.firmware import arduino
from vibrocast.firmware.build import M4F, ROOT, Target

ZIG = [sys.executable, "-m", "ziglang"]
PROJECT = (ROOT.resolve().parent / "pyproject.toml").read_text(encoding="utf-8")
SOURCES = Target("", "", (), ("ports",)).sources()
"""Those of a controller for any board."""
# A stand-in for the part of a board's core that the example needs, and the loop that calls it.
CORE = """
#include <stdint.h>
#include <stdio.h>
#include <string.h>
static struct {
    void begin(long) {}
    void println(int number) { printf("%d\\n", number); }
    void println(const char *text) { puts(text); }
} Serial;
static inline void delay(int) {}
"""
PROGRAM = "#include <Arduino.h>\n{sketch}\nint main() {{ setup(); for (int i = 0; i < {packets}; i++) loop(); }}\n"


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the unpacked Arduino library, whose example decodes a stream of slp."""
    folder = tmp_path_factory.mktemp("arduino")
    coded("slp").save(folder / "a.vct")
    done = CliRunner().invoke(arduino.main, [str(folder / "a.vct"), str(folder / "library.zip")])
    assert done.exit_code == 0, done.output
    with zipfile.ZipFile(folder / "library.zip") as archive:
        archive.extractall(folder)
    return folder / "vibrocast"


def compile_library(library: Path, archive: Path, *target: str) -> None:
    """Compile all sources below src/ into an archive, with src/ as the only include path, as the IDE does."""
    sources = sorted((library / "src").rglob("*.c"))
    assert len(sources) == len(SOURCES)
    flags = ["-cflags", "-Wall", "-Wextra", "-Werror", f"-I{library / 'src'}", "--"]
    command = [*ZIG, "build-lib", "-O", "ReleaseSmall", *target, f"-femit-bin={archive}", *flags]
    done = subprocess.run([*command, *map(str, sources)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_arduino_example_decodes_the_stream(library: Path, tmp_path: Path) -> None:
    archive = tmp_path / "library.a"
    compile_library(library, archive)
    stream, example = coded("slp"), library / "examples" / "decode_array"
    (tmp_path / "Arduino.h").write_text(CORE)
    sketch = PROGRAM.format(sketch=(example / "decode_array.ino").read_text(), packets=len(stream.packets))
    (tmp_path / "sketch.cpp").write_text(sketch)
    folders = [f"-I{folder}" for folder in (tmp_path, example, library / "src")]
    command = [*ZIG, "c++", "-Wall", "-Werror", *folders, tmp_path / "sketch.cpp", archive, "-o", tmp_path / "sketch"]
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    printed = subprocess.run([tmp_path / "sketch"], capture_output=True, text=True).stdout.split()
    start = stream.decoder().delay_samples
    samples = stream.decode_integers()[start : start + stream.samples, 0]
    assert [int(number) for number in printed] == samples.tolist()


@pytest.mark.slow
def test_arduino_library_compiles_for_a_cortex_m(library: Path, tmp_path: Path) -> None:
    compile_library(library, tmp_path / "library.a", "-target", "thumb-freestanding-eabihf", f"-mcpu={M4F}")
    assert (tmp_path / "library.a").exists()


def test_arduino_properties_name_what_is_there(library: Path) -> None:
    lines = (library / "library.properties").read_text().splitlines()
    properties = dict(line.split("=", 1) for line in lines)
    assert {"name", "version", "author", "maintainer"} <= set(properties)
    assert (library / "src" / properties["includes"]).is_file()


def test_arduino_command_takes_no_other_file(tmp_path: Path) -> None:
    (tmp_path / "a.wav").write_bytes(b"RIFF" * 20)
    done = CliRunner().invoke(arduino.main, [str(tmp_path / "a.wav"), str(tmp_path / "library.zip")])
    assert done.exit_code == 1
    assert "a.wav: no .vct file of this version: encode the recording again" in done.output
    assert not (tmp_path / "library.zip").exists()


def test_platformio_filter_selects_the_sources() -> None:
    build = json.loads((ROOT / "library.json").read_text(encoding="utf-8"))["build"]
    selected: set[Path] = set()
    for rule in build["srcFilter"]:
        sign, pattern = re.fullmatch(r"([+-])<(.+)>", rule).groups()  # type: ignore[union-attr]
        found = {path.relative_to(ROOT) for path in (ROOT / build["srcDir"]).glob(pattern)}
        selected = selected | found if sign == "+" else selected - found
    assert selected == set(SOURCES)
    assert (ROOT / build["includeDir"] / "vibrocast" / "decoder.h").is_file()


def test_menu_has_each_codec_and_manifests_state_the_version() -> None:
    codecs = set(re.findall(r"#define (VC_WITH_\w+) 1", (ROOT / "include" / "vibrocast" / "config.h").read_text()))
    assert {f"VC_{name}" for name in re.findall(r"VIBROCAST_(WITH_\w+)", (ROOT / "Kconfig").read_text())} == codecs
    listed = re.search(r"foreach\(codec (.*)\)", (ROOT / "CMakeLists.txt").read_text())
    assert listed and {f"VC_WITH_{name}" for name in listed[1].split()} == codecs
    (version,) = re.findall(r'^version = "(.*)"$', PROJECT, re.MULTILINE)
    patterns = {
        "CMakeLists.txt": r"project\(vibrocast VERSION (\S+)",
        "idf_component.yml": r"(?m)^version: (\S+)$",
        "library.json": r'"version": "(.*)"',
    }
    assert {name: re.findall(pattern, (ROOT / name).read_text()) for name, pattern in patterns.items()} == {
        name: [version] for name in patterns
    }
