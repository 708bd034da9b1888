"""Breaks the firmware in ways that a user would feel, and says which tests notice: `python -m tests.mutants`."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import click

from vibrocast.errors import HOST_BUSY

ROOT = Path(__file__).parents[1]
SUITES = ("conformance", "unit tests")
UNIT_TESTS = ("tests/simulated_device", "tests/firmware")
_COPIED = ("firmware", "vibrocast", "tests")
_LIMIT_S = 900


@dataclass(frozen=True)
class Mutant:
    """A fault to plant, as tests/mutants.toml has it."""

    effect: str
    source: str
    old: str
    new: str
    unfelt: str = ""
    of_port: bool = False

    def suites(self) -> list[str]:
        """Return the suites that could find it."""
        return [name for name, apart in zip(SUITES, (self.unfelt, self.of_port), strict=True) if not apart]


MUTANTS = tuple(Mutant(**fault) for fault in tomllib.loads((ROOT / "tests/mutants.toml").read_text("utf-8"))["mutant"])


def mutated(mutant: Mutant) -> str:
    """Return a mutant's source with its fault. Raises ValueError where the text does not stand there once."""
    text = (ROOT / mutant.source).read_text(encoding="utf-8")
    if text.count(mutant.old) != 1:
        raise ValueError(f"{mutant.effect}: its text stands {text.count(mutant.old)} times in {mutant.source}")
    return text.replace(mutant.old, mutant.new)


@dataclass(frozen=True)
class Verdict:
    """The verdict of a suite on a mutant: `found`, and by which test, or why it could not run."""

    found: bool
    by: str


def judge(mutant: Mutant | None, suite: str) -> Verdict:
    """Plant a fault in a copy of the project, and run a suite there; with no mutant, on the project as it is."""
    with tempfile.TemporaryDirectory(prefix="mutant.") as temporary:
        folder = Path(temporary)
        for entry in ROOT.iterdir():
            if entry.name in _COPIED:
                shutil.copytree(entry, folder / entry.name, symlinks=True)
            elif not entry.name.startswith("."):
                (folder / entry.name).symlink_to(entry)
        if mutant is not None:
            (folder / mutant.source).write_text(mutated(mutant), encoding="utf-8")
        try:
            return _conformance(folder) if suite == SUITES[0] else _unit_tests(folder)
        except subprocess.TimeoutExpired:
            return Verdict(True, "it hangs")


def _conformance(folder: Path) -> Verdict:
    """Run the conformance suite on a controller as a process. It compares decoders with those without the fault."""
    report = folder / "report" / "conformance.json"
    start = "from vibrocast.host.cli.entry import main; main()"
    ended = _run(folder, "-c", start, "conformance", "--device", "host", "--out", str(report.parent))
    if ended.returncode == 0:
        return Verdict(False, "")
    if not report.exists():
        return Verdict(ended.returncode == 2, ended.stderr.strip().splitlines()[-1])
    requirements = json.loads(report.read_text(encoding="utf-8"))["requirements"]
    if ended.returncode == HOST_BUSY:
        return Verdict(False, "this machine was busy")
    return Verdict(True, next((each["test"] for each in requirements if each["outcome"] == "fail"), "it was lost"))


def _unit_tests(folder: Path) -> Verdict:
    """Compile core and controller, and run the tests of the firmware."""
    _run(folder, "hatch_build.py")
    ended = _run(folder, "-m", "pytest", "-q", "-x", "-n0", "-m", "not slow", "-p", "no:cacheprovider", *UNIT_TESTS)
    failed = [line.split(" ")[1] for line in ended.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return Verdict(ended.returncode != 0, failed[0].rpartition("::")[2] if failed else ended.stderr[-200:])


def _run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=_LIMIT_S
    )


def judged(mutants: list[Mutant], suites: list[str], jobs: int) -> Iterator[tuple[Mutant, str, Verdict]]:
    """Yield the verdict on each mutant by each suite that could find it."""
    pairs = [(mutant, suite) for mutant, suite in product(mutants, suites) if suite in mutant.suites()]
    with ThreadPoolExecutor(jobs) as pool:
        for (mutant, suite), verdict in zip(pairs, pool.map(lambda pair: judge(*pair), pairs), strict=True):
            yield mutant, suite, verdict


@click.command()
@click.argument("effects", metavar="[TEXT]...", nargs=-1)
@click.option("--suite", type=click.Choice(SUITES), multiple=True, default=SUITES, help="Run this suite only.")
@click.option("--jobs", type=click.IntRange(1), default=2, show_default=True, help="How many mutants to judge at once.")
def main(effects: tuple[str, ...], suite: tuple[str, ...], jobs: int) -> None:
    """Plant each fault, run the conformance suite and the firmware's unit tests, and print which found it.

    TEXT: only the faults whose effect has one of these texts.
    """
    mutants = [each for each in MUTANTS if not effects or any(text in each.effect for text in effects)]
    for name in suite:
        healthy = judge(None, name)
        if healthy.found:
            raise click.ClickException(f"{name}: fails without a fault already ({healthy.by})")
    found: dict[str, list[bool]] = {name: [] for name in suite}
    for mutant, name, verdict in judged(mutants, list(suite), jobs):
        found[name].append(verdict.found)
        click.echo(f"{name:<12} {'found' if verdict.found else 'MISSED':<7} {mutant.effect:<48} {verdict.by}")
    for name, verdicts in found.items():
        click.echo(f"{name}: {sum(verdicts)} of {len(verdicts)} found")


if __name__ == "__main__":
    main()
