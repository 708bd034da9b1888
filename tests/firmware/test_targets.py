"""Every image of the firmware: builds, starts as it should, fits its board, calls nothing foreign and not itself."""

import json
import re
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner

from firmware import build as building
from firmware.build import TARGETS, BuildError, build, size
from firmware.elf import Elf

IMAGES = [name for name, target in TARGETS.items() if target.suffix == ".elf"]
# What compilers call where the processor has no instruction: Run-time ABI for the Arm Architecture.
COMPILERS_OWN = re.compile(r"__aeabi_(u?ldivmod|mem(cpy|clr|set|move)[48]?)|__u?divmoddi4|compiler_rt.*")
SOURCES = [path for path in building.ROOT.rglob("*.[ch]") if "build" not in path.parts]


@pytest.mark.parametrize("name", IMAGES)
def test_image_starts_at_reset_with_its_stack_below_what_else_is_in_that_memory(name: str) -> None:
    image = Elf(build(name))
    stack_top, reset = struct.unpack_from("<II", image.segments[0].data)
    stack = image.sections[".stack"]
    assert stack_top == stack.address + stack.size_bytes
    assert reset == image.symbols["Reset_Handler"] and reset & 1
    assert stack.address == min(s.address for s in image.segments if s.address >> 16 == stack.address >> 16)


@pytest.mark.parametrize("name", IMAGES)
def test_image_needs_nothing_but_its_sources_and_division(name: str) -> None:
    words = set(re.findall(r"\w+", "".join(path.read_text() for path in SOURCES)))
    foreign = {name for name in Elf(build(name)).functions.values() if name.split(".")[0] not in words}
    # The linker's way from flash to RAM.
    foreign = {name for name in foreign if not name.startswith("__Thumbv7ABSLongThunk_")}
    assert {name for name in foreign if not COMPILERS_OWN.fullmatch(name)} == set()


def branches(image: Elf) -> Iterator[tuple[int, int]]:
    """Yield from where to where functions branch: BL and B.W, encodings T1 and T4 (DDI 0403, A7.7.18 and A7.7.12)."""
    starts = sorted(image.functions)
    for segment in image.segments:
        offset = 0
        while offset + 4 <= len(segment.data):
            first, second = struct.unpack_from("<HH", segment.data, offset)
            if first >> 11 == 0b11110 and second >> 14 in (0b10, 0b11) and second & 0x1000:
                sign = first >> 10 & 1
                i1, i2 = (1 - (second >> bit & 1 ^ sign) for bit in (13, 11))
                high = -sign << 24 | i1 << 23 | i2 << 22 | (first & 0x3FF) << 12
                here = segment.address + offset
                caller = max((start for start in starts if start <= here), default=0)
                yield caller, here + 4 + (high | (second & 0x7FF) << 1)
            offset += 4 if first >> 11 in (0b11101, 0b11110, 0b11111) else 2


def test_no_function_comes_back_to_itself() -> None:
    """Calls by pointer aside: those are the port's functions, the check of tables and the sink, which call nothing."""
    image = Elf(build("cortex-m4"))
    calls: dict[int, set[int]] = {start: set() for start in image.functions}
    for caller, callee in branches(image):
        if callee in calls and callee != caller:
            calls[caller].add(callee)
    names = {image.functions[callee] for callees in calls.values() for callee in callees}
    assert {"vc_controller_receive", "vc_mdct_decode", "vc_eva_decode", "vc_dac_play"} <= names
    while leaves := {function for function, callees in calls.items() if not callees}:
        calls = {function: callees - leaves for function, callees in calls.items() if function not in leaves}
    assert {image.functions[function] for function in calls} == set()


def test_what_runs_while_flash_is_erased_calls_nothing_in_flash() -> None:
    image = Elf(build("stm32f405"))
    in_ram = {start for start in image.functions if start >> 28 == 2}
    names = {image.functions[start] for start in in_ram}
    assert {"TIM6_DAC_IRQHandler", "USART3_IRQHandler", "SysTick_Handler", "erase_sector", "program_all"} <= names
    assert {callee for caller, callee in branches(image) if caller in in_ram} <= in_ram


def test_sizes_are_those_of_the_page() -> None:
    """To a fiftieth, as compilers differ."""
    page = (building.ROOT / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w-]+)` \| ([\d ]+) \| ([\d ]+) \| ([\d ]+) \(", page, re.MULTILINE)
    assert len(rows) == 4
    for name, *numbers in rows:
        of = size(name)
        assert [int(number.replace(" ", "")) for number in numbers] == pytest.approx([of.flash, of.ram, of.stack], 0.02)


def test_sizes_are_written_as_json(tmp_path: Path) -> None:
    done = CliRunner().invoke(building.main, ["cortex-m4", "--sizes", "--json", str(tmp_path / "sizes.json")])
    assert done.exit_code == 0, done.output
    written = json.loads((tmp_path / "sizes.json").read_text())
    assert written["cortex-m4"]["flash"] == size("cortex-m4").flash
    assert str(written["cortex-m4"]["flash"]) in done.output


def test_what_is_built_is_kept_until_a_source_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = building.Target("nothing", ".elf", ("-shared",), ("port",))
    monkeypatch.setattr(building, "ROOT", tmp_path)
    monkeypatch.setattr(building, "SHARED", ())
    monkeypatch.setitem(building.TARGETS, "nothing", target)
    (tmp_path / "port").mkdir()
    source = tmp_path / "port" / "nothing.c"
    source.write_text("int nothing(void);\nint nothing(void) { return 0; }\n")
    first = build("nothing")
    assert first.is_file() and build("nothing") == first
    source.write_text("int nothing(void);\nint nothing(void) { return 1; }\n")
    assert build("nothing") != first
    source.write_text("int nothing(void) { return 1 }\n")
    with pytest.raises(BuildError, match=r"cannot be compiled(.|\n)*nothing\.c"):
        build("nothing")


def test_without_a_compiler_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(building, "find_spec", lambda name: None)
    with pytest.raises(BuildError, match=r"pip install"):
        build("cortex-m4")
