"""The notebooks and the example for PsychoPy run, in copies of their folders; the notebooks hold no outputs."""

import os
import runpy
import shutil
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
PRINTED = {"first_texture": "DAC as computed: True", "your_own_codec": "% bits against mdct"}
"""A part of what each notebook prints."""
TIMEOUT_S = 240
"""Of one cell."""


@pytest.mark.slow
@pytest.mark.parametrize("name", PRINTED)
def test_the_notebook_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import nbformat
    from ipykernel.kernelspec import write_kernel_spec
    from nbclient import NotebookClient

    shutil.copytree(EXAMPLES, tmp_path / "examples")
    # The package of the example is installed for this test alone, without the network.
    packages = str(tmp_path / "packages")
    for variable, value in {"TARGET": packages, "NO_BUILD_ISOLATION": "0", "NO_DEPS": "1", "NO_INDEX": "1"}.items():
        monkeypatch.setenv(f"PIP_{variable}", value)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), packages]))
    monkeypatch.setenv("PATH", os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    # A kernel of this interpreter, whatever kernels the user has.
    write_kernel_spec(tmp_path / "jupyter" / "kernels" / "python3")
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path / "jupyter"))
    notebook = nbformat.read(EXAMPLES / "notebooks" / f"{name}.ipynb", as_version=4)
    resources = {"metadata": {"path": str(tmp_path / "examples" / "notebooks")}}
    NotebookClient(notebook, timeout=TIMEOUT_S, kernel_name="python3", resources=resources).execute()
    streams = [out for cell in notebook.cells for out in cell.get("outputs", []) if out["output_type"] == "stream"]
    assert PRINTED[name] in "".join(out["text"] for out in streams)


def test_the_notebooks_hold_no_outputs() -> None:
    import nbformat

    notebooks = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))
    assert [path.stem for path in notebooks] == list(PRINTED)
    for path in notebooks:
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        for cell in notebook.cells:
            assert not cell.get("outputs") and cell.get("execution_count") is None, f"clear the outputs of {path.name}"


@pytest.mark.slow
@pytest.mark.usefixtures("simulated_time")
def test_the_example_for_psychopy_plays_its_stimuli_without_psychopy(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    example = str(EXAMPLES / "psychopy_stimulus.py")
    monkeypatch.setattr(sys, "argv", [example])
    runpy.run_path(example)
    assert capsys.readouterr().out.splitlines() == ["20 dB: 4.0 s, 0 underruns", "5 dB: 4.0 s, 0 underruns"]
    assert "psychopy" not in sys.modules
