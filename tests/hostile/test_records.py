"""Impossible records and rows: named, survived, and never answered with a small covariance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gpvo.errors import CalibrationError, SourceError
from gpvo.geometry import se3
from gpvo.geometry.covariance import is_positive_definite
from gpvo.learning.sample import TrainingSample
from gpvo.online.predictor import Predictor
from gpvo.types import Status, StereoCamera, StereoFrame, VoRecord
from gpvo.vo.odometry import StereoOdometry
from small_model import small_model
from synthetic_runs import CAMERA, make_run

TUNNEL = Path(__file__).parents[2] / "models" / "tunnel.gpvo"


@pytest.fixture
def predictor() -> Predictor:
    return small_model().predictor()


@pytest.fixture(scope="module")
def records() -> list[VoRecord]:
    return list(make_run(50, n=80)[0])


def _at(r: VoRecord, seconds: float) -> VoRecord:
    shift = round(seconds * 1e9)
    return replace(r, t_ns=r.t_ns + shift, t_prev_ns=r.t_prev_ns + shift)


def _moved(r: VoRecord, metres: float) -> VoRecord:
    T = r.T_prev_cur.copy()
    T[0, 3] = metres
    return replace(r, T_prev_cur=T)


BAD = {
    "ahead": (lambda r: replace(r, t_ns=r.t_ns + 10**12), "jumps by"),
    "far ahead, its start too": (lambda r: _at(r, 1000.0), "jumps by"),
    "back": (lambda r: _at(r, -5.0), "jumps by"),
    "repeated": (lambda r: replace(r, t_ns=r.t_prev_ns), "repeats"),
    "not a number": (lambda r: _moved(r, np.nan), "not finite"),
    "lost and not a number": (lambda r: replace(_moved(r, np.nan), status=Status.LOST, reason="dark"), "dark"),
    "of 1e200 m": (lambda r: _moved(r, 1e200), "not finite and rigid"),
    "no rotation": (lambda r: replace(r, T_prev_cur=np.diag([1.0, 2.0, 1.0, 1.0])), "not finite and rigid"),
    "ends before it begins": (lambda r: replace(r, t_prev_ns=r.t_ns + 1), "ends no later"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_record_is_lost_by_name_and_the_next_good_one_heals(case: str, predictor, records) -> None:
    change, words = BAD[case]
    usual = [predictor.step(r) for r in records]
    predictor.reset()
    for r in records[:40]:
        predictor.step(r)
    bad = predictor.step(change(records[40]))
    assert bad is not None
    assert bad.status is Status.LOST
    assert words in predictor._last[0].reason
    assert is_positive_definite(bad.covariance)
    after = [predictor.step(r) for r in records[41:]]
    for p, wanted in zip(after, usual[41:], strict=True):
        assert p.status is wanted.status
        assert is_positive_definite(p.covariance)
        np.testing.assert_allclose(p.sigma, wanted.sigma, rtol=0.2)


@pytest.mark.parametrize("shift_s", [1000.0, -1000.0])
def test_a_clock_that_was_set_is_believed_at_the_second_record(shift_s: float, predictor, records) -> None:
    said = [predictor.step(r) for r in [*records[:40], *(_at(r, shift_s) for r in records[40:])]]
    assert said[40].status is Status.LOST
    assert sum(p.status is Status.LOST for p in said[41:]) <= 2
    assert all(is_positive_definite(p.covariance) for p in said)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e160, -1e300, 0.0, 1e11, -1e11])
@pytest.mark.parametrize("dt_s", [0.1, 0.0, -1.0, np.nan, 1e300])
def test_any_row_is_answered_with_a_positive_definite_covariance(value: float, dt_s: float, predictor) -> None:
    for one in (predictor, Predictor.load(TUNNEL)):
        said = one.predict(np.full(len(one.features), value), dt_s=dt_s)
        assert is_positive_definite(said.covariance)
        assert np.isfinite(said.mean).all()
        assert 0 <= said.in_domain <= 1


@pytest.mark.parametrize("geometry", [3.0 * np.ones((6, 6)), np.diag([1.0, 1, 1, 1, 1, -1]), np.full((6, 6), np.inf)])
def test_an_impossible_geometry_is_left_out(geometry: np.ndarray) -> None:
    predictor = Predictor.load(TUNNEL)  # which believes the geometry, as a model of few flights does not
    np.fill_diagonal(geometry, np.where(np.diagonal(geometry) == 3.0, 1.0, np.diagonal(geometry)))
    x, possible = predictor.model.domain.centre, np.full((6, 6), 0.9) + 0.1 * np.eye(6)
    alone = predictor.predict(x).covariance
    np.testing.assert_array_equal(predictor.predict(x, geometry).covariance, alone)
    assert np.abs(predictor.predict(x, possible).covariance / alone - 1.0).max() > 0.1
    # Beside a possible one, too, of which nothing changes.
    both = predictor.predict(np.stack([x, x]), np.stack([geometry, possible])).covariance
    np.testing.assert_allclose(both, [alone, predictor.predict(x, possible).covariance], rtol=1e-12)


def test_a_row_without_its_inputs_is_no_surer_than_the_worst_of_training(predictor) -> None:
    for one in (predictor, Predictor.load(TUNNEL)):
        sample = TrainingSample.from_arrays(one.arrays, len(one.features))
        said = one.predict(sample.X, sample.geometry)
        usual = np.isclose(sample.dt_s, one.model.dt_s, rtol=0.1)
        for missing in (np.nan, np.inf, -np.inf, 1e13):
            nothing = one.predict(np.full(len(one.features), missing))
            assert (nothing.sigma >= np.quantile(said.sigma[usual], 0.99, axis=0)).all()
            assert nothing.in_domain < 0.01


def test_a_record_of_which_nothing_is_known_is_not_ok(predictor, records) -> None:
    for r in records[:40]:
        predictor.step(r)
    r = records[40]
    bare = predictor.step(VoRecord(r.t_ns, r.t_prev_ns, Status.OK, se3.exp(np.zeros(6))))
    assert bare.status is not Status.OK


@pytest.mark.parametrize("missing", ["w_", "v_"])
def test_one_missing_input_that_training_never_missed_is_not_in_the_domain(missing: str, predictor) -> None:
    x = predictor.model.domain.centre.copy()
    known = predictor.predict(x)
    at = [k for k, name in enumerate(predictor.features) if name.startswith(missing)]
    x[at] = np.nan
    said = predictor.predict(x)
    assert said.in_domain < 0.5
    assert (said.sigma >= known.sigma).all()


@pytest.mark.parametrize(
    "change",
    [
        {"baseline_m": -0.1},
        {"baseline_m": 110.0},
        {"width": 1e-320},
        {"fx_px": np.nan},
        {"width": 0},
        {"cx_px": np.inf},
        {"fy_px": "1"},
    ],
)
def test_a_camera_that_cannot_be_is_refused(change: dict) -> None:
    good = {**vars(CAMERA)}
    StereoCamera(**good)
    with pytest.raises(CalibrationError):
        StereoCamera(**{**good, **change})


def test_another_camera_than_that_of_training_is_told(predictor) -> None:
    predictor.reset(predictor.camera)
    with pytest.warns(UserWarning, match=r"another camera: baseline is 1, the model was trained with 0\.1"):
        predictor.reset(replace(predictor.camera, baseline_m=1.0))


@pytest.mark.parametrize(
    ("shape", "told"), [((48, 64, 3), r"uint8 \(48, 64, 3\)"), ((48,), r"\(48,\)"), (None, "NoneType")]
)
def test_a_picture_that_is_none_of_the_camera_is_refused_by_its_shape(shape: tuple | None, told: str) -> None:
    camera = StereoCamera(60.0, 60.0, 32.0, 24.0, 0.1, 64, 48)
    picture: Any = None if shape is None else np.zeros(shape, np.uint8)
    with pytest.raises(SourceError, match=rf"left image is .*{told}.* takes uint8 \(48, 64\)"):
        StereoOdometry(camera).step(StereoFrame(0, picture, np.zeros((48, 64), np.uint8)))
