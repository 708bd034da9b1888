"""The C library in CMake: in projects of CMake alone, and in ESP-IDF and Zephyr, of which these are stand-ins."""

import shutil
import subprocess
import sys
from pathlib import Path

import kconfiglib
import numpy as np
import pytest

from tests.firmware.boards import coded
from vibrocast.device_protocol.transports import SerialTransport
from vibrocast.firmware.build import ROOT
from vibrocast.host.controller import Controller

pytestmark = [pytest.mark.slow, pytest.mark.skipif(shutil.which("make") is None, reason="no make")]

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

CMAKE = (sys.executable, "-m", "cmake")
# Stand-ins: they do with a target as the real functions do, and nothing else.
ESP_IDF = """
function(idf_component_register)
  cmake_parse_arguments(component "" "" "SRCS;INCLUDE_DIRS" ${ARGN})
  add_library(vibrocast STATIC ${component_SRCS})
  target_include_directories(vibrocast PUBLIC ${component_INCLUDE_DIRS})
  set(COMPONENT_LIB vibrocast PARENT_SCOPE)
endfunction()
set(ESP_PLATFORM 1)
"""
ZEPHYR = """
add_library(zephyr_interface INTERFACE)
macro(zephyr_library_named name)
  set(ZEPHYR_CURRENT_LIBRARY ${name})
  add_library(${name} STATIC "")
  target_link_libraries(${name} PUBLIC zephyr_interface)
endmacro()
function(zephyr_library_sources)
  target_sources(${ZEPHYR_CURRENT_LIBRARY} PRIVATE ${ARGN})
endfunction()
function(zephyr_include_directories folder)
  target_include_directories(zephyr_interface INTERFACE ${CMAKE_CURRENT_SOURCE_DIR}/${folder})
endfunction()
function(zephyr_compile_definitions)
  target_compile_definitions(zephyr_interface INTERFACE ${ARGN})
endfunction()
"""


def run(*command: str | Path) -> str:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def configure(source: Path, build: Path, tools: Path, *options: str) -> None:
    compiler = [
        f"-DCMAKE_C_COMPILER={tools / 'cc'}",
        f"-DCMAKE_AR={tools / 'ar'}",
        f"-DCMAKE_RANLIB={tools / 'ranlib'}",
    ]
    run(*CMAKE, "-G", "Unix Makefiles", "-S", source, "-B", build, *compiler, *options)


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
    run(*CMAKE, "--build", folder / "build", "--target", "install")
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
    run(*CMAKE, "--build", tmp_path / "build", "--target", "player")
    plays_slp_alone(tmp_path)


def plays_slp_alone(folder: Path) -> None:
    """Decode by the program that was built in a folder: a stream of slp, and one of mdct, which it lacks."""
    stream = coded("slp", 0.2, channels=1)
    stream.save(folder / "a.vct")
    run(folder / "build" / "player", folder / "a.vct", folder / "a.pcm")
    samples = np.fromfile(folder / "a.pcm", "<i2")
    np.testing.assert_array_equal(samples, stream.decode_integers()[: stream.samples, 0])
    coded("mdct", 0.2, channels=1).save(folder / "b.vct")
    command = [str(folder / name) for name in ("build/player", "b.vct", "b.pcm")]
    assert "this build lacks the codec" in subprocess.run(command, capture_output=True, text=True).stderr


def chosen(menu: Path, **values: str) -> str:
    """Return what a project of ESP-IDF or Zephyr knows of choices in a menu: lines of CMake."""
    settings = kconfiglib.Kconfig(str(menu))
    for name, value in values.items():
        assert settings.syms[name].set_value(value)
    assert not settings.warnings
    lines = [symbol.config_string.strip() for symbol in settings.unique_defined_syms]
    return "".join(f"set({line.replace('=', ' ')})\n" for line in lines if not line.startswith("#"))


CHOICES = {
    "VIBROCAST_CONTROLLER": "y",
    "VIBROCAST_WITH_EVA": "n",
    "VIBROCAST_WITH_MDCT": "n",
    "VIBROCAST_MAX_CHANNELS": "1",
}
SYSTEMS = {
    "CMake": lambda: f"set(VIBROCAST_DEFINITIONS {SWITCHES})\n",
    "ESP-IDF": lambda: ESP_IDF + chosen(FIRMWARE / "Kconfig", **CHOICES),
    "Zephyr": lambda: ZEPHYR + chosen(FIRMWARE / "zephyr" / "Kconfig", VIBROCAST="y", **CHOICES),
}


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_project_links_the_controller(tmp_path: Path, tools: Path, system: str) -> None:
    """The port of this machine, and the example, which needs the same switches."""
    programs = {"device": FIRMWARE / "ports" / "host" / "main.c", "player": FIRMWARE / "examples" / "decode.c"}
    library = "vibrocast::controller" if system == "CMake" else "vibrocast"
    lines = ["cmake_minimum_required(VERSION 3.21)", "project(device C)", SYSTEMS[system](), WAYS["add_subdirectory"]]
    for name, source in programs.items():
        lines += [f"add_executable({name} {source})", f"target_link_libraries({name} PRIVATE {library})"]
    (tmp_path / "CMakeLists.txt").write_text("\n".join(lines))
    configure(tmp_path, tmp_path / "build", tools)
    run(*CMAKE, "--build", tmp_path / "build", "--target", *programs)
    plays_slp_alone(tmp_path)
    with subprocess.Popen([tmp_path / "build" / "device"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        with Controller(SerialTransport(process.stdout.readline().decode().strip())) as host:
            codecs = {codec.name for codec in host.description.codecs}
        process.stdin.close()
    assert codecs == {"dct", "slp", "parametric"}


def test_esp_idf_runs_the_component_as_a_script_first(tmp_path: Path) -> None:
    script = tmp_path / "requirements.cmake"
    script.write_text(
        "macro(idf_component_register)\n  message(STATUS registered)\n  return()\nendmacro()\n"
        f"set(ESP_PLATFORM 1)\nfunction(requirements)\n  include({FIRMWARE}/CMakeLists.txt)\nendfunction()\n"
        "requirements()\n"
    )
    assert "registered" in run(*CMAKE, "-P", script)
