"""Bad input to a filter: one clear line each, and none for a good flight."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.evaluation.flights import flight_of
from gpvo.filters import sanity
from gpvo.filters.imu_motion import clock_shift
from gpvo.filters.policies import LearnedPolicy
from gpvo.filters.run import Flight, fuse_flight
from gpvo.filters.sanity import check_flight, require_sane
from gpvo.geometry import se3
from gpvo.io.run import read_run
from gpvo.io.source import open_source
from gpvo.runner import run
from gpvo.sim.points import simulate_points
from gpvo.types import ImuLog
from synthetic_flights import ErrorLaw, synthetic_flight, with_geometric


@pytest.fixture(scope="module")
def flight() -> Flight:
    return synthetic_flight(4, duration_s=20)


def _with_imu(flight: Flight, change: Callable[[ImuLog], ImuLog]) -> Flight:
    assert flight.imu is not None
    return replace(flight, imu=change(flight.imu))


@pytest.mark.parametrize("seed", range(6))
def test_a_good_flight_has_no_findings(seed: int) -> None:
    assert check_flight(synthetic_flight(seed, duration_s=20)) == []


@pytest.mark.parametrize(
    "change, kind, words",
    [
        (lambda i: replace(i, acc_mps2=i.acc_mps2 / 9.80665), "acc_unit", "in g"),
        (lambda i: replace(i, gyro_radps=np.degrees(i.gyro_radps)), "gyro_unit", "degrees per second"),
        (lambda i: replace(i, gyro_radps=i.gyro_radps[:, [1, 0, 2]]), "gyro_axes", "axes renamed to (y, x, z)"),
        (lambda i: replace(i, gyro_radps=i.gyro_radps * [1, -1, -1]), "gyro_axes", "(x, -y, -z)"),
        (lambda i: replace(i, acc_mps2=i.acc_mps2[:, [2, 1, 0]]), "acc_axes", "accelerometer's axes renamed"),
        (lambda i: replace(i, acc_mps2=i.acc_mps2[:, [2, 0, 1]]), "acc_axes", "axes renamed to (y, z, x)"),
        (
            lambda i: replace(i, acc_mps2=i.acc_mps2[:, [2, 0, 1]], gyro_radps=i.gyro_radps[:, [2, 0, 1]]),
            "gyro_axes",
            "axes renamed to (y, z, x)",
        ),
        (lambda i: replace(i, gyro_radps=0 * i.gyro_radps), "gyro_zero", "exactly zero throughout"),
        (lambda i: replace(i, acc_mps2=-i.acc_mps2), "acc_sign", "its sign is wrong"),
        (lambda i: replace(i, t_ns=i.t_ns + 10**12), "clock", "do not overlap"),
    ],
)
def test_a_wrong_imu_is_named(flight: Flight, change: Callable[[ImuLog], ImuLog], kind: str, words: str) -> None:
    wrong = _with_imu(flight, change)
    found = [f for f in check_flight(wrong) if f.fatal]
    assert any(f.kind == kind and words in f.text for f in found), [str(f) for f in found]
    with pytest.raises(GpvoError) as error:
        require_sane(wrong)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("per_mps2", [1 / 9.80665, 1e3 / 9.80665, 100.0])
def test_the_cure_of_a_wrong_unit_restores_the_reading(flight: Flight, per_mps2: float) -> None:
    wrong = _with_imu(flight, lambda i: replace(i, acc_mps2=i.acc_mps2 * per_mps2))
    (found,) = [f for f in check_flight(wrong) if f.kind == "acc_unit"]
    assert per_mps2 * float(found.cure.removeprefix("multiply it by ")) == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_bias_beyond_what_filters_expect_is_measured(flight: Flight, axis: int) -> None:
    bias = np.radians(5.0) * np.eye(3)[axis]
    biased = _with_imu(flight, lambda imu: replace(imu, gyro_radps=imu.gyro_radps + bias))
    (finding,) = check_flight(biased)
    assert finding.kind == "gyro_bias"
    assert not finding.fatal
    told = [float(v) for v in re.findall(r"-?\d+\.\d+", finding.text)]
    np.testing.assert_allclose(np.radians(told), bias, atol=np.radians(0.5))  # its own is 0.1 deg/s


def test_a_wrong_gyroscope_is_named_beside_slow_frames() -> None:
    slow = synthetic_flight(4, duration_s=60, rate_hz=1.0)
    assert [f for f in check_flight(slow) if f.fatal] == []
    wrong = _with_imu(slow, lambda i: replace(i, gyro_radps=i.gyro_radps[:, [1, 0, 2]]))
    assert [f.kind for f in check_flight(wrong) if f.fatal] == ["gyro_axes"]


@pytest.mark.parametrize("signs", [(-1, -1, -1), (1, 1, -1), (1, -1, -1)])
def test_a_cure_of_wrong_signs_blames_only_what_shows(signs: tuple[int, ...]) -> None:
    """In a level flight that is the vertical axis: three signs changed for one would make the other two wrong."""
    level = flight_of(read_run(Path(__file__).parents[2] / "data" / "tunnel-1"))
    (found,) = check_flight(_with_imu(level, lambda i: replace(i, acc_mps2=i.acc_mps2 * signs)))
    assert found.kind == "acc_sign"
    assert "as axis z shows" in found.text
    assert "FRD" in found.cure


def test_gyroscope_and_accelerometer_in_each_other_s_columns(flight: Flight) -> None:
    wrong = _with_imu(flight, lambda i: replace(i, gyro_radps=i.acc_mps2, acc_mps2=i.gyro_radps))
    assert "they are exchanged" in check_flight(wrong)[0].text


@pytest.mark.parametrize("axis", [(0.0, 0.6, 0.0), (0.3, -0.3, 0.5)])
def test_a_mounting_that_is_turned_by_no_right_angle(flight: Flight, axis: tuple[float, ...]) -> None:
    assert flight.T_imu_cam is not None
    turned = se3.exp(np.array([0.0, 0.0, 0.0, *axis]))
    (found,) = check_flight(replace(flight, T_imu_cam=turned @ flight.T_imu_cam))
    assert found.kind == "gyro_axes"
    told_deg = float(re.search(r"are (\d+) degrees apart", found.text)[1])
    assert told_deg == pytest.approx(np.rad2deg(np.linalg.norm(axis)), abs=3)


@pytest.mark.parametrize("seed", range(5, 9))
def test_the_imu_of_another_flight_has_no_swapped_axes(flight: Flight, seed: int) -> None:
    """Of 48 names for its axes, one agrees by chance."""
    found = check_flight(replace(flight, imu=synthetic_flight(seed, duration_s=20).imu))
    assert not any("axes renamed" in f.text for f in found)


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_a_car_that_only_yaws_has_no_swapped_axes(seed: int, tmp_path: Path) -> None:
    """Seen once a second: what odometry says of its roll and pitch is mostly noise."""
    drive = simulate_points("street", seed, duration_s=100.0, rate_hz=1.0, speed_mps=5.0).save(tmp_path / "drive.npz")
    run(open_source(drive), tmp_path / "run")
    require_sane(flight_of(read_run(tmp_path / "run")))


def test_a_clock_that_is_off_by_more_than_is_tried(flight: Flight) -> None:
    found = check_flight(_with_imu(flight, lambda i: replace(i, t_ns=i.t_ns + 230 * 10**6)))
    (late,) = (f for f in found if "too late" in f.text)
    assert "at least 200 ms" in late.text
    assert "timeshift" not in late.cure


@pytest.mark.parametrize("late_ms", [-120, -40, 60])
def test_another_clock_is_measured(flight: Flight, late_ms: int) -> None:
    wrong = _with_imu(flight, lambda i: replace(i, t_ns=i.t_ns + late_ms * 10**6))
    (found,) = require_sane(wrong)
    shift_s = float(re.search(r"add (-?[\d.]+) to timeshift_cam_imu", found.cure)[1])
    assert found.kind == "clock"
    assert shift_s == pytest.approx(late_ms * 1e-3, abs=0.01)
    assert f"ms too {'late' if late_ms > 0 else 'early'}" in found.text
    # As a reader applies it: t_imu = t_cam + shift.
    assert wrong.imu is not None
    assert require_sane(_with_imu(wrong, lambda i: replace(i, t_ns=i.t_ns - round(shift_s * 1e9)))) == []


@pytest.mark.parametrize("late_ms", [0, 15])
@pytest.mark.parametrize("noise", [1.0, 40.0])
def test_no_other_clock_is_made_up(late_ms: int, noise: float) -> None:
    usual = ErrorLaw()
    law = ErrorLaw(usual.jitter * noise, usual.white * noise, usual.bias * noise)
    for seed in range(5):
        noisy = _with_imu(
            synthetic_flight(seed, duration_s=8, law=law), lambda i: replace(i, t_ns=i.t_ns + late_ms * 10**6)
        )
        assert [f for f in check_flight(noisy) if f.kind in ("clock", "acc_sign")] == []


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_wrong_sign_in_a_short_flight_is_said(seed: int) -> None:
    wrong = _with_imu(synthetic_flight(seed, duration_s=8), lambda i: replace(i, acc_mps2=-i.acc_mps2))
    (found,) = require_sane(wrong)
    assert found.kind == "acc_sign"


def test_linear_acceleration_is_not_specific_force(flight: Flight) -> None:
    assert flight.imu is not None
    up = flight.T_world_imu[:, 2, :3]
    nearest = np.minimum(np.arange(len(flight.imu.t_ns)) // 10, len(up) - 1)
    wrong = _with_imu(flight, lambda i: replace(i, acc_mps2=i.acc_mps2 - 9.80665 * up[nearest]))
    assert [f.kind for f in check_flight(wrong)] == ["acc_unit"]
    assert "gravity has been removed" in check_flight(wrong)[0].text


def test_gaps_and_bad_samples_are_said_but_not_fatal(flight: Flight) -> None:
    assert flight.imu is not None
    keep = np.ones(len(flight.imu.t_ns), bool)
    keep[1000:1100] = False
    acc = flight.imu.acc_mps2.copy()
    acc[5] = np.nan
    gappy = ImuLog(flight.imu.t_ns[keep], flight.imu.gyro_radps[keep], acc[keep], flight.imu.noise)
    found = require_sane(replace(flight, imu=gappy))
    assert any("1 gap in the IMU, the longest 0.5" in f.text for f in found)
    assert any("1 of" in f.text and "not finite" in f.text for f in found)


def test_an_imu_without_a_finite_sample_has_its_cure(flight: Flight) -> None:
    wrong = _with_imu(flight, lambda i: replace(i, acc_mps2=np.full_like(i.acc_mps2, np.nan)))
    with pytest.raises(GpvoError, match="IMU samples are not finite.*--no-imu"):
        require_sane(wrong)


def test_bad_covariances_are_counted(flight: Flight) -> None:
    good = np.eye(6) * 1e-4
    some = with_geometric(flight, good)
    records = list(some.records)
    indefinite = good.copy()
    indefinite[0, 0] = -1e-4
    records[3] = replace(records[3], covariances={"triangulation": indefinite})
    records[4] = replace(records[4], covariances={"triangulation": good * np.nan})
    found = [str(f) for f in require_sane(replace(some, records=records))]
    assert len(found) == 2
    assert all("triangulation" in line and "t_ns" in line for line in found)
    with pytest.raises(GpvoError, match="not symmetric positive definite"):
        require_sane(with_geometric(flight, -good))


def test_a_level_flight_without_rotation_in_degrees(flight: Flight) -> None:
    assert flight.imu is not None
    still = [replace(r, T_prev_cur=np.eye(4)) for r in flight.records]
    gyro = np.full_like(flight.imu.gyro_radps, 20.0)
    found = check_flight(replace(flight, records=still, imu=replace(flight.imu, gyro_radps=gyro)))
    assert any(f.kind == "gyro_unit" for f in found)


def test_a_missing_covariance_is_counted(flight: Flight) -> None:
    some = with_geometric(flight, np.eye(6) * 1e-4)
    records = [replace(r, covariances={}) if i == 7 else r for i, r in enumerate(some.records)]
    assert "have no finite triangulation covariance" in str(require_sane(replace(some, records=records))[0])


def test_frames_beyond_the_imu_are_left_out_and_a_bad_sample_spoils_nothing(flight: Flight) -> None:
    assert flight.imu is not None
    acc = flight.imu.acc_mps2.copy()
    acc[100:110] = np.nan
    half = ImuLog(flight.imu.t_ns[:2000], flight.imu.gyro_radps[:2000], acc[:2000], flight.imu.noise)
    short = replace(flight, imu=half)
    assert "left out" in str([str(f) for f in check_flight(short)])
    run = fuse_flight(short, LearnedPolicy())
    assert run.t_ns[-1] <= half.t_ns[-1] + 100_000_000
    assert run.scores is not None
    assert run.scores.ate_rmse_m < 0.1


@pytest.mark.parametrize("late_s", [0.06, -0.1, 0.0])
def test_the_shift_of_a_clock_is_found_where_the_vehicle_turns(late_s: float) -> None:
    flight = synthetic_flight(2, duration_s=20)
    assert flight.imu is not None
    shifted = replace(flight.imu, t_ns=flight.imu.t_ns + round(late_s * 1e9))
    found = clock_shift(flight, shifted)
    assert (found is None) == (late_s == 0.0)
    assert found is None or found.shift_s == pytest.approx(late_s, abs=0.01)
    # Of a vehicle that hardly turns nothing is told.
    straight = [replace(r, T_prev_cur=se3.from_rt(np.eye(3), r.T_prev_cur[:3, 3])) for r in flight.records]
    assert clock_shift(replace(flight, records=straight), shifted) is None


@pytest.mark.parametrize("axes", [[1, 0, 2], [2, 0, 1]])
def test_motion_tells_the_axes_of_an_accelerometer_where_gravity_does_not(
    flight: Flight, axes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a vehicle that accelerates all the time."""
    monkeypatch.setattr(sanity, "_accelerometer_axes", lambda imu: iter(()))
    assert check_flight(flight) == []
    renamed = _with_imu(flight, lambda i: replace(i, acc_mps2=i.acc_mps2[:, axes]))
    right = ", ".join("xyz"[axes.index(k)] for k in range(3))
    with pytest.raises(GpvoError, match=re.escape(f"with its axes renamed to ({right})")):
        require_sane(renamed)


def test_a_small_shift_of_a_clock_is_found_where_the_odometry_is_good() -> None:
    law = ErrorLaw(jitter=np.full(6, 1e-4), white=np.full(6, 1e-4), bias=np.full(6, 1e-5))
    flight = synthetic_flight(2, duration_s=20, law=law)
    assert flight.imu is not None
    assert clock_shift(flight, flight.imu) is None
    found = clock_shift(flight, replace(flight.imu, t_ns=flight.imu.t_ns + 12_000_000))
    assert found is not None
    assert found.shift_s == pytest.approx(0.012, abs=0.003)
