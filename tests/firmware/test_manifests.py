"""The C library for PlatformIO, and the versions that all its manifests state."""

import json
import re
from pathlib import Path

from vibrocast.firmware.build import ROOT, SHARED, Target

PROJECT = (ROOT.resolve().parent / "pyproject.toml").read_text(encoding="utf-8")
SOURCES = set(Target("", "", (), ("ports",)).sources())
"""Those of a controller for any board."""


def found(*patterns: str) -> set[Path]:
    return {path.relative_to(ROOT) for pattern in patterns for path in ROOT.glob(pattern)}


def test_platformio_compiles_the_sources_and_packs_what_they_need() -> None:
    manifest = json.loads((ROOT / "library.json").read_text(encoding="utf-8"))
    build, export = manifest["build"], manifest["export"]
    selected: set[Path] = set()
    for rule in build["srcFilter"]:
        sign, pattern = re.fullmatch(r"([+-])<(.+)>", rule).groups()  # type: ignore[union-attr]
        selected = selected | found(pattern) if sign == "+" else selected - found(pattern)
    assert (build["srcDir"], selected) == (".", SOURCES)
    assert (ROOT / build["includeDir"] / "vibrocast" / "decoder.h").is_file()
    headers = found(*(f"{folder}/*.h" for folder in SHARED))
    packed = found(*export["include"]) - found(*export["exclude"])
    assert packed == SOURCES | headers | found("examples/*.c")


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
