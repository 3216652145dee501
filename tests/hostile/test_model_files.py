"""Model files made by somebody else: nothing of them runs, and what contradicts the schema is refused in one line."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gpvo.cli import app
from gpvo.errors import GpvoError, ModelError
from gpvo.geometry.covariance import is_positive_definite
from gpvo.online import modelfile
from gpvo.online.estimate import LEAST_VAR
from gpvo.online.predictor import Predictor
from gpvo.online.stored import spec_of
from gpvo.publish.export import export_model
from small_model import small_model
from typer.testing import CliRunner

MODEL = Path(__file__).parents[2] / "models" / "tunnel.gpvo"
Arrays = dict[str, np.ndarray]


@pytest.fixture
def parts() -> tuple[Arrays, dict[str, Any]]:
    arrays, header = modelfile.load(MODEL)
    return dict(arrays), dict(header)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler 'cc' on this machine")
def test_no_text_of_a_model_becomes_c_code(parts, tmp_path: Path) -> None:
    arrays, header = parts
    attack = "*/ __attribute__((constructor)) static void f(void) { __builtin_trap(); } /*"
    header["units"] = [attack] * len(header["features"])
    header["versions"] = {"gpvo": attack}
    modelfile.save(tmp_path / "evil.gpvo", arrays, header)
    export_model(tmp_path / "evil.gpvo", tmp_path / "evil.h", "c")
    code = (tmp_path / "evil.h").read_text()
    assert "__attribute__" not in code.replace(attack, "") or "*/ __attribute__" not in code
    (tmp_path / "main.c").write_text('#include "evil.h"\nint main(void) { (void)gpvo_predict; return 0; }\n')
    subprocess.run(["cc", "-std=c99", "main.c", "-o", "main", "-lm"], cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "main"]).returncode == 0


def test_no_text_of_a_model_is_obeyed_by_a_terminal(parts, tmp_path: Path) -> None:
    arrays, header = parts
    header["versions"] = {"gpvo\x1b[2J": "1\x1b]0;owned\x07"}
    header["sequences"] = [{"name": "a\x1bb"}]
    modelfile.save(tmp_path / "evil.gpvo", arrays, header)
    loaded = modelfile.load(tmp_path / "evil.gpvo")[1]
    assert "\\x1b" not in repr(loaded)
    assert "gpvo?[2J" in loaded["versions"]


@pytest.mark.parametrize("prefix", ["int", "while", "class", "_x", "9a", "a-b", "a b", "é", "", 'x"', "a\n#define b"])
def test_a_prefix_is_a_c_identifier_and_no_keyword(prefix: str, tmp_path: Path) -> None:
    with pytest.raises(GpvoError, match="not a C identifier"):
        export_model(MODEL, tmp_path / "x.h", "c", prefix=prefix)
    assert not (tmp_path / "x.h").exists()


def _full(value: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda a: np.full_like(a, value)


ARRAYS: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "negative correlation": ("correlation", _full(-5.0)),
    "indefinite correlation": ("correlation", lambda a: np.where(np.eye(6) > 0, 1.0, 0.99 * np.sign(np.sin(7.0 * a)))),
    "skew correlation": ("correlation", lambda a: np.triu(a)),
    "a covariance for a correlation": ("correlation", lambda a: 2.0 * a),
    "weight above one": ("geometry_weight", _full(10.0)),
    "growth not a number": ("growth", _full(np.nan)),
    "huge growth": ("growth", _full(1e4)),
    "negative factor": ("factor", _full(-1.0)),
    "no base variance": ("theta", _full(0.0)),
    "negative base variance": ("theta", _full(-1.0)),
    "infinite usual rate": ("usual_rate_var", _full(np.inf)),
    "no usual rate": ("usual_rate_var", _full(0.0)),
    "too few degrees of freedom": ("nu", _full(2.0)),
    "too few in the base": ("base.nu", _full(1e-300)),
    "no shares in the base": ("base.share", _full(0.0)),
    "no shares": ("share", _full(0.0)),
    "negative shares": ("share", _full(-0.3)),
    "huge log ratio": ("high", _full(1e6)),
    "scale of zero": ("domain.scale", _full(0.0)),
    "domain upside down": ("domain.low", _full(1e6)),
    "domain of another length": ("domain.centre", lambda a: a[:-1]),
    "domain of integers": ("domain.radius", lambda a: a.astype(np.int64)),
    "numbers for truths": ("domain.may_miss", lambda a: a.astype(np.float64)),
    "fractional inputs": ("inputs", lambda a: a + 0.5),
    "inputs beyond the features": ("inputs", lambda a: a + 1000),
    "negative inputs": ("inputs", lambda a: a - 1000),
    "length scale of zero": ("gp.lengthscale", _full(0.0)),
    "points not a number": ("gp.points", _full(np.nan)),
    "negative signal variance": ("gp.signal_var", _full(-1.0)),
    "huge offset of log noise": ("thesis.0.log_noise_offset", _full(1e6)),
    "offset of another length": ("gp.offset", lambda a: a[:-1]),
    "constant not semidefinite": ("method.constant", _full(-1.0)),
    "negative scale": ("method.triangulation.scale", _full(-1.0)),
    "sample at no time": ("sample.dt_s", _full(0.0)),
}


@pytest.mark.parametrize("case", ARRAYS)
def test_arrays_against_the_schema_are_refused(case: str, parts, tmp_path: Path) -> None:
    arrays, header = parts
    name, change = ARRAYS[case]
    arrays[name] = np.ascontiguousarray(change(arrays[name]))
    modelfile.save(tmp_path / "evil.gpvo", arrays, header)
    with pytest.raises(ModelError, match=r"evil\.gpvo: ") as refusal:
        Predictor.load(tmp_path / "evil.gpvo")
    assert "\n" not in str(refusal.value)


EXTREMES: dict[str, dict[str, float]] = {
    "a calibration that explains all": {"calibration_patterns": 1e6},
    "the smallest numbers": {"factor": 1e-12, "theta": 1e-300, "theta_plain": 0.0, "high": -60.0, "gp.offset": -1e12},
}


@pytest.mark.parametrize("case", EXTREMES)
def test_the_schema_leaves_no_room_for_a_covariance_that_is_none(case: str, parts, tmp_path: Path) -> None:
    arrays, header = parts
    arrays |= {name: np.full_like(arrays[name], value) for name, value in EXTREMES[case].items()}
    modelfile.save(tmp_path / "odd.gpvo", arrays, header)
    model = Predictor.load(tmp_path / "odd.gpvo").model
    speeds = np.linspace(0.0, 100.0, 50)[:, None] * np.array([c.startswith("v_") for c in model.columns])
    odd = np.array([np.nan, 1e-9, 10.0, 1e11])[:, None] * np.ones(len(model.columns))
    stated = model.estimate(np.concatenate([model.domain.centre + speeds, odd])).covariance
    assert all(is_positive_definite(C) for C in stated)
    assert np.diagonal(stated, axis1=1, axis2=2).min() > 0.99 * LEAST_VAR


def test_a_file_of_an_older_version_is_refused_with_a_cure(parts, tmp_path: Path) -> None:
    arrays, header = parts
    renamed = {n.replace("gp.", "basis.noise.") if n.startswith("gp.") else n: a for n, a in arrays.items()}
    for older in (renamed, {n: a for n, a in arrays.items() if n != "nu"}):
        modelfile.save(tmp_path / "old.gpvo", older, header)
        with pytest.raises(ModelError, match=r"old\.gpvo: lacks the array.*older gpvo.*train the model again"):
            Predictor.load(tmp_path / "old.gpvo")


HEADERS: dict[str, dict[str, Any]] = {
    "no duration": {"dt_s": 0},
    "negative duration": {"dt_s": -1},
    "duration as text": {"dt_s": "0.1"},
    "features that are numbers": {"features": [1.0]},
    "no features": {"features": []},
    "one feature many times": {"features": ["v_x_mps"] * 21},
    "scores that are a number": {"scores": -1},
    "unknown method": {"base_method": "guess"},
    "method that is a number": {"base_method": 3},
    "camera of one field": {"camera": {"fx_px": 300.0}},
    "camera behind itself": {"camera": dict.fromkeys(("fx_px", "fy_px", "cx_px", "cy_px"), 1.0)
                             | {"baseline_m": -0.1, "width": 640, "height": 480}},
    "camera as a list": {"camera": [1, 2, 3]},
    "intervals without widths": {"calibration": {"interval_levels": [0.9]}},
    "intervals of text": {"calibration": {"interval_levels": "abc", "interval_sigmas": 3}},
    "intervals upside down": {"calibration": {"interval_levels": [0.9], "interval_sigmas": [[-1.0]] * 6}},
    "intervals of five axes": {"calibration": {"interval_levels": [0.9], "interval_sigmas": [[1.0]] * 5}},
    "units of too few": {"units": ["m"]},
    "unknown target": {"target": "window:-3s"},
    "sequences without names": {"sequences": [{}]},
    "twins that are a number": {"simulated_truth": 3},
    "negative factors of the constant": {"constant_best": [-1.0, 1.0]},
    "one factor of the constant": {"constant_best": [1.0]},
}  # fmt: skip


@pytest.mark.parametrize("case", HEADERS)
def test_headers_against_the_schema_are_refused(case: str, parts, tmp_path: Path) -> None:
    arrays, header = parts
    modelfile.save(tmp_path / "evil.gpvo", arrays, {**header, **HEADERS[case]})
    with pytest.raises(GpvoError, match=r"evil\.gpvo: ") as refusal:
        Predictor.load(tmp_path / "evil.gpvo")
    assert "\n" not in str(refusal.value)
    told = CliRunner().invoke(app, ["info", str(tmp_path / "evil.gpvo")])
    assert told.exception is None or isinstance(told.exception, GpvoError)


def test_numbers_beyond_all_floats_are_refused(tmp_path: Path) -> None:
    raw = MODEL.read_bytes()
    (n,) = struct.unpack("<Q", raw[:8])
    tensors = json.loads(raw[8 : 8 + n])
    del tensors["__metadata__"]
    name = min(tensors)
    for old, new in ((f'"shape":{json.dumps(tensors[name]["shape"])}'.replace(" ", ""), '"shape":[1e999]'),
                     ('\\"dt_s\\":0.1', '\\"dt_s\\":1e999')):  # fmt: skip
        head = raw[8 : 8 + n].replace(old.encode(), new.encode(), 1)
        assert head != raw[8 : 8 + n]
        (tmp_path / "evil.gpvo").write_bytes(struct.pack("<Q", len(head)) + head + raw[8 + n :])
        with pytest.raises(ModelError, match=r"evil\.gpvo"):
            Predictor.load(tmp_path / "evil.gpvo")


def test_every_array_of_a_model_has_a_line_in_the_schema() -> None:
    names = {*modelfile.load(MODEL)[0], *small_model().arrays}
    assert not [name for name in names if spec_of(name) is None]
