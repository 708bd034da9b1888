"""The packages: which may import which; every file states its purpose."""

import ast
import re
from dataclasses import fields
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tests.lint import tracked
from vibrocast import textures
from vibrocast.codec import Codec
from vibrocast.device_protocol import coded_stream
from vibrocast.textures import recording

ROOT = Path(__file__).parents[1]
CORE = {
    "textures": set[str](),
    "device_protocol": set[str](),
    "firmware": set[str](),
    "models": {"device_protocol"},
    "output": {"device_protocol", "firmware"},
    "codec": {"device_protocol", "firmware", "models", "textures"},
    "simulated_device": {"codec", "device_protocol", "firmware", "output"},
}
"""What each package of the core may import of it; host, and the modules in vibrocast/, may import them all."""
PRODUCTS = {
    "evaluation": set[str](),
    "export": set[str](),
    "harness": {"evaluation"},
    "planner": {"evaluation"},
    "study": {"evaluation", "harness"},
}
"""The products, which may import the core, and of each other these."""
PACKAGES = (*CORE, "host", *PRODUCTS)
SMALL = ("errors", "extras", "files", "memory", "pages", "progress", "toml_tables", "workers")
"""Modules in vibrocast/ for every package; they import none of them."""


def sources() -> dict[str, Path]:
    """Return every source that is installed by its module: "codec.mdct" of codec/mdct.py."""
    paths = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    paths += sorted((ROOT / "vibrocast").glob("*.py"))
    modules = {}
    for path in paths:
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[1:] if parts[0] == "vibrocast" else parts)
        modules[name.removesuffix("__init__").rstrip(".")] = path
    return modules


SOURCES = sources()
STUDIES = {f"studies.{path.stem}": path for path in sorted((ROOT / "studies").glob("*.py"))}


def imports(module: str) -> set[str]:
    """Return the modules of this project that a module imports, wherever in it."""
    names = set()
    for node in ast.walk(ast.parse((SOURCES | STUDIES)[module].read_text())):
        assert not (isinstance(node, ast.ImportFrom) and node.level), f"{module}: import vibrocast.PACKAGE instead"
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name.removeprefix("vibrocast.") in SOURCES else node.module for name in whole}
    assert not {name.split(".")[0] for name in names} & set(PACKAGES), "packages are imported as vibrocast.PACKAGE"
    own = {name.removeprefix("vibrocast.").removeprefix("vibrocast") for name in names if name.startswith("vibrocast")}
    return own & set(SOURCES) - {module}


@pytest.mark.parametrize("module", SOURCES)
def test_arrows_point_one_way(module: str) -> None:
    package, *inner = module.split(".")
    imported = imports(module)
    packages = {name.split(".")[0] for name in imported} & set(PACKAGES)
    if package in CORE:
        assert packages <= CORE[package] | {package}
    elif package in PRODUCTS:
        assert packages & set(PRODUCTS) <= PRODUCTS[package] | {package}
    else:
        assert packages & set(PRODUCTS) == set(), "products join the core through entry points"
    if package in SMALL:
        assert packages == set()
    if inner[:1] != ["cli"]:
        assert not any(name.startswith("host.cli") for name in imported)
        assert package not in ("codec", "host") or "import click" not in SOURCES[module].read_text()


@pytest.mark.parametrize("module", [*SOURCES, *STUDIES])
def test_products_are_used_by_their_public_names(module: str) -> None:
    if not module.startswith("harness"):
        inside = {name for name in imports(module) if name.startswith("harness.conformance.")}
        assert not inside, "import the names that harness.conformance itself exports"


def test_no_module_imports_itself_through_others() -> None:
    TopologicalSorter({module: imports(module) for module in SOURCES}).prepare()  # raises CycleError, which names them


def test_the_codecs_are_described_in_few_words_and_stand_on_few_floors() -> None:
    @cache
    def floor(module: str) -> int:
        below = {name for name in imports(module) if name.startswith("codec")}
        return 1 + max(map(floor, below), default=0)

    assert max(floor(module) for module in SOURCES if module.startswith("codec")) <= 8
    assert len(fields(Codec)) <= 14


def test_no_source_in_c_needs_itself_through_others() -> None:
    """X.c, X.h and X_dsp.c are one: it needs what they include, and the sources that define the functions they use."""
    paths = [path for path in sorted((ROOT / "firmware").rglob("*.[ch]")) if "build" not in path.parts]
    code = {path: re.sub(r"/\*.*?\*/", "", path.read_text(), flags=re.DOTALL) for path in paths}
    definition = re.compile(r"^(?!static)\w[\w *]*?\b(vc_\w+)\([^;{}]*\)\n\{", re.MULTILINE)
    shared = [path for path in paths if path.parent.name in ("core", "controller", "vibrocast")]
    defined = {name: path for path in shared for name in definition.findall(code[path])}
    assert {"vc_controller_receive", "vc_mdct_decode"} <= set(defined)
    whole = {path: path.with_name(path.stem.removesuffix("_dsp")) for path in paths}
    needs: dict[Path, set[Path]] = {name: set() for name in whole.values()}
    for path, text in code.items():
        included = set(re.findall(r'#include "(?:.*/)?(.*)"', text))
        found = [other for other in paths if other.name in included and other.parent in (path.parent, *path.parents)]
        found += [other for other in shared if other.name in included]
        found += [defined[name] for name in set(re.findall(r"\bvc_\w+", text)) & set(defined) if path.suffix == ".c"]
        needs[whole[path]] |= {whole[other] for other in found} - {whole[path]}
    TopologicalSorter(needs).prepare()  # raises CycleError, which names them


def test_textures_agree_with_streams() -> None:
    assert textures.UNITS == coded_stream.UNITS
    assert recording.MAX_CHANNELS == coded_stream.MAX_CHANNELS


def test_the_code_overview_names_what_there_is() -> None:
    page = (ROOT / "docs" / "explanation" / "code_overview.md").read_text()
    files = set(re.findall(r"`([\w/]+\.(?:py|c|h|toml))`", page))
    paths = [f"/{name}" for name in tracked()]
    assert [name for name in files if not any(path.endswith(f"/{name}") for path in paths)] == [
        name for name in files if "NAME" in name or "BOARD" in name
    ]
    sources = "".join((ROOT / name).read_text() for name in tracked("*.py", "*.c", "*.h"))
    functions = set(re.findall(r"`(?:\w+\.)?([a-z_]\w*[a-z])`", page))
    assert [name for name in functions if not re.search(rf"\b{name}\b", sources)] == []


def test_every_file_opens_with_its_purpose() -> None:
    silent = [name for name in tracked("*.py") if ast.get_docstring(ast.parse((ROOT / name).read_text())) is None]
    in_c = tracked("*.c", "*.h")
    silent += [name for name in in_c if not (ROOT / name).read_text().startswith("/* ")]
    assert silent == []


def test_every_dependency_has_its_reason_and_an_upper_bound() -> None:
    lines = (ROOT / "pyproject.toml").read_text().splitlines()
    requirements = [line for line in lines if line.startswith('    "') and any(sign in line for sign in (">=", "=="))]
    assert len(requirements) > 10
    assert [line for line in requirements if "# " not in line] == []
    assert [line for line in requirements if "<" not in line and "==" not in line] == []
