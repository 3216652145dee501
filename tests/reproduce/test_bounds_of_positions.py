"""Bounds of positions from what is said of motions."""

import numpy as np
import pytest
from gpvo.files import write_arrays
from gpvo.geometry import se3
from gpvo.reproduce.bounds import as_arrays, bounds_of, compounded, load_bounds, mean_shift, summed_v_t
from gpvo.types import MotionError, Status, TruthLog, VoLog, VoRecord

V_T = np.diag([1e-4, 2e-4, 9e-4])


def log(n=6, xi=(0.0, 0.0, 0.5, 0.0, 0.3, 0.0)):
    start = VoRecord(0, 0, Status.START, np.eye(4))
    T = se3.exp(np.array(xi))
    rest = [VoRecord(k * 10**8, (k - 1) * 10**8, Status.OK, T, v_t={"m": V_T}) for k in range(1, n)]
    return VoLog([start, *rest])


def test_the_thesis_sums_v_t_in_the_axes_of_the_first_camera():
    turned = log()
    T = turned.trajectory()
    by_hand = sum(T[k, :3, :3] @ V_T @ T[k, :3, :3].T for k in range(5))
    np.testing.assert_allclose(summed_v_t(turned, "m")[-1], by_hand)


def test_rotation_noise_moves_the_position_when_compounded():
    turned = log()
    quiet, shaky = (np.diag([1e-4] * 3 + [r] * 3) for r in (1e-12, 1e-4))
    said = [[MotionError.independent(C)] * len(turned) for C in (quiet, shaky)]
    a, b = (np.trace(compounded(turned, steps)[-1]) for steps in said)
    assert a == pytest.approx(5 * 3e-4, rel=1e-6)
    assert b > 1.5 * a


def test_a_mean_error_shifts_positions():
    straight = log(xi=(0, 0, 0.5, 0, 0, 0))
    mean = np.tile([0, 0, 0.01, 0, 0, 0], (6, 1))
    mean[0] = 0.0
    np.testing.assert_allclose(mean_shift(straight, mean)[-1], [0, 0, 0.05], atol=1e-12)


def test_error_in_the_axes_of_the_first_camera(tmp_path):
    straight = log(xi=(0, 0, 0.5, 0, 0, 0))
    T_world_first = se3.exp(np.array([1.0, 2, 3, 0.1, 0.2, 0.3]))
    truth = TruthLog(straight.t_ns, T_world_first @ log(xi=(0, 0, 0.4, 0, 0, 0)).trajectory())

    class Run:
        name = "r"

    Run.log, Run.truth = straight, truth
    b = bounds_of(Run, np.zeros((6, 3)), np.tile(np.eye(3), (6, 1, 1)))
    np.testing.assert_allclose(b.error_m[-1], [0, 0, 0.5], atol=1e-9)
    assert b.path_m[-1] == pytest.approx(2.0)
    write_arrays(tmp_path / "b.npz", as_arrays([b, b]))
    again = load_bounds(tmp_path / "b.npz")
    assert len(again) == 2
    np.testing.assert_array_equal(again[1].error_m, b.error_m)
