"""The C library in a CMake project: by find_package, by add_subdirectory and by FetchContent."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.firmware.test_small import coded
from vibrocast.firmware.build import ROOT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cmake") is None or shutil.which("make") is None, reason="no CMake or no make"),
]

FIRMWARE = ROOT.resolve()
SWITCHES = "VC_WITH_EVA=0;VC_WITH_MDCT=0"
WAYS = {
    "find_package": "find_package(vibrocast 0.1 REQUIRED)",
    "add_subdirectory": f"add_subdirectory({FIRMWARE} vibrocast)",
    "FetchContent": (
        f"include(FetchContent)\nFetchContent_Declare(vibrocast SOURCE_DIR {FIRMWARE.parent} SOURCE_SUBDIR firmware)\n"
        "FetchContent_MakeAvailable(vibrocast)"
    ),
}


def run(*command: str | Path) -> None:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def configure(source: Path, build: Path, tools: Path, *options: str) -> None:
    compiler = [
        f"-DCMAKE_C_COMPILER={tools / 'cc'}",
        f"-DCMAKE_AR={tools / 'ar'}",
        f"-DCMAKE_RANLIB={tools / 'ranlib'}",
    ]
    run("cmake", "-G", "Unix Makefiles", "-S", source, "-B", build, *compiler, *options)


@pytest.fixture(scope="module")
def tools(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a compiler and an archiver, those of ziglang."""
    folder = tmp_path_factory.mktemp("tools")
    for name in ("cc", "ar", "ranlib"):
        (folder / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ziglang {name} "$@"\n')
        (folder / name).chmod(0o755)
    return folder


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory, tools: Path) -> Path:
    folder = tmp_path_factory.mktemp("library")
    prefix = f"-DCMAKE_INSTALL_PREFIX={folder / 'prefix'}"
    configure(FIRMWARE, folder / "build", tools, prefix, f"-DVIBROCAST_DEFINITIONS={SWITCHES}")
    run("cmake", "--build", folder / "build", "--target", "install")
    return folder / "prefix"


@pytest.mark.parametrize("way", WAYS)
def test_a_project_links_the_decoder(tmp_path: Path, tools: Path, installed: Path, way: str) -> None:
    (tmp_path / "CMakeLists.txt").write_text(
        f"cmake_minimum_required(VERSION 3.21)\nproject(player C)\n"
        f"set(VIBROCAST_DEFINITIONS {SWITCHES})\n{WAYS[way]}\n"
        f"add_executable(player {FIRMWARE / 'examples' / 'decode.c'})\n"
        "target_link_libraries(player PRIVATE vibrocast::decoder)\n"
    )
    configure(tmp_path, tmp_path / "build", tools, f"-DCMAKE_PREFIX_PATH={installed}")
    run("cmake", "--build", tmp_path / "build", "--target", "player")
    stream = coded("slp")
    stream.save(tmp_path / "a.vct")
    run(tmp_path / "build" / "player", tmp_path / "a.vct", tmp_path / "a.pcm")
    samples = np.fromfile(tmp_path / "a.pcm", "<i2")
    np.testing.assert_array_equal(samples, stream.decode_integers()[: stream.samples, 0])
    coded("mdct").save(tmp_path / "b.vct")
    command = [str(tmp_path / name) for name in ("build/player", "b.vct", "b.pcm")]
    assert "this build lacks the codec" in subprocess.run(command, capture_output=True, text=True).stderr
