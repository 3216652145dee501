"""Exports give the predictor's numbers: ONNX through onnxruntime, C through a compiler."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gpvo.cli import app
from gpvo.errors import GpvoError
from gpvo.learning.basefit import learn_domain
from gpvo.online import modelfile
from gpvo.online.base import COASTED, BaseVariance, Velocities, base_columns
from gpvo.online.division import PARTS, Division
from gpvo.online.estimate import ErrorModel
from gpvo.online.features import known_columns
from gpvo.online.projected import ProjectedGP
from gpvo.publish.export import export_model, to_c
from gpvo.publish.onnx import to_onnx
from gpvo.types import Prediction
from small_model import small_model
from typer.testing import CliRunner

MATRICES = ("covariance", *PARTS, "calibration_root")
FIELDS = ("mean", *MATRICES, "epistemic", "in_domain", "confidence", "distance")


def random_gp(rng: np.random.Generator, d: int, m: int, scale: float) -> ProjectedGP:
    points = rng.standard_normal((m, d))
    K = np.exp(-0.5 * ((points[:, None] - points[None]) ** 2).sum(2))
    eigenvalues, V = np.linalg.eigh(K)
    gain = 1.0 / (eigenvalues + rng.uniform(0.1, 1.0, (6, 1)))
    signal = scale**2 * rng.uniform(0.5, 2.0, 6)
    return ProjectedGP(
        0.1 * rng.standard_normal(d),
        rng.uniform(0.8, 3.0, d),
        points,
        V.T,
        scale * gain * (V.T @ rng.standard_normal((m, 6))).T,
        gain * signal[:, None],
        signal,
        scale * rng.standard_normal(6),
    )


def some_model(
    *,
    method: str | None = "triangulation",
    ratio: str = "of conditions",
    residual: bool = False,
    calibration: dict[str, np.ndarray] | None = None,
) -> ErrorModel:
    """A model of random but sensible numbers."""
    rng = np.random.default_rng(0)
    columns = (*base_columns(method, residual), "acceleration_mps2", "inliers", "sharpness")
    X = rng.standard_normal((400, len(columns)))
    X[:, 6 : len(columns) - 3] -= 9.0
    X[::7, -1] = np.nan
    inputs = np.array([0, 2, 5, len(columns) - 2] if ratio == "of conditions" else [0])
    correlation = np.array([np.corrcoef(rng.standard_normal((6, 30))) for _ in range(3)])
    theta = rng.uniform(1e-4, 1.0, (6, 5)) * [1.0 if method else 0.0, 1e-4, 1e-3, 1e-3, 1.0 if residual else 0.0]
    share = rng.uniform(0.1, 1.0, (3, 6))
    return ErrorModel(
        columns=columns,
        inputs=inputs,
        gp=random_gp(rng, 4, 20, 0.3) if ratio == "of conditions" else ProjectedGP.constant(rng.standard_normal(6)),
        domain=learn_domain(X),
        base=BaseVariance(theta, theta[::-1] * [1.0, 1.0, 1.0, 1.0, 0.0], method, residual),
        division=Division(
            correlation=correlation,
            geometry_weight=np.array([0.4 if method else 0.0]),
            share=share / share.sum(0),
            growth=rng.uniform(0.0, 1.0, (2, 6)),
            ln_speed=np.array([0.2]),
            level=rng.uniform(-4.0, 0.0, 6),
            bias_tau_s=np.ones(6),
            **calibration or {},
        ),
        velocities=Velocities(rng.uniform(0.5, 2.0, 6), rng.uniform(0.5, 2.0, (len(COASTED), 6))),
        factor=rng.uniform(0.5, 2.0, 6),
        outside_power=np.array([0.6]),
        high=rng.uniform(0.0, 2.0, 6),
        typical_ln_det=np.array([-60.0]),
        nu=np.array([4.5]),
        dt_s=0.1,
    )


def some_calibration() -> dict[str, np.ndarray]:
    """Two ways to be wrong, in each of which axes go together."""
    patterns = np.zeros((6, 6, 6))
    patterns[0, [0, 4], 1] = 2.0, -0.7
    patterns[1, [2, 3, 2], [5, 5, 0]] = 1.1, 0.2, -0.4
    return {"calibration_patterns": patterns, "calibration_tau_s": np.full(6, 90.0)}


CASES = {
    "of conditions": some_model(),
    "a constant ratio": some_model(ratio="constant"),
    "no geometry": some_model(method=None),
    "noise of the residuals": some_model(residual=True),
    "errors of calibration": some_model(calibration=some_calibration()),
    "nothing but errors of calibration": some_model(
        calibration={"calibration_patterns": np.full((6, 6, 6), 1e6), "calibration_tau_s": np.ones(6)}
    ),
    "the least variance": replace(some_model(), factor=np.full(6, 1e-22)),
}


def some_inputs(model: ErrorModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows inside, at the edge, far outside, with missing values and of nothing else; geometry with some unknown;
    durations, some of them impossible."""
    rng = np.random.default_rng(1)
    n, d = 60, len(model.columns)
    X = model.domain.centre + model.domain.scale * rng.standard_normal((n, d))
    X[20:30] += 4.0 * model.domain.scale
    X[30:40, rng.integers(0, d, 10)] = np.nan
    X[40:48] = np.array([np.nan, np.inf, -np.inf, 0.0, 1e11, 1e13, 1e160, -1e300])[:, None]
    A = rng.standard_normal((n, 6, 9)) * 0.01
    geometry = A @ A.transpose(0, 2, 1)
    geometry[::5] = np.nan
    dt_s = rng.uniform(0.05, 0.3, n)
    dt_s[50:54] = 0.0, -1.0, np.nan, 1e300
    return X, geometry, dt_s


def assert_equal(got: dict[str, np.ndarray], wanted: Prediction) -> None:
    for name in FIELDS:
        if name == "distance":
            expected = np.sqrt(-2.0 * np.log(np.maximum(wanted.in_domain, 1e-300)))
            got = got | {name: np.minimum(got[name], np.sqrt(600.0 * np.log(10.0)))}
        elif name == "calibration_root":
            expected = wanted.persistent_root[:, :, -6:]
        else:
            expected = getattr(wanted, {"bias": "persistent"}.get(name, name))
        scale = np.sqrt(np.diagonal(wanted.covariance, axis1=1, axis2=2))
        if name == "calibration_root":
            unit = scale[:, :, None]
        elif name in MATRICES:
            unit = scale[:, :, None] * scale[:, None, :]
        elif name in ("mean", "epistemic"):
            unit = scale if name == "mean" else scale**2
        else:
            unit = np.maximum(np.abs(expected), 1e-3)
        assert got[name].shape == expected.shape, name
        assert np.abs((got[name] - expected) / unit).max() < 1e-5, name


@pytest.mark.parametrize("case", CASES)
def test_onnx_runs_to_the_same_numbers(case: str, tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    model = CASES[case]
    path = tmp_path / "model.onnx"
    to_onnx(model, path, metadata={"digest": "abc"})
    X, geometry, dt_s = some_inputs(model)
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    assert session.get_modelmeta().custom_metadata_map == {"features": ",".join(model.columns), "digest": "abc"}
    out = session.run(list(FIELDS), {"features": X, "geometry": geometry, "dt_s": dt_s})
    assert_equal(dict(zip(FIELDS, out, strict=True)), model.estimate(X, geometry, dt_s))
    again = tmp_path / "again.onnx"
    to_onnx(model, again, metadata={"digest": "abc"})
    assert again.read_bytes() == path.read_bytes()


@pytest.mark.parametrize("case", CASES)
def test_onnx_asks_nothing_that_older_runtimes_fail_on(case: str, tmp_path: Path) -> None:
    """To 1.20, they call what they fuse by the names of nodes; to 1.23, a product with a transpose is missing."""
    onnx = pytest.importorskip("onnx")
    to_onnx(CASES[case], tmp_path / "model.onnx")
    nodes = onnx.load(tmp_path / "model.onnx").graph.node
    assert len({node.name for node in nodes} - {""}) == len(nodes)
    transposes = {name for node in nodes if node.op_type == "Transpose" for name in node.output}
    assert not [node.name for node in nodes if node.op_type == "MatMul" and transposes & set(node.input)]


class CEstimate(ctypes.Structure):
    _fields_ = [
        ("mean", ctypes.c_double * 6),
        ("covariance", ctypes.c_double * 36),
        ("jitter", ctypes.c_double * 36),
        ("white", ctypes.c_double * 36),
        ("bias", ctypes.c_double * 36),
        ("calibration_root", ctypes.c_double * 36),
        ("epistemic", ctypes.c_double * 6),
        ("in_domain", ctypes.c_double),
        ("confidence", ctypes.c_double),
        ("nu", ctypes.c_double),
        ("distance", ctypes.c_double),
    ]


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler 'cc' on this machine")
@pytest.mark.parametrize("case", CASES)
def test_c_compiles_to_the_same_numbers(case: str, tmp_path: Path) -> None:
    model = CASES[case]
    to_c(
        model,
        tmp_path / "model.h",
        name="slam",
        units=("m/s",) * len(model.columns),
        note="a note */ that ends no comment",
    )
    source = tmp_path / "model.c"
    source.write_text(
        '#include "model.h"\nvoid run(const double *f, const double *g, double dt, slam_estimate *out)'
        " { slam_predict(f, g, dt, out); }\n"
    )
    library = tmp_path / "model.so"
    flags = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC"]
    subprocess.run(["cc", *flags, str(source), "-o", str(library), "-lm"], check=True)
    run = ctypes.CDLL(str(library)).run
    X, geometry, dt_s = some_inputs(model)
    found = []
    pointer = ctypes.POINTER(ctypes.c_double)
    for x, G, dt in zip(X, geometry, dt_s, strict=True):
        out, x, G = CEstimate(), np.ascontiguousarray(x), np.ascontiguousarray(G)
        run(x.ctypes.data_as(pointer), G.ctypes.data_as(pointer), ctypes.c_double(dt), ctypes.byref(out))
        found.append(out)
    shaped = {
        name: np.array(
            [np.ctypeslib.as_array(getattr(o, name)) if name in _VECTORS else getattr(o, name) for o in found]
        )
        for name in FIELDS
    }
    for name in MATRICES:
        shaped[name] = shaped[name].reshape(-1, 6, 6)
    assert_equal(shaped, model.estimate(X, geometry, dt_s))
    assert {o.nu for o in found} == {model.nu[0]}
    none = CEstimate()
    run(np.ascontiguousarray(X[0]).ctypes.data_as(pointer), None, ctypes.c_double(0.0), ctypes.byref(none))
    np.testing.assert_allclose(np.array(none.covariance).reshape(6, 6), model.estimate(X[:1]).covariance[0], rtol=1e-5)


_VECTORS = ("mean", *MATRICES, "epistemic")


def test_the_flag_for_filters_changes_nothing(tmp_path: Path) -> None:
    trained, model = small_model(), tmp_path / "errors.gpvo"
    modelfile.save(model, trained.arrays, trained.header)
    for name, flags in (("a.h", []), ("b.h", ["--for-filter"])):
        command = ["export", str(model), "-o", str(tmp_path / name), *flags]
        CliRunner().invoke(app, command, catch_exceptions=False)
    assert (tmp_path / "a.h").read_bytes() == (tmp_path / "b.h").read_bytes()


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler 'cc' on this machine")
def test_headers_with_their_own_prefixes_go_into_one_program(tmp_path: Path) -> None:
    model = tmp_path / "errors.gpvo"
    trained = small_model()
    modelfile.save(model, trained.arrays, trained.header)
    for prefix in ("predict", "myGPVO_fuse"):
        command = ["export", str(model), "--to", "c", "--prefix", prefix, "-o", str(tmp_path / f"{prefix}.h")]
        result = CliRunner().invoke(app, command, catch_exceptions=False)
        assert result.exit_code == 0, result.output
    source = tmp_path / "both.c"
    source.write_text(
        '#include "predict.h"\n#include "myGPVO_fuse.h"\n'
        "void run(const double *f, predict_estimate *a, myGPVO_fuse_estimate *b)"
        " { predict_predict(f, 0, 0.0, a); myGPVO_fuse_predict(f, 0, 0.0, b); }\n"
    )
    flags = ["-std=c99", "-Wall", "-Wdouble-promotion", "-Werror", "-c"]
    command = ["cc", *flags, str(source), "-o", str(tmp_path / "both.o")]
    subprocess.run(command, check=True)
    # A missing input is NaN, which the first option tells the compiler that there is none of; with the second, which
    # clang does not know, covariances of extreme inputs are not positive definite.
    for option, reason in (("-ffast-math", "missing inputs are NaN"), ("-fsingle-precision-constant", "needs_doubles")):
        refused = subprocess.run([*command, option], capture_output=True, text=True, check=False)
        assert refused.returncode != 0
        assert reason in refused.stderr or f"'{option}'" in refused.stderr


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler 'cc' on this machine")
def test_a_header_is_skipped_only_if_it_is_the_same_again(tmp_path: Path) -> None:
    for name, case in (("a", "of conditions"), ("b", "of conditions"), ("c", "no geometry")):
        to_c(CASES[case], tmp_path / f"{name}.h")
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-c", "-o", str(tmp_path / "x.o")]
    for second, compiles in (("b", True), ("c", False)):
        source = tmp_path / "x.c"
        # A file that takes the types alone has nothing to be warned of either.
        source.write_text(f'#include "a.h"\n#include "{second}.h"\ngpvo_estimate e;\n')
        built = subprocess.run(["cc", *flags, str(source)], capture_output=True, text=True, check=False)
        assert (built.returncode == 0) == compiles, built.stderr


def test_onnx_has_no_prefix(tmp_path: Path) -> None:
    with pytest.raises(GpvoError, match="only with c"):
        export_model(tmp_path / "model", tmp_path / "out", "onnx", prefix="mine")


def test_exports_name_the_geometry_that_they_take_and_how_long_errors_last(tmp_path: Path) -> None:
    """Columns of several geometric methods may be among the features; a filter needs the time constants."""
    for case, words in (("of conditions", "the covariance by triangulation."), ("no geometry", "not used.")):
        to_c(CASES[case], tmp_path / "model.h")
        assert f" * Geometry: {words}\n" in (tmp_path / "model.h").read_text()
    assert "#define GPVO_BIAS_TAU_S {1.0, 1.0, 1.0, 1.0, 1.0, 1.0}\n" in (tmp_path / "model.h").read_text()
    onnx = pytest.importorskip("onnx")
    trained, model = small_model(), tmp_path / "errors.gpvo"
    modelfile.save(model, trained.arrays, trained.header)
    export_model(model, tmp_path / "model.onnx", "onnx")
    told = {p.key: p.value for p in onnx.load(str(tmp_path / "model.onnx")).metadata_props}
    assert told["geometry"] == (trained.header["base_method"] if trained.arrays["geometry_weight"][0] > 0 else "")
    for name in ("bias_tau_s", "calibration_tau_s"):
        assert [float(v) for v in told[name].split(",")] == trained.arrays[name].tolist()


def test_c_names_must_be_identifiers(tmp_path: Path) -> None:
    with pytest.raises(GpvoError, match="not a C identifier"):
        to_c(CASES["of conditions"], tmp_path / "model.h", name="1+1")


def test_the_name_tells_the_format_and_does_not_contradict_it(tmp_path: Path) -> None:
    trained, model = small_model(), tmp_path / "errors.gpvo"
    modelfile.save(model, trained.arrays, trained.header)
    CliRunner().invoke(app, ["export", str(model), "-o", str(tmp_path / "x.h")], catch_exceptions=False)
    assert "gpvo_predict" in (tmp_path / "x.h").read_text()
    for words, message in (
        (["--to", "c", "-o", str(tmp_path / "x.onnx")], "x.onnx: is not a file name for --to c"),
        (["--to", "onnx", "-o", str(tmp_path / "y.h")], "y.h: is not a file name for --to onnx"),
        (["-o", str(tmp_path / "z")], "the format is not given"),
    ):
        with pytest.raises(GpvoError, match=message):
            CliRunner().invoke(app, ["export", str(model), *words], catch_exceptions=False)


def test_predictions_go_to_parquet_alone(tmp_path: Path) -> None:
    with pytest.raises(GpvoError, match=r"p\.csv: does not have the suffix of a Parquet file"):
        CliRunner().invoke(app, ["predict", "m.gpvo", "run", "-o", str(tmp_path / "p.csv")], catch_exceptions=False)


def test_predictions_where_something_else_is(tmp_path: Path) -> None:
    (tmp_path / "d.parquet").mkdir()
    (tmp_path / "f.parquet").touch()
    for runs, name, message in (
        (["a"], "d", "d.parquet: is a folder .*name a file"),
        (["a", "b"], "f", "is a file .*give a folder"),
    ):
        words = ["predict", "m.gpvo", *runs, "-o", str(tmp_path / f"{name}.parquet")]
        with pytest.raises(GpvoError, match=message):
            CliRunner().invoke(app, words, catch_exceptions=False)


def test_unknown_formats_are_refused(tmp_path: Path) -> None:
    with pytest.raises(GpvoError, match="one of: onnx, c"):
        export_model(tmp_path / "model", tmp_path / "out", "fortran")


def test_the_page_that_a_header_names_defines_every_feature(tmp_path: Path) -> None:
    root = Path(__file__).parents[2]
    export_model(root / "models" / "tunnel.gpvo", tmp_path / "model.h", "c")
    assert "their formulas: docs/concepts/features.rst" in (tmp_path / "model.h").read_text()
    formulas = (root / "docs" / "concepts" / "features.rst").read_text().split("\nFormulas\n")[1]
    of_axes = re.compile("_r?[xyz](_|$)|_det_")  # listed from the first to the last
    names = [c for c in known_columns() if not of_axes.search(c)]
    assert "ln_jerk_lately" in names
    assert not [n for n in names if f"``{n}``" not in formulas]
