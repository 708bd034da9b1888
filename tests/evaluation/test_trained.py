"""Tests of the benchmark over trained models: families as curves, what decides their figures, their speed and size."""

from dataclasses import replace

import numpy as np
import pytest

from tests.codec.eva_models import tiny_model
from vibrocast import codec
from vibrocast.codec.eva_image import EvaImage
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.errors import InputError
from vibrocast.evaluation import cells, cost, speed, trained
from vibrocast.evaluation.cells import Cell, Method, RatePoint
from vibrocast.evaluation.points import Failure, Point
from vibrocast.evaluation.speed import Speed
from vibrocast.models import Model
from vibrocast.textures import Recording
from vibrocast.textures.generate import wood

RECORDING = wood(1, 0.5)


def with_image(model: Model, name: str, image: EvaImage) -> Model:
    """Return the model by another name with another payload."""
    packed = replace(ModelImage.unpack(model.image), name=name, payload=image.pack()).pack()
    return replace(model, name=name, image=packed)


def member(number: int) -> Model:
    """Return the tiny model by another name, as a member of a family."""
    tiny = tiny_model()
    return replace(with_image(tiny, f"step-{number}", EvaImage.unpack(tiny.tables)), card={"family": "steps"})


def test_the_model_is_in_the_key() -> None:
    tiny = tiny_model()
    (method,) = cells.families([tiny])
    cell = Cell("wood", RECORDING, method, RatePoint("eva", {"level": 1.0}, tiny), 0)
    models = [
        replace(tiny, name="other"),
        replace(tiny, analysis=tiny.analysis + b"\0"),
        replace(member(0), name="tiny"),
        None,
    ]
    others = [replace(cell, rate_point=replace(cell.rate_point, model=model)) for model in models]
    assert len({each.key for each in (cell, *others)}) == 1 + len(others)
    assert replace(cell, rate_point=replace(cell.rate_point, model=tiny_model())).key == cell.key


def test_names_stand_for_codecs_rate_point_sets_and_families() -> None:
    models = [tiny_model(), member(0)]
    every = cells.methods([], models=models)
    assert [method.name for method in every][-2:] == ["tiny", "steps"]
    assert not {method.name for method in cells.methods([])} & {"eva", "tiny"}
    assert [method.name for method in cells.methods(["eva", "flac"], models=models)] == ["flac", "tiny", "steps"]
    assert [method.name for method in cells.methods(["tiny"], models=models)] == ["tiny"]
    chosen = cells.methods(["g726", "mdct", "slp-shaping-1"])
    assert [method.name for method in chosen] == ["mdct", "mdct-live", "slp-shaping-1", "g726"]
    assert chosen == cells.methods(["slp-shaping-1", "mdct", "g726"])
    with pytest.raises(InputError, match="eva needs a model, and there is none"):
        cells.methods(["eva"])
    with pytest.raises(InputError, match="is called 'mdct'; give the family of models another name"):
        cells.methods([], models=[replace(tiny_model(), name="mdct")])


def test_a_family_costs_its_images_without_their_graphs() -> None:
    tiny = tiny_model()
    image = EvaImage.unpack(tiny.tables)
    without = with_image(tiny, "tiny", replace(image, graph=b"", runtime="core"))
    assert trained.flash_bytes(tiny) == len(without.image) < len(tiny.image)
    assert (trained.runtimes(tiny), trained.runtimes(without)) == (codec.RUNTIMES, ("core",))
    (family,) = cost.measure_costs(cells.coders(cells.families([member(0), member(1)])))
    assert (family.codec, family.coder, family.width) == ("steps", "eva", 16)
    assert family.model_bytes == 2 * trained.flash_bytes(member(0))
    assert family.decoder_bytes == cost.decoder_size("eva").bytes
    assert family.flash_bytes == (family.decoder_bytes or 0) + family.model_bytes
    assert "2 images" in family.note


def test_speed_is_timed_at_the_setting_nearest_to_the_ratio_by_every_runtime(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "SAMPLES", 3000)
    (method,) = cells.families(list(map(member, range(3))))
    points = [
        Point("a", method.name, f"level=1 model=step-{number}", 8000, round(1000 * bits), 10.0)
        for number, bits in enumerate((0.5, 1.5, 2.9))
    ]
    told: list[tuple[float, str]] = []
    speeds = speed.measure([method], points, [RECORDING], 1, lambda *done: told.append(done))
    found = [each for each in speeds if isinstance(each, Speed)]
    assert [(each.rate, each.runtime, each.setting) for each in found] == [
        (1.6, "core", "level=1 model=step-1"),
        (1.6, "onnx", "level=1 model=step-1"),
        (3.0, "core", "level=1 model=step-2"),
        (3.0, "onnx", "level=1 model=step-2"),
    ]
    assert all(
        each.samples == 3000 and each.encode_s_per_megasample > 0 < each.decode_s_per_megasample for each in found
    )
    assert found[0].snr_db == pytest.approx(found[1].snr_db, abs=1)
    assert told == [(1.0, "steps")]
    broken = Method("broken", (RatePoint("no such codec", {"step": 1.0}),))
    failed, *others = speed.measure(
        [broken, method], [Point("a", "broken", "step=1", 1, 1, 1.0), *points], [RECORDING], 1
    )
    assert isinstance(failed, Failure) and failed.codec == "broken" and "no such codec" in failed.reason
    assert {each.codec for each in others} == {"broken", "steps"}
    silent = Recording(np.zeros((600, 1)), 2800.0, "um", "silent")
    assert speed.measure([method], points, [silent], 1) == []
