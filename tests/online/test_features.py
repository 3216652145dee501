"""Columns of features are what their names say: of one record by formula, of several in closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.geometry.covariance import compound
from gpvo.online.features import AXES, FeatureStream, resolve
from gpvo.online.observer import Window
from gpvo.types import Status, StereoCamera, VoRecord

CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)
DT_S = 0.1
TWIST = np.array([1.0, -0.2, 3.0, 0.1, -0.4, 0.05])


def record(k: int, twist: np.ndarray = TWIST, **known: object) -> VoRecord:
    """The motion that ends at the k-th tenth of a second."""
    T = se3.exp(DT_S * twist)
    return VoRecord(k * 100_000_000, (k - 1) * 100_000_000, Status.OK, T, **known)  # type: ignore[arg-type]


def columns(selection: str, records: list[VoRecord]) -> dict[str, np.ndarray]:
    """(n,) values by name."""
    stream = FeatureStream(resolve(selection), CAMERA)
    return dict(zip(stream.names, np.array([stream.step(r) for r in records]).T, strict=True))


def test_columns_of_one_record():
    A = np.random.default_rng(0).standard_normal((2, 6, 6))
    C = {"pointing_matching": A[0] @ A[0].T, "triangulation": A[1] @ A[1].T}
    known: dict[str, object] = {
        "n_detected": 900, "n_stereo": 700, "n_tracked": 500, "n_inliers": 300, "disparity_p10_px": 2.0,
        "disparity_p50_px": 5.0, "disparity_p90_px": 30.0, "spread_u": 0.4, "spread_v": 0.3, "reproj_rms_px": 0.7,
        "log10_condition": 3.5, "brightness": 0.6, "contrast": 0.2, "sharpness": -1.5, "noise_level": 0.01,
        "imu_acc_mean_mps2": np.array([2.0, -9.0, 6.0]), "imu_gyro_mean_radps": np.array([0.1, 0.2, -0.2]),
        "imu_acc_std_mps2": np.array([3.0, 0.0, 4.0]), "imu_gyro_std_radps": np.array([0.0, 0.5, 1.2]),
    }  # fmt: skip
    expected = {
        **dict(zip(("v_x_mps", "v_y_mps", "v_z_mps", "w_x_radps", "w_y_radps", "w_z_radps"), TWIST)),
        **{name: known[name] for name in ("n_detected", "n_stereo", "n_tracked", "n_inliers")},
        "inlier_ratio": 300 / 500,
        **{f"ln_disparity_p{p}": math.log(known[f"disparity_p{p}_px"] / 400.0) for p in (10, 50, 90)},  # type: ignore[operator]
        **{name: known[name] for name in ("spread_u", "spread_v", "log10_condition")},
        "ln_reproj_rms": math.log(0.7 / 400.0),
        "ln_residual_px": math.log(0.7),
        **{name: known[name] for name in ("brightness", "contrast", "sharpness", "noise_level")},
        **{f"ln_var_{m}_{a}": math.log(C[m][i, i]) for m in C for i, a in enumerate(AXES)},
        **{f"ln_det_{m}": np.log(np.linalg.eigvalsh(C[m])).sum() for m in C},
        "imu_acc_mps2": 11.0, "imu_gyro_radps": 0.3, "imu_acc_std_mps2": 5.0, "imu_gyro_std_radps": 1.3,
        **{f"imu_acc_{a}_mps2": x for a, x in zip("xyz", (2.0, -9.0, 6.0))},
        **{f"imu_gyro_{a}_radps": x for a, x in zip("xyz", (0.1, 0.2, -0.2))},
    }  # fmt: skip
    chosen = "velocity, rotation, counts, geometry, image, residual, imu, imu_axes"
    found = columns(chosen, [record(1, covariances=C, **known)])
    assert {name: values[0] for name, values in found.items()} == pytest.approx(expected, rel=1e-12)


def test_what_is_not_known_is_no_number():
    """Nor is the logarithm of a covariance that is none."""
    bare = record(
        1, covariances={"triangulation": np.diag([-1.0, 0, 0, 0, 0, 0]), "pointing_matching": np.full((6, 6), np.nan)}
    )
    found = columns("counts, geometry, imu, imu_axes", [replace(bare, n_inliers=0)])
    assert {name for name, values in found.items() if not np.isnan(values[0])} == {"n_inliers"}
    odd = replace(bare, covariances={"triangulation": np.diag([-1.0, 1, 1, 1, 1, 1])})
    assert np.isnan(columns("ln_det_triangulation", [odd])["ln_det_triangulation"])


def test_trends_are_measured_against_a_second_that_fades():
    """Inliers and brightness step once, the velocity grows steadily; a lost frame is a longer step, nothing else."""
    a, step = np.array([3.0, 0.0, 4.0, 0.0, 0.6, 0.8]), 5
    records = [
        record(k, k * DT_S * a, n_inliers=100 + 200 * late, reproj_rms_px=0.5, brightness=0.3 + 0.2 * late)
        for k, late in ((k, k >= step) for k in range(1, 15))
    ]
    records[8] = replace(records[8], status=Status.LOST)
    found = columns("trend", records)
    told = np.array([k not in (0, 8) for k in range(14)])
    for values in found.values():
        np.testing.assert_array_equal(np.isnan(values), ~told)
    np.testing.assert_allclose(found["acceleration_mps2"][told], 5.0, rtol=1e-9)
    np.testing.assert_allclose(found["angular_acceleration_radps2"][told], 1.0, rtol=1e-9)
    since_s = DT_S * (np.arange(1, 15) - step)
    faded = np.where(since_s < 0, 0.0, np.exp(-np.maximum(since_s, 0.0)))
    faded[9] = faded[8]  # the mean is that of the frames before
    np.testing.assert_allclose(found["ln_inliers_change"][told], np.log(3.0) * faded[told], atol=1e-12)
    np.testing.assert_allclose(found["brightness_change"][told], 0.2 * faded[told], atol=1e-12)
    np.testing.assert_allclose(found["ln_reproj_rms_change"][told], 0.0, atol=1e-12)


def test_agility_is_speed_and_jerk_and_jerk_lately():
    """Of a velocity of constant jerk, and from the tenth motion on of a constant one: its square fades over 0.5 s."""
    jerk, ends = np.array([0.0, 2.0, 0.0, 0.3, 0.0, 0.4]), 10
    t_s = DT_S * np.arange(20)
    twists = [TWIST + jerk * 0.5 * min(t, DT_S * (ends - 1)) ** 2 for t in t_s]
    found = columns("agility", [record(k, w) for k, w in enumerate(twists)])
    np.testing.assert_allclose(np.exp(found["ln_speed"]) - 1e-3, [np.linalg.norm(w[:3]) for w in twists])
    np.testing.assert_allclose(np.exp(found["ln_turn_rate"]) - 1e-3, [np.linalg.norm(w[3:]) for w in twists])
    for now, lately, size in (
        ("ln_jerk", "ln_jerk_lately", 2.0),
        ("ln_angular_jerk", "ln_angular_jerk_lately", 0.5),
    ):
        measured = np.exp(found[now]) - 1e-3
        assert np.isnan(measured[:2]).all()
        np.testing.assert_allclose(measured[2:ends], size, rtol=1e-6)
        np.testing.assert_allclose(measured[ends + 1 :], 0.0, atol=1e-9)
        square = (np.exp(found[lately]) - 1e-3) ** 2
        np.testing.assert_allclose(square[2:ends], size**2, rtol=1e-6)
        np.testing.assert_allclose(square[ends + 1 :], square[ends] * np.exp(-(t_s[ends + 1 :] - t_s[ends]) / 0.5))


def test_a_motion_over_a_window_is_compounded_and_described_by_means():
    """Of what all its motions tell: a count or an IMU that one of them lacks is unknown."""
    rng = np.random.default_rng(1)
    imu = ("imu_gyro_mean_radps", "imu_acc_mean_mps2", "imu_gyro_std_radps", "imu_acc_std_mps2")
    motions = [
        record(
            k, TWIST + k, covariances={"triangulation": 1e-4 * k * np.eye(6)}, n_inliers=100 * k,
            n_stereo=-1 if k == 2 else 9, brightness=0.1 * k, sharpness=float(-k),
            **{name: rng.standard_normal(3) for name in imu},
        )
        for k in (1, 2, 3, 4)
    ]  # fmt: skip
    window = Window("window", 4 * DT_S)
    assert [window.step(r) for r in motions[:3]] == [None] * 3
    found = window.step(motions[3])
    assert found is not None
    T, C = np.eye(4), np.zeros((6, 6))
    for r in motions:
        T, C = T @ r.T_prev_cur, compound(r.T_prev_cur, C, r.covariances["triangulation"])
    np.testing.assert_allclose(found.T_prev_cur, T, atol=1e-14)
    np.testing.assert_allclose(found.covariances["triangulation"], C, atol=1e-12)
    assert (found.t_prev_ns, found.t_ns) == (motions[0].t_prev_ns, motions[3].t_ns)
    assert (found.n_inliers, found.n_stereo) == (250, -1)
    assert (found.brightness, found.sharpness) == pytest.approx((0.25, -2.5))
    for name in imu:
        np.testing.assert_allclose(getattr(found, name), np.mean([getattr(r, name) for r in motions], axis=0))
    silent = Window("window", 2 * DT_S)
    silent.step(motions[0])
    part = silent.step(replace(motions[1], imu_gyro_mean_radps=None, status=Status.DEGRADED))
    assert part is not None
    assert (part.imu_gyro_mean_radps, part.status) == (None, Status.DEGRADED)


def test_a_jerk_is_that_of_three_motions_in_a_row():
    records = [record(k) for k in range(1, 8)]
    records[3] = replace(records[3], status=Status.LOST)
    found = columns("agility", records)
    np.testing.assert_array_equal(np.isnan(found["ln_jerk"]), [True, True, False, True, True, True, False])
    assert np.isnan(found["ln_speed"]).tolist() == [k == 3 for k in range(7)]
