"""Independent models of what three consumers read, in the terms of their own source, against ours.

PX4: src/modules/mavlink/mavlink_receiver.cpp, src/modules/ekf2 (EKF2_EV_NOISE_MD, EKF2_EV*_NOISE). ArduPilot:
libraries/GCS_MAVLink/GCS_Common.cpp and libraries/AP_VisualOdom/AP_VisualOdom_MAV.cpp. robot_localization:
src/ros_filter.cpp and src/ekf.cpp.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.publish import consumers
from gpvo.publish.mavlink import upper_triangle
from gpvo.publish.odometry import Odometry, OdometryBuilder, lift, messages
from receivers import Px4Parameters, ardupilot_errors, px4_sigmas, robot_localization_covariance
from synthetic_flights import ErrorLaw, synthetic_flight


@pytest.fixture(scope="module")
def odometry() -> list[Odometry]:
    flight = synthetic_flight(5, duration_s=5, law=ErrorLaw(burst_factor=10.0))
    return list(messages(flight.records, lambda r: flight.predictions.get(r.t_ns), OdometryBuilder()))[1:]


def check(odometry: Sequence[Odometry], consumer: str) -> list[consumers.Verdict]:
    """As publishing asks, while the messages are written."""
    found = consumers.Check(consumer)
    assert [o.t_ns for o in found.passing(odometry)] == [o.t_ns for o in odometry]
    return found.verdicts()


def _px4_intake(wire: list[float], floor: float) -> list[float]:
    """mavlink_receiver takes elements 0, 6, 11 as variances; EKF2 takes max(variance, floor^2)."""
    return [math.sqrt(max(wire[i], floor**2)) for i in (0, 6, 11)]


def test_px4_reads_diagonals_and_floors_them(odometry: list[Odometry]) -> None:
    for item in odometry:
        ours = px4_sigmas(item)
        np.testing.assert_allclose(ours["velocity"], _px4_intake(upper_triangle(item.twist_covariance), 0.1))
        np.testing.assert_allclose(ours["position"], _px4_intake(upper_triangle(item.pose_covariance), 0.1))
        yaw = math.sqrt(max(upper_triangle(item.pose_covariance)[20], 0.1**2))
        np.testing.assert_allclose(ours["yaw"], [yaw])


def test_px4_mode_one_ignores_the_message(odometry: list[Odometry]) -> None:
    sigmas = px4_sigmas(odometry[0], Px4Parameters(EKF2_EV_NOISE_MD=1, EKF2_EVV_NOISE=0.3))
    np.testing.assert_array_equal(sigmas["velocity"], [0.3] * 3)


def _ardupilot_intake(wire: list[float], *, old: bool) -> tuple[float, float]:
    position = angle = 0.0
    if not math.isnan(wire[0]):
        if old:
            position = (wire[0] ** 2 + wire[6] ** 2 + wire[11] ** 2) ** (1 / 3)
            angle = (wire[15] ** 2 + wire[18] ** 2 + wire[20] ** 2) ** (1 / 3)
        else:
            position = math.sqrt(wire[0] + wire[6] + wire[11])
            angle = math.sqrt(wire[15] + wire[18] + wire[20])
    return min(max(position, 0.2), 100.0), min(max(angle, 0.2), 1.5)


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("scale", [1.0, 1e3, 1e6, 1e10])
def test_ardupilot_collapses_and_clamps(odometry: list[Odometry], old: bool, scale: float) -> None:
    for item in odometry[::10]:
        C = item.pose_covariance * scale
        ours = ardupilot_errors(C, before_2026=old)
        np.testing.assert_allclose(ours, _ardupilot_intake(upper_triangle(C), old=old), rtol=1e-9)
    assert ardupilot_errors(np.full((6, 6), np.nan), before_2026=old) == (0.2, 0.2)


def test_robot_localization_floors_and_takes_absolutes() -> None:
    C = np.eye(6)
    C[1, 1], C[2, 2] = -0.5, 1e-12
    C[0, 3] = C[3, 0] = 0.4
    used = robot_localization_covariance(C)
    np.testing.assert_array_equal(np.diagonal(used), [1, 0.5, 1e-9, 1, 1, 1])
    assert used[0, 3] == 0.4


def test_check_names_the_parameter_that_hides_the_prediction(odometry: list[Odometry]) -> None:
    calm = [replace(o, twist_covariance=np.eye(6) * 0.02**2) for o in odometry]
    velocity = next(v for v in check(calm, "px4") if v.quantity == "velocity")
    assert velocity.hidden_percent == 100.0
    assert "Set EKF2_EVV_NOISE to 0.02" in str(velocity)
    loud = [replace(o, twist_covariance=np.eye(6)) for o in odometry]
    velocity = next(v for v in check(loud, "px4") if v.quantity == "velocity")
    assert velocity.hidden_percent == 0.0
    assert not velocity.advice
    tiny = [replace(o, twist_covariance=np.eye(6) * 1e-3**2) for o in odometry]
    velocity = next(v for v in check(tiny, "px4") if v.quantity == "velocity")
    assert "Set EKF2_EVV_NOISE to 0.01, the smallest it accepts, which hides an axis in 100 %" in velocity.advice
    part = [replace(o, twist_covariance=np.eye(6) * (1e-3 if k % 4 else 2e-2) ** 2) for k, o in enumerate(odometry)]
    velocity = next(v for v in check(part, "px4") if v.quantity == "velocity")
    hidden = 100 * np.mean([k % 4 > 0 for k in range(len(odometry))])
    assert velocity.advice.endswith(f"which hides an axis in {hidden:.0f} %")


def test_check_of_the_others(odometry: list[Odometry]) -> None:
    ardupilot = [str(v) for v in check(odometry, "ardupilot")]
    assert any("VISO_POS_M_NSE" in line for line in ardupilot)
    assert any("VISION_SPEED_ESTIMATE" in line and "VISO_QUAL_MIN" in line for line in ardupilot)
    # EKF3 takes no less than 5 degrees of yaw, 1 cm and 5 cm/s: to set a parameter lower changes nothing.
    still = [replace(o, pose_covariance=np.eye(6) * 1e-6, twist_covariance=np.eye(6) * 1e-4) for o in odometry]
    position, _, angle, _, speed, velocity = check(still, "ardupilot")
    assert "Set VISO_POS_M_NSE to 0.01, the smallest it accepts" in position.advice
    assert "Set VISO_YAW_M_NSE to 0.087, the smallest it accepts" in angle.advice
    assert "set VISO_VEL_M_NSE to 0.05;" in velocity.advice
    # VISION_SPEED_ESTIMATE's covariance is taken for one sigma, the root of its trace, but not below the parameter.
    assert "Set VISO_VEL_M_NSE to 0.05, the smallest it accepts" in speed.advice
    assert speed.hidden_percent == 100.0
    assert speed.axes[0].predicted_sigma == pytest.approx(((3e-4) ** 0.5,) * 3)
    loud = [replace(o, twist_covariance=np.eye(6) * 0.06**2) for o in odometry]
    assert check(loud, "ardupilot")[4].hidden_percent == 0.0
    assert all(v.hidden_percent == 0 for v in check(odometry, "robot_localization"))
    lifted = [replace(o, twist_covariance=lift(np.eye(6) * 1e-12, 1e-9)) for o in odometry]
    assert [v.hidden_percent for v in check(lifted, "robot_localization")] == [100.0, 100.0, 0.0, 0.0]
    for axis in range(6):  # it floors each of them
        one = [replace(o, twist_covariance=np.diag(np.where(np.arange(6) == axis, 1e-12, 1.0))) for o in odometry]
        verdicts = check(one, "robot_localization")
        hidden = [a.hidden_percent for v in verdicts for a in v.axes]
        assert hidden == [100.0 * (k == axis) for k in range(12)]
        assert [v.hidden_percent for v in verdicts] == [100.0 * (axis < 3), 100.0 * (axis >= 3), 0.0, 0.0]
    with pytest.raises(GpvoError, match="unknown consumer"):
        check(odometry, "betaflight")


def test_a_check_speaks_of_each_axis_and_mixes_no_units(odometry: list[Odometry]) -> None:
    """The smallest axis was shown as the sigma, and what hides it as what hides all."""
    sigma = np.array([0.05, 0.2, 0.3, 0.001, 0.002, 0.003])
    frames = [replace(o, twist_covariance=np.diag(sigma**2)) for o in odometry]
    velocity = str(check(frames, "px4")[0])
    assert "x 0.05 / 0.05 / 0.05 m/s, y 0.2 / 0.2 / 0.2 m/s, z 0.3 / 0.3 / 0.3 m/s (5, 50, 95 %)" in velocity
    assert "hides x in 100 %, y in 0 %, z in 0 % of frames. Set EKF2_EVV_NOISE to 0.05" in velocity
    twist = str(check(frames, "fusioncore")[0])
    assert "vx 0.05 / 0.05 / 0.05 m/s, vy 0.2 / 0.2 / 0.2 m/s, yaw rate 0.003 / 0.003 / 0.003 rad/s" in twist
    told = [str(v) for v in check(frames, "robot_localization")]
    assert [line.split(":")[0] for line in told] == ["velocity", "turn rate", "position", "orientation"]


def test_check_reads_of_each_axis_what_the_consumer_reads(odometry: list[Odometry]) -> None:
    of_pose, of_twist = np.array([0.3, 0.4, 1.2, 0.02, 0.03, 0.06]), np.array([0.02, 0.03, 0.06, 2.0, 3.0, 6.0])
    grown = np.linspace(0.5, 1.5, len(odometry))
    frames = [
        replace(o, pose_covariance=np.diag(of_pose * g) ** 2, twist_covariance=np.diag(of_twist * g) ** 2)
        for o, g in zip(odometry, grown, strict=True)
    ]
    cube = (0.3**4 + 0.4**4 + 1.2**4) ** (1 / 3), (0.02**4 + 0.03**4 + 0.06**4) ** (1 / 3)
    middle = {
        "px4": [*of_twist[:3], *of_pose[:3], 0.06],
        "ardupilot": [1.3, cube[0], 0.07, cube[1], 0.07, 0.06],
        "robot_localization": [*of_twist, *of_pose],
        "fusioncore": [0.02, 0.03, 6.0, *of_pose],
    }
    for consumer, sigmas in middle.items():
        found = check(frames, consumer)
        assert [a.predicted_sigma[1] for v in found for a in v.axes] == pytest.approx(sigmas, rel=0.02)
    # A velocity's sigma has a usual level, whose low end must not be hidden; of a pose's, which grows, the middle.
    velocity, position, yaw = check(frames, "px4")
    assert "hides it in 100 % of frames" in str(velocity)
    assert "x 0.165 / 0.3 / 0.435 m, y" in str(position)
    assert "Set EKF2_EVV_NOISE to 0.011" in velocity.advice
    assert "Set EKF2_EVA_NOISE to 0.06" in yaw.advice


def test_fusioncore_floors_a_pose_and_replaces_what_holds_a_zero(odometry: list[Odometry]) -> None:
    """vslam_pose_noise_matrix in fusioncore_core/include/fusioncore/sensors/vslam.hpp."""
    C = np.diag([4.0, 1e-6, 9.0, 1e-8, 0.25, 0.16])
    np.testing.assert_allclose(consumers.fusioncore_sigmas(C), [2.0, 0.01, 3.0, 0.001, 0.5, 0.4])
    C[4, 4] = 0.0
    np.testing.assert_allclose(consumers.fusioncore_sigmas(C), [2.0, 0.01, 3.0, 0.02, 0.02, 0.02])
    C[2, 2] = 0.0
    np.testing.assert_allclose(consumers.fusioncore_sigmas(C), [0.1, 0.1, 0.1, 0.02, 0.02, 0.02])
    sharp = [replace(o, twist_covariance=np.eye(6), pose_covariance=np.eye(6) * 1e-8) for o in odometry]
    twist, pose = check(sharp, "fusioncore")
    assert (twist.hidden_percent, pose.hidden_percent) == (0.0, 100.0)
    assert all(a.predicted_sigma == pytest.approx((1e-4, 1e-4, 1e-4)) for a in pose.axes)


def test_fusioncore_loses_what_lies_in_correlations(odometry: list[Odometry]) -> None:
    # Of vx, vy and the yaw rate, which encoder_callback of fusion_node.cpp reads, there is a combination whose sigma is
    # the root of 1 - correlation: less than half of what is taken for it from 0.75 on.
    for correlation, hidden in ((0.0, 0.0), (0.74, 0.0), (0.76, 100.0)):
        R = np.eye(6)
        R[0, 5] = R[5, 0] = correlation
        slanted = [replace(o, twist_covariance=R, pose_covariance=np.eye(6)) for o in odometry]
        assert [v.hidden_percent for v in check(slanted, "fusioncore")] == [hidden, 0.0]
    assert "use of the diagonal alone hides it in 100 %" in str(check(slanted, "fusioncore")[0])
    assert "send no zeros" in str(check(slanted, "fusioncore")[0])
