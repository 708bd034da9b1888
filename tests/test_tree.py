"""Files of the checkout that repeat what others state: pins, the reference of TOML files, planted faults, figures."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec import inspect
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.mutants import MUTANTS, Mutant, mutated
from vibrocast import pages
from vibrocast.evaluation import external
from vibrocast.export import configuration
from vibrocast.host import bench_file
from vibrocast.output import actuator_files
from vibrocast.planner import scene
from vibrocast.study import study_file

ROOT = Path(__file__).parents[1]
LOCK = (ROOT / "requirements-dev.txt").read_text(encoding="utf-8")
INSTALLED = (ROOT / "requirements.txt").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
TOML_FILES: dict[str, tuple[type, ...]] = {
    "Scene": (scene._SceneFile,),
    "Bench file": (bench_file._BenchFile, bench_file.ProgramSensor, bench_file.InputSensor),
    "Actuator": (actuator_files.ActuatorTable,),
    "Training": (configuration.Configuration,),
    "Study": (study_file.StudyTables,),
    "Programs": (external.ProgramTable,),
}


def test_every_requirement_but_those_of_train_has_pins_in_its_range_with_hashes() -> None:
    """The file says why `train` is left out. A package may have several versions, each for some Pythons or systems."""
    pin = r"^([\w.-]+)==(\S+)(?: ;[^\\\n]*)?(?: \\\n    --hash=sha256:[0-9a-f]{64})+$"
    pins = [(canonicalize_name(name), version) for name, version in re.findall(pin, LOCK, re.MULTILINE)]
    assert len(re.findall(r"^[\w.-]+==", LOCK, re.MULTILINE)) == len(pins) > 50
    extras = [requirements for extra, requirements in PROJECT["optional-dependencies"].items() if extra != "train"]
    for text in [*PROJECT["dependencies"], *(text for requirements in extras for text in requirements)]:
        requirement = Requirement(text)
        versions = [version for name, version in pins if name == canonicalize_name(requirement.name)]
        assert versions or requirement.name == "vibrocast", f"{text}: run `make lock`"
        assert all(requirement.specifier.contains(version) for version in versions), f"{text}: run `make lock`"


def test_the_pins_of_an_installation_are_a_part_of_those_of_the_development_environment() -> None:
    pin = r"^[\w.-]+==(?:.+\\\n)+.+"
    pinned, all_pins = (set(re.findall(pin, text, re.MULTILINE)) for text in (INSTALLED, LOCK))
    assert pinned < all_pins, "run `make lock`"
    names = {each.partition("==")[0] for each in pinned}
    needed = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["plot"], "hatchling", "ziglang"]
    assert names >= {canonicalize_name(Requirement(text).name) for text in needed}


def test_the_pins_name_no_machine() -> None:
    machine = r"https?:|file:|--(?:extra-)?index|--find-links| @ |^\s*#.*\s/\w"
    assert re.findall(machine, LOCK + INSTALLED, re.MULTILINE) == []


def keys(node: object) -> Iterator[str]:
    """Yield the keys of a struct and of the structs in it, but those of an actuator, which has its own section."""
    for each in node.fields if isinstance(node, inspect.StructType) else ():
        yield each.encode_name
        if each.name != "actuators":
            yield from keys(each.type)
    inner = filter(None, (getattr(node, name, None) for name in ("item_type", "type")))
    for part in (*getattr(node, "types", ()), *inner):
        yield from keys(part)


@pytest.mark.parametrize("section", TOML_FILES)
def test_the_reference_of_toml_files_names_every_key(section: str) -> None:
    page = (ROOT / "docs/reference/toml_files.md").read_text(encoding="utf-8")
    _, text = re.split(rf"^## {section}\n", page, flags=re.MULTILINE)
    words = set(re.findall(r"\w+", " ".join(re.findall(r"`([^`]+)`", text.partition("\n## ")[0]))))
    expected = {key for kind in TOML_FILES[section] for key in keys(inspect.type_info(kind))}
    assert expected <= words, expected - words


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.effect)
def test_each_fault_that_is_planted_finds_its_place_and_has_an_effect_of_its_own(mutant: Mutant) -> None:
    assert mutated(mutant)
    assert mutant.suites()
    assert [each.effect for each in MUTANTS].count(mutant.effect) == 1


@pytest.mark.parametrize("path", sorted((ROOT / "docs" / "benchmarks").glob("*.md")), ids=lambda path: path.stem)
def test_every_page_of_figures_states_their_commit(path: Path) -> None:
    last = path.read_text().splitlines()[-1]
    assert re.fullmatch(rf"{pages.FIGURES}commit [0-9a-f]{{7,}} \(\d{{4}}-\d\d-\d\d\)(, changed since)?\.", last)


@pytest.mark.parametrize(
    "name", ["README.md", "CONTRIBUTING.md", "SECURITY.md", "examples/README.md", "firmware/README.md"]
)
def test_links_of_pages_that_the_site_does_not_check_lead_somewhere(name: str) -> None:
    links = re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]+)", (ROOT / name).read_text(encoding="utf-8"))
    assert [link for link in links if not (ROOT / name).parent.joinpath(link).exists()] == []
