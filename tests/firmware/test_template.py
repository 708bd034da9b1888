"""The template of a port: the build names the functions that are missing, and links when none is."""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from vibrocast.firmware import build as building
from vibrocast.firmware.build import build
from vibrocast.firmware.elf import Elf
from vibrocast.firmware.native_core import BuildError

FUNCTIONS = {
    *("board_start", "watchdog_feed", "on_fault", "vc_port_read", "vc_port_write", "vc_port_now_us"),
    *("flash_erase", "flash_program", "dac_play"),
}
PAGE = "docs/how-to/port_the_firmware.md"
REPOSITORY = building.ROOT.resolve().parent
Rebuilt = Callable[[Callable[[str], str]], Path]


@pytest.fixture
def rebuilt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rebuilt:
    """Return a function that builds the template after a change of its main.c."""
    root = tmp_path / "firmware"
    shutil.copytree(building.ROOT, root, ignore=shutil.ignore_patterns("build", "__pycache__", "fuzz"))
    monkeypatch.setattr(building, "ROOT", root)

    def changed(change: Callable[[str], str]) -> Path:
        source = root / "ports" / "template" / "main.c"
        source.write_text(change(source.read_text()))
        return build("template")

    return changed


def without_marks(source: str) -> str:
    return re.sub(r"\n    VC_MISSING\(\w+\);", "", source)


def test_the_command_names_every_function_that_is_missing() -> None:
    done = CliRunner().invoke(building.main, ["template"])
    assert done.exit_code == 1
    assert set(re.findall(r"\w+", done.output.split("lacks")[1].split(";")[0])) == FUNCTIONS
    assert PAGE in done.output
    assert (REPOSITORY / PAGE).exists()


def test_a_port_without_a_function_of_the_loop_is_told_which(rebuilt: Rebuilt) -> None:
    def without_write(source: str) -> str:
        return re.sub(r"size_t vc_port_write\(.*?\n}\n", "", without_marks(source), flags=re.DOTALL)

    with pytest.raises(BuildError, match=rf"the port lacks vc_port_write; write what is missing as {PAGE} says"):
        rebuilt(without_write)


@pytest.fixture
def small_board(rebuilt: Rebuilt, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Return a function that builds a target of the page for a board with 128 KiB of flash and 64 KiB of RAM."""
    snippets = re.findall(r'```text\n("my-board": .*?),\n```', (REPOSITORY / PAGE).read_text("utf-8"), re.DOTALL)

    def built(sizes: str) -> Path:
        (snippet,) = (snippet for snippet in snippets if sizes in snippet)
        ports = building.ROOT / "ports"
        source = ports / "template" / "main.c"
        source.write_text(without_marks(source.read_text()))
        shutil.copytree(ports / "template", ports / "my_board")
        script = ports / "my_board" / "board.ld"
        script.write_text(re.sub(r"(CODE.*)256K(\n.*)256K", r"\g<1>128K\g<2>64K", script.read_text()))
        monkeypatch.setitem(building.TARGETS, "my-board", eval(f"{{{snippet}}}", vars(building))["my-board"])
        return build("my-board")

    return built


def test_a_small_board_takes_the_pages_target_for_one(small_board: Callable[[str], Path]) -> None:
    assert "vc_mdct_decoder" in " ".join(Elf(small_board("SMALL_BOARD")).symbols)


def test_an_image_that_is_too_large_says_what_to_make_smaller(small_board: Callable[[str], Path]) -> None:
    with pytest.raises(
        BuildError, match=rf"memory (CODE lacks \d+ bytes and )?DATA lacks \d+.*VC_WITH_.*-Os, as {PAGE}"
    ):
        small_board("LARGE_BOARD")


def test_no_reader_of_programs_is_needed_for_the_browsers_module() -> None:
    """The extra [docs] has none."""
    code = (
        "import sys; sys.modules['elftools'] = None; from vibrocast.firmware import build; "
        "build.build('wasm'); build.main(['rp2040', '--sizes'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (1, "")
    assert re.match(r"error: .*needs elftools; install the extra \[firmware\]", done.stderr), done.stderr
