"""The reference page of TOML files names every key that the readers of these files know."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec import inspect

from vibrocast.evaluation import external
from vibrocast.export import configuration
from vibrocast.host import bench_file
from vibrocast.output import actuator_files
from vibrocast.planner import plan_file, scene
from vibrocast.study import study_file

PAGE = Path(__file__).parents[1] / "docs/reference/toml_files.md"
SECTIONS: dict[str, tuple[type, ...]] = {
    "Scene": (scene._SceneFile,),
    "Plan": (plan_file._PlanFile, plan_file._Source, plan_file.PlannedTexture),
    "Bench file": (bench_file._BenchFile,),
    "Actuator": (actuator_files.ActuatorTable,),
    "Training": (configuration.Configuration,),
    "Study": (study_file.StudyTables,),
    "Programs": (external._ProgramTable,),
}


def keys(node: object) -> Iterator[str]:
    """Yield the keys of a struct and of the structs in it, but those of an actuator, which has its own section."""
    for each in node.fields if isinstance(node, inspect.StructType) else ():
        yield each.encode_name
        if each.name != "actuators":
            yield from keys(each.type)
    inner = filter(None, (getattr(node, name, None) for name in ("item_type", "type")))
    for part in (*getattr(node, "types", ()), *inner):
        yield from keys(part)


@pytest.mark.parametrize("section", SECTIONS)
def test_the_page_names_every_key(section: str) -> None:
    _, text = re.split(rf"^## {section}\n", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    words = set(re.findall(r"\w+", " ".join(re.findall(r"`([^`]+)`", text.partition("\n## ")[0]))))
    expected = {key for kind in SECTIONS[section] for key in keys(inspect.type_info(kind))}
    assert expected <= words | {"source"}, expected - words  # of a plan: the keys of _Source
