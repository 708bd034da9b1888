"""The build: which processors the core is compiled for, what the archives hold, and that an installed wheel plays."""

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import hatch_build
from tests.lint import tracked

ROOT = Path(__file__).parents[1]
HATCH = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
PACKAGES = [name for name in HATCH["only-include"] if name != "vibrocast"]
COMPILED = ("vibrocast_core.cdef", *(f"vibrocast_core.{name}{hatch_build.SUFFIX}" for name in hatch_build.PROCESSORS))


def test_an_editable_install_of_a_checkout_without_links_says_how_to_clone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hatch_build.check_links()
    assert {path.name for path in (ROOT / "vibrocast").iterdir() if path.is_symlink()} == set(PACKAGES)
    (tmp_path / "vibrocast").mkdir()
    (tmp_path / "vibrocast" / "codec").write_text("../codec")  # as git writes a link where it makes none
    monkeypatch.setattr(hatch_build, "ROOT", tmp_path)
    with pytest.raises(RuntimeError, match=r"git clone -c core\.symlinks=true"):
        hatch_build.check_links()


def sources() -> set[str]:
    """Return the files of the checkout that a wheel holds, from the checkout's folder on."""
    return {name for name in tracked("vibrocast", *PACKAGES) if not name.startswith("firmware/fuzz/")}


def build(folder: Path, kind: str, output: Path) -> Path:
    """Build an archive, "sdist" or "wheel", from the sources in a folder."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(output)]
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    (archive,) = output.iterdir()
    return archive


def plays_when_installed(wheel: Path, folder: Path) -> None:
    """Install a wheel into a fresh environment, and play where folders and modules have the names of packages."""
    environment = folder / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(environment)], check=True)
    python = environment / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    install = ["-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index", str(wheel)]
    subprocess.run([sys.executable, *install], check=True)
    (packages,) = environment.glob("[lL]ib/**/site-packages")
    installed = {path.name for path in packages.iterdir()}
    assert {name.split("-")[0] for name in installed} == {"vibrocast"}
    assert len(installed) == 2
    # The dependencies are those of this environment.
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    for name in PACKAGES:
        (folder / f"{name}.py").write_text("raise ImportError('a module of the user')")
    (folder / "ziglang.py").write_text("raise ImportError('the wheel needs no compiler')")
    (folder / "host").mkdir()
    (folder / "host" / "__init__.py").touch()
    without_path = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(python), "-c", "from vibrocast.host.cli.entry import main; main()"]
    for arguments in (("generate", "taps", "taps.wav", "--seconds", "0.5"), ("play", "taps.wav")):
        done = subprocess.run([*command, *arguments], cwd=folder, env=without_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    assert "DAC as computed  yes" in done.stdout


@pytest.mark.slow
@pytest.mark.long
def test_wheel_and_sdist_hold_every_source_once_and_nothing_else(tmp_path: Path) -> None:
    expected = sources()
    sdist = build(ROOT, "sdist", tmp_path / "sdist")
    with tarfile.open(sdist) as archive:
        names = [name.partition("/")[2] for name in archive.getnames()]
        archive.extractall(tmp_path, filter="data")
    assert len(names) == len(set(names))
    assert {name for name in names if name.split("/")[0] in (*PACKAGES, "vibrocast")} == expected
    assert {"pyproject.toml", "hatch_build.py", "README.md"} <= set(names)

    wheel = build(ROOT, "wheel", tmp_path / "wheel")
    with zipfile.ZipFile(wheel) as archive_of_wheel:
        names = archive_of_wheel.namelist()
        records = {name: archive_of_wheel.read(name) for name in names if name.split("/")[0].endswith(".dist-info")}
    held = [name for name in names if name not in records]
    assert len(names) == len(set(names))
    moved = {name if name.startswith("vibrocast/") else f"vibrocast/{name}" for name in expected}
    assert set(held) == moved | {f"vibrocast/firmware/{name}" for name in COMPILED}
    kinds = {Path(name).suffix for name in held}
    assert {".py", ".typed", ".csv", ".jinja", ".json", ".vcmi", ".onnx", ".c", ".h", ".ld"} <= kinds
    assert wheel.name.split("-")[2:4] == ["py3", "none"]

    of_sdist = build(tmp_path / sdist.name.removesuffix(".tar.gz"), "wheel", tmp_path / "wheel of sdist")
    assert of_sdist.name == wheel.name
    with zipfile.ZipFile(of_sdist) as archive_of_sdist:
        # The record has the digest of every file.
        assert {name: archive_of_sdist.read(name) for name in records} == records

    (tmp_path / "user").mkdir()
    plays_when_installed(wheel, tmp_path / "user")


@pytest.mark.skipif(not hatch_build.LINKS_GLIBC, reason="the core is not linked with glibc here")
def test_the_core_asks_for_no_newer_glibc_than_its_tag() -> None:
    for processor in hatch_build.PROCESSORS:
        library = (ROOT / "firmware" / f"vibrocast_core.{processor}.so").read_bytes()
        versions = {tuple(map(int, found)) for found in re.findall(rb"GLIBC_(\d+)\.(\d+)", library)}
        assert versions
        assert max(versions) <= hatch_build.GLIBC
