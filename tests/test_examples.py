"""The notebooks and other examples run, in copies of their folders; the notebooks hold no outputs."""

import os
import runpy
import shutil
import sys
from pathlib import Path

import pytest

import vibrocast
from vibrocast import codec, textures

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


@pytest.mark.parametrize("name", ["eva-16-4", "eva-128-2"])
def test_plain_onnx_runtime_has_the_quality_of_the_product(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = textures.load(EXAMPLES / "oak.wav")
    stream = vibrocast.encode(recording, model=name, setting={"level": 1.0}, highpass_hz=None, touch=0)
    product_db = codec.snr_db(recording.samples, stream.decode())
    monkeypatch.setattr(sys, "argv", ["", str(ROOT / "models" / name), str(EXAMPLES / "oak.wav")])
    runpy.run_path(str(EXAMPLES / "onnx_runtime.py"))
    assert float(capsys.readouterr().out.split()[1]) == pytest.approx(product_db, abs=0.3)  # a stream rounds the scale


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


def test_the_picture_of_the_data_path_states_the_rate_of_the_example() -> None:
    stream = vibrocast.encode(vibrocast.load(EXAMPLES / "oak.wav"), random_access=True)
    picture = (ROOT / "docs" / "figures" / "data_path.svg").read_text(encoding="utf-8")
    assert f">{stream.bits_per_second / 1000:.1f} kbit/s<" in picture
