"""Every command block of every page runs and prints what the page shows; how is in `documented_commands.py`."""

from pathlib import Path

import pytest

from tests import documented_commands
from tests.documented_commands import ROOT, PageError

PAGES = sorted(
    str(path.relative_to(ROOT))
    for pattern in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "docs/**/*.md", "*/README.md")
    for path in ROOT.glob(pattern)
    if path.parent != ROOT / "docs/benchmarks/results"  # parts of generated pages
)
SLOW = {
    "docs/how-to/benchmark.md",
    "docs/how-to/choose_a_codec.md",
    "docs/how-to/hold_a_rate.md",
    "docs/how-to/load_recordings.md",
    "docs/how-to/measure_a_bench.md",
    "docs/how-to/plan.md",
    "docs/tutorials/first_texture.md",
    "docs/tutorials/train_a_codec.md",
    "docs/tutorials/upload_a_model.md",
}
"""Pages that take more than ten seconds, most of them because they play in real time."""


def marked(page: str) -> object:
    """Return a page with the marks of its test."""
    marks = [pytest.mark.slow] if page in SLOW else []
    return pytest.param(page, marks=marks)


@pytest.mark.parametrize("page", [marked(page) for page in PAGES])
def test_the_blocks_of_the_page_run(page: str, tmp_path: Path) -> None:
    documented_commands.run(ROOT / page, tmp_path)


def test_the_list_of_slow_pages_names_pages() -> None:
    assert set(PAGES) >= SLOW


def test_the_python_example_of_the_readme_is_short() -> None:
    readme = documented_commands.blocks((ROOT / "README.md").read_text(encoding="utf-8"))
    (example,) = (block for block in readme if block.language == "python")
    assert len(example.lines) <= 15


def run(text: str, folder: Path) -> None:
    (folder / "page.md").write_text(text)
    (folder / "run").mkdir()
    documented_commands.run(folder / "page.md", folder / "run")


GOOD = [
    "```console\n$ echo two \\\n    words\ntwo words\n```",
    "```console\n$ echo 17 bytes\n18 bytes\n```",
    "```console\n$ printf '1\\n2\\n3 x\\n'\n1\n...\n3 ...\n```",
    "```console\n$ vibrocast decode no.vct a.wav\n"
    "error: no.vct: No such file or directory; check the name and your permissions\n```",
    "```console\n$ make test\n$ cd elsewhere\n$ pip install '.[bench,plot]'\n```",
    "```console\n$ sh -c 'echo serial:abc; sleep 60' &\nserial:xyz\n$ echo serial:xyz\nserial:xyz\n$ kill %1\n```",
    "```python\nn = 3\n```\nThen:\n```python\nprint(n)\n```\n```text\n3\n```",
    '```console title="needs hardware"\n$ arecord -t raw | vibrocast live - --device serial:/dev/ttyACM0 # as is\n```',
    "1. A step:\n\n    ```console\n    $ true\n    ```",
]
BAD = [
    ("    $ vibrocast codecs\n", "indented"),
    ("```\n$ vibrocast codecs\n```", "another language"),
    ("```console\n$ false\n```", "exit code 1"),
    ("```console\n$ echo renamed 1\nname 1\n```", "shown:"),
    ("```console\n$ echo 1\n$ echo 2; echo 3\n2\n```", "shown:"),
    ("```console\n$ vibrocast generate wood a.wav\na.wav: 4.8 s at 2800 Hz, 1.0 is ... m/s^2\n```", "shown 4.8"),
    ("```console\n$ vibrocast decode nothing.vct a.wav\nerror: another\n```", "shown 'error: another'"),
    ("```console\n$ true\nerror: another\n```", "exit code 0"),
    ("```console\n$ make nothing\n```", "no target"),
    ("```console\n$ pip install '.[nothing]'\n```", "no extra"),
    ("```console\n$ pip install 'vibrocast[bench]'\n```", "index"),
    ("```python\n1 / 0\n```", "ZeroDivisionError"),
    ("```python\nprint(1)\n```\n```text\none\n```", "shown:"),
    ('```console title="needs time"\n$ true\n```', "title"),
    ('```console title="needs data"\n$ vibrocast encode a.wav b.vct --speed 3\n```', "--speed"),
    ('```console title="needs data"\n$ vibrocast sing\n```', "sing"),
    ('```console title="needs data"\n$ vibrocast generate steel a.wav\n```', "steel"),
    ('```console title="needs data"\n$ vibrocast encode a.wav\n```', "OUT"),
    ("```console\n$ true", "without an end"),
]


@pytest.mark.parametrize("text", GOOD)
def test_accepts(text: str, tmp_path: Path) -> None:
    run(text, tmp_path)


@pytest.mark.parametrize(("text", "message"), BAD)
def test_rejects(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(PageError, match=message):
        run(text, tmp_path)


def test_a_command_has_limited_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(documented_commands, "TIMEOUT_S", 0.2)
    with pytest.raises(PageError, match="took more"):
        run("```console\n$ sleep 60\n```", tmp_path)
