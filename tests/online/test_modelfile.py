"""The model file: what goes in comes out, equal content is equal bytes, damage is one line."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from gpvo.errors import ModelError
from gpvo.online import modelfile

HEADER = {
    "features": ["velocity.x", "counts.inliers"],
    "score": 0.5,
    "unknown": float("nan"),
    "nested": {"n": 3, "ok": True},
}


def some_arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "b": rng.standard_normal((5, 3)),
        "a": np.arange(4, dtype=np.int64),
        "flag": np.array([True, False]),
        "single": rng.standard_normal(7).astype(np.float32),
        "empty": np.zeros((0, 3)),
    }


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.gpvo"
    modelfile.save(path, some_arrays(), HEADER)
    return path


def test_round_trip(model: Path) -> None:
    arrays, header = modelfile.load(model)
    assert header == {**HEADER, "unknown": None}
    assert arrays.keys() == some_arrays().keys()
    for name, array in some_arrays().items():
        np.testing.assert_array_equal(arrays[name], array)
        assert arrays[name].dtype == array.dtype


def test_equal_content_gives_equal_bytes(model: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.gpvo"
    backwards = dict(reversed(some_arrays().items()))
    modelfile.save(other, backwards, dict(reversed(HEADER.items())))
    assert other.read_bytes() == model.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.gpvo", "other.gpvo"]


def test_a_failed_save_leaves_the_old_file(model: Path) -> None:
    before = model.read_bytes()
    with pytest.raises(ModelError, match="cannot hold"):
        modelfile.save(model, {"text": np.array(["a"])}, {})
    with pytest.raises(ModelError, match="cannot hold"):
        modelfile.save(model, some_arrays(), {"x": object()})
    assert model.read_bytes() == before
    assert list(model.parent.iterdir()) == [model]


def test_every_truncation_is_refused(model: Path) -> None:
    blob = model.read_bytes()
    for n in [0, 7, 8, 20, len(blob) // 3, len(blob) - 1]:
        model.write_bytes(blob[:n])
        with pytest.raises(ModelError) as caught:
            modelfile.load(model)
        assert "\n" not in str(caught.value)
        assert model.name in str(caught.value)


def test_every_flipped_byte_is_refused(model: Path) -> None:
    blob = model.read_bytes()
    for n in range(0, len(blob), 7):
        model.write_bytes(blob[:n] + bytes([blob[n] ^ 0x41]) + blob[n + 1 :])
        with pytest.raises(ModelError):
            modelfile.load(model)


def test_trailing_bytes_other_files_and_no_file_are_refused(model: Path, tmp_path: Path) -> None:
    model.write_bytes(model.read_bytes() + b"x")
    with pytest.raises(ModelError, match="truncated or damaged"):
        modelfile.load(model)
    other = tmp_path / "notes.txt"
    other.write_text("just some text that is long enough")
    with pytest.raises(ModelError, match="not a"):
        modelfile.load(other)
    with pytest.raises(ModelError, match="No such file"):
        modelfile.load(tmp_path / "nowhere")
    with pytest.raises(ModelError, match=r"is a folder, not a model file \(give one of gpvo train, before the run\)"):
        modelfile.load(tmp_path)


def rewrite(model: Path, change: Callable[[dict, dict], None]) -> None:
    """Apply ``change(tensors, document)`` to the file's JSON."""
    blob = model.read_bytes()
    (n,) = struct.unpack("<Q", blob[:8])
    tensors = json.loads(blob[8 : 8 + n])
    document = json.loads(tensors["__metadata__"]["gpvo"])
    change(tensors, document)
    tensors["__metadata__"]["gpvo"] = json.dumps(document)
    raw = json.dumps(tensors).encode()
    model.write_bytes(struct.pack("<Q", len(raw)) + raw + blob[8 + n :])


def test_newer_schema_is_refused_with_a_cure(model: Path) -> None:
    rewrite(model, lambda tensors, document: document.update(schema=99))
    with pytest.raises(ModelError, match=r"newer gpvo \(schema 99.*update gpvo"):
        modelfile.load(model)


def test_a_lying_shape_is_refused_before_it_allocates(model: Path) -> None:
    rewrite(model, lambda tensors, document: tensors["b"].update(shape=[1 << 40, 1 << 10]))
    with pytest.raises(ModelError, match="damaged"):
        modelfile.load(model)


def test_a_changed_header_does_not_match_the_digest(model: Path) -> None:
    rewrite(model, lambda tensors, document: document["header"].update(score=0.1))
    with pytest.raises(ModelError, match="digest"):
        modelfile.load(model)


def test_numbers_that_are_not_json_are_refused(model: Path) -> None:
    blob = model.read_bytes()
    assert b"0.5" in blob
    model.write_bytes(blob.replace(b"0.5", b"NaN", 1))
    with pytest.raises(ModelError, match="damaged"):
        modelfile.load(model)


def test_units_that_are_not_those_of_the_features_are_refused(model: Path) -> None:
    modelfile.save(model, some_arrays(), {**HEADER, "units": ["m/s"]})
    with pytest.raises(ModelError, match=r"model\.gpvo: its header names 1 units for 2 features"):
        modelfile.load(model)


def test_other_metadata_is_refused(model: Path) -> None:
    rewrite(model, lambda tensors, document: document.update(kind="something else"))
    with pytest.raises(ModelError, match="not a gpvo model"):
        modelfile.load(model)


def test_loading_needs_numpy_and_safetensors_alone(model: Path) -> None:
    code = f"""
import importlib, pkgutil, sys
import gpvo.online
for module in pkgutil.iter_modules(gpvo.online.__path__):
    importlib.import_module(f"gpvo.online.{{module.name}}")
gpvo.online.modelfile.load({str(model)!r})
heavy = {{"torch", "gpytorch", "sklearn", "pandas", "scipy", "cv2", "pyarrow", "matplotlib", "joblib", "pydantic"}}
print(sorted(heavy & set(sys.modules)))
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
