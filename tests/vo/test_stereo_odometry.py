"""The odometry on rendered images: precise where seeing is good, honest where it is not."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from gpvo.errors import CalibrationError, GpvoError, SourceError
from gpvo.geometry import se3
from gpvo.runner import RunSummary
from gpvo.sim.points import PointsFlight, simulate_points
from gpvo.types import ImuLog, Status, StereoFrame, TrackFrame, VoLog, VoRecord, frequent_reasons
from gpvo.vo.config import make_config, read_settings
from gpvo.vo.odometry import StereoOdometry

pytest.importorskip("numba", reason="images need the extra gpvo[sim]")
from rendered_clip import Clip, pinhole, render_clip, wander
from stereo_points import CAMERA, scene


@pytest.fixture(scope="module")
def clip() -> Clip:
    return render_clip(pinhole(480, 360), wander(16, seed=2))


def run(clip: Clip, frames: list[StereoFrame] | None = None, preset: str = "fast") -> list[VoRecord]:
    odometry = StereoOdometry(clip.camera, make_config(preset))
    return [odometry.step(f) for f in (clip.frames if frames is None else frames)]


def errors_mm(clip: Clip, records: list[VoRecord]) -> np.ndarray:
    T = VoLog(records, clip.camera).trajectory()
    est, true = se3.inverse(T[:-1]) @ T[1:], se3.inverse(clip.T_world_cam[:-1]) @ clip.T_world_cam[1:]
    return 1e3 * np.linalg.norm((se3.inverse(true) @ est)[:, :3, 3], axis=1)


def blank(frame: StereoFrame) -> StereoFrame:
    return replace(frame, left=np.zeros_like(frame.left), right=np.zeros_like(frame.right))


def test_fast_is_precise_and_says_ok(clip: Clip) -> None:
    records = run(clip)
    assert records[0].status is Status.START
    assert all(r.status is Status.OK for r in records[1:])
    step_mm = 1e3 * np.median(np.linalg.norm(np.diff(clip.T_world_cam[:, :3, 3], axis=0), axis=1))
    assert np.median(errors_mm(clip, records)) < 0.06 * step_mm
    for r in records[1:]:
        assert set(r.covariances) == {"triangulation", "pointing_matching"}
        assert all(np.linalg.eigvalsh(C)[0] > 0 for C in r.covariances.values())
        assert 0 < r.n_inliers <= r.n_tracked <= 300


def test_thesis_runs_and_is_coarser(clip: Clip) -> None:
    thesis = run(clip, preset="thesis")
    assert all(r.usable for r in thesis[1:])
    assert all(r.is_reference for r in thesis)
    assert np.median(errors_mm(clip, thesis)) > np.median(errors_mm(clip, run(clip)))


def test_same_input_same_output(clip: Clip) -> None:
    for a, b in zip(run(clip), run(clip), strict=True):
        np.testing.assert_array_equal(a.T_prev_cur, b.T_prev_cur)


@pytest.mark.parametrize("preset", ["fast", "thesis"])
def test_black_frames_are_lost_and_then_it_recovers(clip: Clip, preset: str) -> None:
    frames = [blank(f) if k in (6, 7) else f for k, f in enumerate(clip.frames)]
    records = run(clip, frames, preset)
    assert [r.status for r in records[6:8]] == [Status.LOST] * 2
    assert "point" in records[6].reason
    assert not records[6].is_reference
    after = records[8]
    assert after.usable
    assert after.t_prev_ns == clip.frames[5].t_ns
    T_true = se3.inverse(clip.T_world_cam[5]) @ clip.T_world_cam[8]
    assert np.linalg.norm((se3.inverse(T_true) @ after.T_prev_cur)[:3, 3]) < (
        0.05 if preset == "fast" else 0.3
    ) * np.linalg.norm(T_true[:3, 3])
    sigma_lost, sigma_ok = (np.sqrt(np.trace(records[k].covariances["triangulation"][:3, :3])) for k in (6, 5))
    assert sigma_lost > 3 * sigma_ok


def test_a_frozen_picture_is_no_standstill(clip: Clip) -> None:
    frames = [replace(clip.frames[5], t_ns=f.t_ns) if k in (6, 7) else f for k, f in enumerate(clip.frames)]
    records = run(clip, frames)
    assert [r.status for r in records[6:8]] == [Status.LOST] * 2
    assert "frozen" in records[6].reason
    assert records[8].usable
    assert records[8].t_prev_ns == clip.frames[5].t_ns


def test_standing_still_does_not_drift(clip: Clip) -> None:
    """Sixty noisy images from one place: pose and stated sigma stay where they were."""
    still = render_clip(clip.camera, np.repeat(clip.T_world_cam[:1], 60, axis=0), noise_sigma=0.01)
    records = run(still)
    assert all(r.status is Status.OK for r in records[1:])
    assert sum(r.is_reference for r in records) <= 2
    assert np.linalg.norm(VoLog(records, still.camera).trajectory()[-1, :3, 3]) < 2e-3


def test_the_imu_of_a_record_is_of_the_motion_from_its_reference(clip: Clip) -> None:
    """While one reference is kept, its first motion spans many frames, and so do mean and spread of the IMU."""
    still = [clip.frames[0]] * 20
    odometry = StereoOdometry(clip.camera)
    rng = np.random.default_rng(0)
    since, longest_s = [], 0.0
    for k, frame in enumerate([*still, *clip.frames[1:4]]):
        gyro, acc = rng.standard_normal((2, 10, 3))
        t_ns = k * 50_000_000
        imu = ImuLog(t_ns - np.arange(10)[::-1] * 1_000_000, gyro, acc)
        record = odometry.step(replace(frame, t_ns=t_ns), imu)
        since = [*since, np.hstack([gyro, acc])] if k else []
        if k == 0:
            continue
        seen = np.concatenate(since)
        assert len(seen) == 10 * round(record.dt_s / 0.05)
        np.testing.assert_allclose(np.r_[record.imu_gyro_mean_radps, record.imu_acc_mean_mps2], seen.mean(0))
        np.testing.assert_allclose(np.r_[record.imu_gyro_std_radps, record.imu_acc_std_mps2], seen.std(0))
        longest_s = max(longest_s, record.dt_s)
        if record.is_reference:
            since = []
    assert longest_s > 0.9


@pytest.mark.parametrize("seed", [5, 7, 8, 11, 12])
def test_after_a_cut_it_is_right_or_lost(clip: Clip, seed: int) -> None:
    """A jump of 1.8 to 5.3 m: where the views overlap the motion is found, and true; where they do not, lost."""
    far = render_clip(clip.camera, wander(4, seed=seed))
    frames = clip.frames[:6] + [replace(f, t_ns=clip.frames[6 + k].t_ns) for k, f in enumerate(far.frames)]
    records = run(clip, frames)
    cut = records[6]
    T_true = se3.inverse(clip.T_world_cam[5]) @ far.T_world_cam[0]
    turn_rad = np.linalg.norm(se3.log(T_true)[3:])
    assert cut.usable == (turn_rad < 0.5)  # 9 to 17 deg, or 121 and 149
    if cut.usable:
        error = se3.log(se3.inverse(T_true) @ cut.T_prev_cur)
        assert error @ np.linalg.solve(cut.covariances["triangulation"], error) < 22.5  # 99.9 % of chi-square, 6 dof
    assert records[9].status is Status.OK


@pytest.mark.parametrize("size", [(64, 48), (24, 16)])
def test_tiny_pictures_are_no_error(size: tuple[int, int]) -> None:
    """Smaller than a block of the matcher: then there is nothing to see, which a record says."""
    tiny = render_clip(pinhole(*size), wander(3, seed=2))
    assert all(r.status in (Status.LOST, Status.OK, Status.DEGRADED) for r in run(tiny)[1:])


def test_few_points_and_far_points_are_doubted(clip: Clip) -> None:
    rng = np.random.default_rng(0)

    def tracks(t_ns: int, count: int, disparity: float, spread: float) -> TrackFrame:
        uv = clip.camera.K[:2, 2] + spread * grid[:count]
        uv = uv + 0.1 * rng.standard_normal(uv.shape)
        right = uv - [disparity, 0] + 0.1 * rng.standard_normal(uv.shape)
        return TrackFrame(t_ns, np.arange(count), uv, right)

    grid = rng.uniform(-100, 100, (200, 2))
    for count, disparity, spread, word in ((12, 20.0, 1.0, "points agree"), (100, 20.0, 0.08, "small part")):
        odometry = StereoOdometry(clip.camera)
        odometry.step(tracks(0, count, disparity, spread))
        record = odometry.step(tracks(10**8, count, disparity, spread))
        assert record.status is Status.DEGRADED
        assert word in record.reason
    odometry = StereoOdometry(clip.camera)
    odometry.step(tracks(0, 9, 1.2, 0.3))
    record = odometry.step(tracks(10**8, 9, 1.2, 0.3))
    assert record.status is not Status.OK


def test_points_too_far_away_are_named() -> None:
    """A camera that looks down from 60 m, its baseline a tenth of a metre: half a pixel of disparity."""
    rng = np.random.default_rng(0)
    _, before, after = scene(rng, 200, (0.4, 0.6))
    odometry = StereoOdometry(CAMERA)
    records = [
        odometry.step(TrackFrame(k * 100_000_000, np.arange(200), uvd[:, :2], uvd[:, :2] - uvd[:, 2:] * [1.0, 0.0]))
        for k, uvd in enumerate((before, after))
    ]
    assert records[1].status is Status.LOST
    assert re.fullmatch(r"only \d of \d+ points are near enough to show .* \(disparity over 1 px\)", records[1].reason)


@pytest.mark.parametrize("preset", ["fast", "thesis"])
def test_a_driver_may_write_the_next_pair_into_the_same_memory(clip: Clip, preset: str) -> None:
    """It saw each image in place of the one before: no motion at all, and was sure of it."""
    both = np.empty((clip.camera.height, 2 * clip.camera.width), np.uint8)
    odometry = StereoOdometry(clip.camera, make_config(preset))
    for frame, wanted in zip(clip.frames[:4], run(clip, clip.frames[:4], preset), strict=True):
        both[:] = np.hstack([frame.left, frame.right])
        got = odometry.step(StereoFrame(frame.t_ns, *np.hsplit(both, 2)))
        np.testing.assert_array_equal(got.T_prev_cur, wanted.T_prev_cur)


def test_refuses_what_it_cannot_mean(clip: Clip) -> None:
    odometry = StereoOdometry(clip.camera)
    odometry.step(clip.frames[0])
    with pytest.raises(SourceError, match="not later"):
        odometry.step(clip.frames[0])
    small = replace(clip.frames[1], left=clip.frames[1].left[:100])
    with pytest.raises(SourceError, match="the camera takes"):
        odometry.step(small)
    seconds = replace(clip.frames[1], t_ns=clip.frames[1].t_ns * 1e-9)  # type: ignore[arg-type]
    with pytest.raises(SourceError, match=r"no whole number \(give whole nanoseconds"):
        odometry.step(seconds)
    for per_s in (1, 1000, 10**6):  # two frames by arrival may come at once
        in_another_unit, step = StereoOdometry(clip.camera), round(0.05 * per_s) or 1
        for k in range(2):
            in_another_unit.step(replace(clip.frames[k], t_ns=10**9 * per_s + k * step))
        with pytest.raises(SourceError, match=r"follow too fast \(give whole nanoseconds, not seconds, ms or us"):
            in_another_unit.step(replace(clip.frames[2], t_ns=10**9 * per_s + 2 * step))
    with pytest.raises(CalibrationError, match="rows before columns"):
        StereoOdometry(clip.camera, mask=np.ones((clip.camera.width, clip.camera.height), bool))
    for wrong in ({"preset": "best"}, {"nonsense": 1}, {"methods": ("magic",)}, {"sigma_px": -1.0}):
        with pytest.raises(GpvoError):
            make_config(**wrong)  # type: ignore[arg-type]


def test_settings_are_read_from_text() -> None:
    read = read_settings(
        ["klt_window_px=21", "sigma_p_px=auto", "self_calibration=off", "methods=spherical, triangulation"]
    )
    assert read == {
        "klt_window_px": 21,
        "sigma_p_px": None,
        "self_calibration": False,
        "methods": ("spherical", "triangulation"),
    }
    assert make_config(**read).klt_window_px == 21
    slow = make_config(max_acceleration_mps2=0.01, max_turn_radps2=0.02).vehicle
    assert (slow.max_acceleration_mps2, slow.max_turn_radps2) == (0.01, 0.02)


@pytest.mark.parametrize(
    "text", ["nonsense=1", "seed", "seed=x", "min_inliers=3", "sigma_px=nan", "self_calibration=2"]
)
def test_bad_settings_are_refused(text: str) -> None:
    with pytest.raises(GpvoError, match=text.split("=")[0][:6]):
        make_config(**read_settings([text]))


def fly(flight: PointsFlight, method: str, **settings: object) -> tuple[list[float], list[Status]]:
    """NEES per degree of freedom of the usable motions, and the status of all."""
    cuts = np.searchsorted(flight.frame, np.arange(len(flight.t_s) + 1))
    odometry = StereoOdometry(flight.scenario.camera, make_config(**settings))
    scores, statuses, index = [], [], {}
    for k, (a, b) in enumerate(pairwise(cuts)):
        t_ns = round(flight.t_s[k] * 1e9) + 1
        index[t_ns] = k
        record = odometry.step(TrackFrame(t_ns, flight.track[a:b], flight.uv_left[a:b], flight.uv_right[a:b]))
        if record.usable and k > 0:
            T_true = se3.inverse(flight.T_world_cam[index[record.t_prev_ns]]) @ flight.T_world_cam[k]
            e = se3.log(se3.inverse(T_true) @ record.T_prev_cur)
            scores.append(e @ np.linalg.solve(record.covariances[method], e) / 6)
        statuses.append(record.status)
    return scores, statuses


def test_a_scene_of_few_landmarks_recovers() -> None:
    """Twelve tracks, dark for half a second: most motions are found, and the pixel noise of 0.25 px states them."""
    flight = simulate_points("room-t265", 0, duration_s=20.0, rate_hz=10.0, tracks=12, drop=0.2, dark=(8.0, 8.5))
    scores, statuses = fly(flight, "triangulation", min_inliers=4, sigma_px=0.25)
    assert statuses.count(Status.LOST) < 0.1 * len(statuses)
    assert 0.5 < np.median(scores) < 2.0


@pytest.mark.parametrize("sigma_px", [0.5, 1.0, 2.0])
def test_tolerances_grow_with_the_noise(sigma_px: float) -> None:
    """Tolerances of 2 and 4 px fit ordinary noise; what follows points to 2 px needs wider ones."""
    flight = simulate_points("tunnel-noise", 1, duration_s=10.0, sigma_px=sigma_px)
    scores, statuses = fly(flight, "pointing_matching", sigma_p_px=None, sigma_m_px=None)
    assert statuses.count(Status.OK) > 0.9 * len(statuses)
    assert 0.5 < np.mean(scores[15:]) < 1.5


def test_sigmas_follow_the_residuals(clip: Clip) -> None:
    """With sigma_p and sigma_m left open, the stated covariance follows the images' noise."""
    noisy = render_clip(clip.camera, clip.T_world_cam, noise_sigma=0.05)
    sizes = []
    for source in (clip, noisy):
        odometry = StereoOdometry(clip.camera, make_config(sigma_p_px=None, sigma_m_px=None))
        records = [odometry.step(f) for f in source.frames]
        sizes.append(np.trace(records[-1].covariances["pointing_matching"]))
    assert sizes[1] > 2 * sizes[0]


@pytest.mark.parametrize("length_m, told", [(0.0196, "0.0196 m"), (31.04, "31.0 m")])
def test_a_short_path_is_not_called_none(length_m: float, told: str) -> None:
    assert told in str(RunSummary(61, {}, length_m, 12.0, ""))


def test_the_reasons_of_many_motions_are_told_without_their_numbers() -> None:
    few = [f"only {k} of {2 * k} points agree; translation uncertain by 1.{k}e-05 m" for k in range(9, 12)]
    frozen = ["frozen image"] * 2
    told = ["only N of N points agree (3)", "translation uncertain by N m (3)", "frozen image (2)"]
    assert sorted(frequent_reasons([*few, *frozen, "", "dark"])) == sorted(told)
    assert frequent_reasons([*few, *[""] * 57]) == []
