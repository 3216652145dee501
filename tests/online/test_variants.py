"""Files of older versions, which held a GP of the error's mean and a model for filters, are read or refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gpvo.errors import ModelError
from gpvo.online import modelfile
from gpvo.online.predictor import Predictor
from gpvo.online.projected import ProjectedGP
from gpvo.online.variants import arrays_of_base, upgraded
from small_model import small_model

SHARED = ("centre", "lengthscale", "points", "projection")


def as_written_before(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Today's arrays by the names and in the form of an older file."""
    gp = {name.removeprefix("gp."): a for name, a in arrays.items() if name.startswith("gp.")}
    kept = {n: a for n, a in arrays.items() if not n.startswith(("gp.", "base.")) and "calibration" not in n}
    blank = {n: np.zeros_like(gp[n]) for n in ("weights", "reduction", "signal_var", "offset")}
    mean = {n: gp[n] for n in SHARED} | blank
    noise = {n: gp[n] for n in gp if n not in SHARED} | {"offset": gp["offset"] - 0.25}
    return {
        **kept,
        **{f"basis.mean.{n}": a for n, a in mean.items()},
        **{f"basis.noise.{n}": a for n, a in noise.items()},
        "basis.log_noise_offset": np.full(6, 0.25),
        "for_filter.steady_mean": np.full(6, 0.1),
        "steady_mean": np.zeros(6),
        "mean_in_sigma": np.array([True]),
    }


def test_older_files_are_read(tmp_path: Path) -> None:
    trained = small_model()
    modelfile.save(tmp_path / "old.gpvo", as_written_before(dict(trained.arrays)), trained.header)
    old, new = Predictor.load(tmp_path / "old.gpvo"), trained.predictor()
    X = np.random.default_rng(0).standard_normal((20, len(new.features)))
    np.testing.assert_allclose(old.predict(X).covariance, new.predict(X).covariance, rtol=1e-12)
    np.testing.assert_array_equal(old.base().predict(X).covariance, old.predict(X).covariance)


def test_of_an_older_file_with_a_mean_the_model_for_filters_is_the_model(tmp_path: Path) -> None:
    trained = small_model()
    arrays = as_written_before(dict(trained.arrays))
    without = {f"for_filter.{n}": a for n, a in arrays.items() if n.startswith("basis.")}
    leaning = {**arrays, "basis.mean.weights": arrays["basis.mean.weights"] + 0.1}
    modelfile.save(tmp_path / "m.gpvo", leaning, trained.header)
    with pytest.raises(ModelError, match=r"m\.gpvo: its GP has a mean of the error.*train the model again"):
        Predictor.load(tmp_path / "m.gpvo")
    leaning |= {**without, "for_filter.factor": 2.0 * arrays["factor"]}
    found = upgraded(leaning)
    np.testing.assert_allclose(found["gp.offset"], trained.arrays["gp.offset"])
    np.testing.assert_array_equal(found["factor"], 2.0 * arrays["factor"])
    assert "calibration_patterns" not in upgraded({**leaning, "calibration_patterns": np.ones((6, 6, 6))})


def test_an_older_base_without_a_part_of_calibration_has_none() -> None:
    arrays = as_written_before(dict(small_model().arrays)) | {"calibration_patterns": np.ones((6, 6, 6))}
    none = {f"base.basis.{n}": a for n, a in ProjectedGP.constant(np.zeros(6)).to_arrays("mean.").items()}
    base = arrays_of_base(upgraded({**arrays, **none, "base.basis.log_noise_offset": np.zeros(6)}))
    assert not base["calibration_patterns"].any()
    assert not base["gp.weights"].any()
    assert base["gp.offset"].shape == (6,)
