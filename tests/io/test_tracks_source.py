"""Stereo tracks from .npz."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
from gpvo.errors import CalibrationError, GpvoError, SourceError
from gpvo.geometry import se3
from gpvo.geometry.se3 import R_FLU_OPTICAL
from gpvo.io import guess, open_source
from gpvo.types import StereoCamera

CAMERA = StereoCamera(700.0, 700.0, 600.0, 180.0, 0.5, 1201, 361)


def arrays(n: int = 6, m: int = 20) -> dict[str, np.ndarray]:
    """Points before a camera that drives forward; the rows are shuffled, frame 3 has none."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-4, -1, 8], [4, 1, 30], size=(m, 3))
    T = se3.exp(np.outer(np.arange(n), [0.0, 0, 0.8, 0, 0.01, 0]))
    rows = []
    for k in range(n):
        if k == 3:
            continue
        uvd = CAMERA.project(se3.transform(se3.inverse(T[k]), points))
        rows += [(k, i, *uvd[i, :2], uvd[i, 0] - uvd[i, 2], uvd[i, 1]) for i in range(m)]
    table = rng.permutation(np.array(rows))
    return {
        "frame": table[:, 0].astype(np.int32),
        "track": table[:, 1].astype(np.int32),
        "uv_left": table[:, 2:4].astype(np.float32),
        "uv_right": table[:, 4:6].astype(np.float32),
        "t_s": np.arange(n) * 0.1,
        "fx": np.float64(700.0),
        "fy": np.float64(700.0),
        "cx": np.float64(600.0),
        "cy": np.float64(180.0),
        "baseline_m": np.float64(0.5),
        "T_world_cam": T,
        "gyro_body_radps": rng.normal(size=(n, 3)),
        "R_cam_body": R_FLU_OPTICAL.T,
        "p_body_cam_in_body_m": np.array([1.1, 0.3, 0.7]),
    }


def save(path, data):
    np.savez(path, **data)
    return path


def test_frames_and_what_lies_beside(tmp_path):
    data = arrays()
    path = save(tmp_path / "a.npz", data)
    assert guess(path) == "tracks"
    source = open_source(path)
    assert (source.kind, len(source), source.name) == ("tracks", 6, "a")
    frames = list(source)
    assert [len(f.track) for f in frames] == [20, 20, 20, 0, 20, 20]
    assert [f.t_ns for f in frames] == [k * 100_000_000 for k in range(6)]
    for k, frame in enumerate(frames):
        mine = data["frame"] == k
        order, theirs = np.argsort(frame.track), np.argsort(data["track"][mine])
        np.testing.assert_array_equal(frame.uv_left[order], data["uv_left"][mine][theirs])
        np.testing.assert_array_equal(frame.uv_right[order], data["uv_right"][mine][theirs])
    assert source.camera.width >= CAMERA.width
    np.testing.assert_allclose(source.mounting.T_body_cam[:3, :3], R_FLU_OPTICAL)
    np.testing.assert_allclose(source.mounting.T_imu_cam[:3, 3], [1.1, 0.3, 0.7])
    np.testing.assert_array_equal(source.imu.gyro_radps, data["gyro_body_radps"])
    assert np.isnan(source.imu.acc_mps2).all()
    np.testing.assert_allclose(source.truth.T_world_cam, data["T_world_cam"], atol=1e-12)
    assert source.truth.sigma_translation_m == 3e-3


def test_optional_arrays(tmp_path):
    data = arrays()
    for key in ("T_world_cam", "gyro_body_radps", "R_cam_body", "p_body_cam_in_body_m"):
        del data[key]
    source = open_source(save(tmp_path / "a.npz", data))
    assert source.truth is None
    assert source.imu is None
    assert source.mounting.T_body_cam is None
    data = {**arrays(), "acc_body_mps2": np.ones((6, 3)), "width": 1300, "height": 400}
    data |= {"sigma_translation_m": np.float64(0.0), "sigma_rotation_rad": np.float64(0.0)}
    source = open_source(save(tmp_path / "b.npz", data))
    assert np.isfinite(source.imu.acc_mps2).all()
    assert (source.camera.width, source.camera.height) == (1300, 400)
    assert source.truth.sigma_translation_m == 0.0


def test_the_velocity_of_the_camera_is_that_of_the_body_and_its_turning(tmp_path):
    data = arrays()
    # The path is driven at 8 m/s while turning at 0.1 rad/s, both in axes of the camera.
    gyro = R_FLU_OPTICAL @ [0.0, 0.1, 0.0]
    body = R_FLU_OPTICAL @ [0.0, 0.0, 8.0] - np.cross(gyro, data["p_body_cam_in_body_m"])
    data |= {"gyro_body_radps": np.tile(gyro, (6, 1)), "vel_body_mps": np.tile(body, (6, 1))}
    truth = open_source(save(tmp_path / "a.npz", data)).truth
    np.testing.assert_allclose(
        truth.v_world_mps[1:-1], np.gradient(truth.T_world_cam[:, :3, 3], 0.1, axis=0)[1:-1], atol=1e-3
    )
    del data["gyro_body_radps"]
    assert open_source(save(tmp_path / "b.npz", data)).truth.v_world_mps is None


@pytest.mark.parametrize("start_s", [0.0, 1.7e9])
@pytest.mark.parametrize("factor", [1e3, 1e6, 1e9])
def test_stamps_in_another_unit_are_refused_with_the_factor(tmp_path, start_s, factor):
    data = arrays()
    data["t_s"] = (start_s + data["t_s"] * 3) * factor
    np.savez(tmp_path / "t.npz", **data)
    with pytest.raises(SourceError, match=f"divide it by {int(factor):,}"):
        open_source(tmp_path / "t.npz")


def test_stamps_with_disorder(tmp_path):
    data = arrays()
    data["t_s"] = np.array([0.0, 0.1, 0.1, 0.3, 0.25, 0.5])
    source = open_source(save(tmp_path / "a.npz", data))
    assert [f.t_ns // 10**6 for f in source] == [0, 100, 250, 500]
    assert (source.report.duplicate, source.report.out_of_order) == (1, 1)
    assert (np.diff(source.truth.t_ns) > 0).all()


def test_truth_with_dropouts(tmp_path):
    data = arrays()
    data["T_world_cam"][[0, 3]] = np.nan
    data["T_world_cam"][3, 3] = [0, 0, 0, 1]
    truth = open_source(save(tmp_path / "a.npz", data)).truth
    assert (truth.t_ns // 10**8).tolist() == [1, 2, 4, 5]
    np.testing.assert_allclose(truth.T_world_cam, data["T_world_cam"][[1, 2, 4, 5]], atol=1e-12)


def _poses_with(row: np.ndarray) -> np.ndarray:
    T = arrays()["T_world_cam"]
    T[2] = row
    return T


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"frame": None}, "lacks frame"),
        ({"uv_left": np.zeros((100, 3))}, r"'uv_left' has shape \(100, 3\), expected \(100, 2\)"),
        ({"frame": np.full(100, 7)}, "'frame' goes up to 7"),
        ({"t_s": np.array([0, 1, 2, np.nan, 4, 5])}, "'t_s' is NaN or infinite at row 3"),
        ({"T_world_cam": np.full((6, 4, 4), np.nan)}, "'T_world_cam' is NaN"),
        ({"T_world_cam": _poses_with(np.zeros((4, 4)))}, "'T_world_cam' row 2 is not a rigid transform"),
        ({"T_world_cam": _poses_with(np.diag([2.0, 2.0, 2.0, 1.0]))}, "row 2 is not a rigid transform"),
        ({"T_world_cam": _poses_with(np.diag([1.0, 1.0, np.nan, 1.0]))}, "row 2 holds a number that is not finite"),
        ({"R_cam_body": np.zeros((3, 3))}, "R_cam_body is not a rigid transform"),
        ({"uv_right": np.array([["a", "b"]] * 100)}, "not numbers"),
        ({"baseline_m": np.float64(-0.5)}, "left and right are swapped"),
        ({"fx": np.float64(-1)}, "focal lengths"),
    ],
)
def test_bad_tracks_in_one_line(tmp_path, change, reason):
    data = {k: v for k, v in {**arrays(), **change}.items() if v is not None}
    path = save(tmp_path / "a.npz", data)
    with pytest.raises((SourceError, CalibrationError), match=reason) as caught:
        open_source(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_pickle_and_no_bomb(tmp_path, monkeypatch):
    path = save(tmp_path / "a.npz", {**arrays(), "fx": np.array([{"evil": 1}], dtype=object)})
    with pytest.raises(SourceError, match="not readable"):
        open_source(path)
    monkeypatch.setattr("gpvo.io.tracks._MAX_UNPACKED_BYTES", 1000)
    with pytest.raises(SourceError, match="too large for tracks"):
        open_source(save(tmp_path / "b.npz", arrays()))


@pytest.mark.parametrize("how", ["cut", "rubbish", "zip", "deflated"])
def test_damaged_file(tmp_path, how):
    path = save(tmp_path / "a.npz", arrays())
    raw = path.read_bytes()
    if how == "zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("frame.npy", b"no array")
    elif how == "deflated":
        np.savez_compressed(path, **arrays())
        raw = bytearray(path.read_bytes())
        raw[70:90] = b"\xff" * 20  # behind the header of the first array
        path.write_bytes(raw)
    else:
        path.write_bytes(raw[: len(raw) // 2] if how == "cut" else b"rubbish" * 100)
    with pytest.raises(GpvoError) as caught:
        open_source(path)
    assert "\n" not in str(caught.value)


def test_real_tracks(real_data):
    files = sorted((real_data / "tracks").glob("*.npz"))
    assert len(files) == 6
    total = 0
    for file in files:
        source = open_source(file)
        frames = list(source)
        total += len(frames)
        assert source.report.frames == len(source) == len(frames)
        # Points lie before the camera.
        d = np.concatenate([f.uv_left[:, 0] - f.uv_right[:, 0] for f in frames])
        assert (d > 0).mean() > 0.99
    assert total == 1681
