"""Sequences from folders: pairing, damage, truth, and what is refused."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import sequences as seq
from bag_maker import stereo_bag
from gpvo.cameras.readers import read_kitti_calib
from gpvo.cameras.rectify import rectifying_rotations
from gpvo.errors import CalibrationError, GpvoError, SourceError
from gpvo.geometry import se3
from gpvo.io import guess, open_source
from gpvo.io.images import is_mosaic, smooth_mosaic
from gpvo.io.source import Depth, Source, source_kinds
from gpvo.vo.rig_findings import camchain

MAKERS = {"euroc": seq.write_euroc, "kitti": seq.write_kitti, "folder": seq.write_folder}


@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.parametrize("prefetch", [True, False])
def test_every_frame_comes_once_and_in_order(tmp_path, kind, prefetch):
    path = MAKERS[kind](tmp_path / "s")
    assert guess(path) == kind
    source = open_source(path, prefetch=prefetch)
    assert isinstance(source, Source)
    assert (source.format, source.kind, len(source)) == (kind, "images", 12)
    assert source.camera.baseline_m == pytest.approx(0.1)
    frames = seq.frames_of(source)
    assert [k for _, k in frames] == list(range(12))
    assert str(source.report) == "12 frames"
    # And once more, with a fresh report.
    assert seq.frames_of(source) == frames
    assert source.report.frames == 12


@pytest.mark.parametrize("kind", MAKERS)
def test_missing_and_unreadable_images_shift_nothing(tmp_path, kind):
    path = MAKERS[kind](tmp_path / "s", 24)
    folders = {"euroc": ("mav0/cam0/data", "mav0/cam1/data"), "kitti": ("image_0", "image_1")}
    left, right = [path / f for f in folders.get(kind, ("left", "right"))]
    name = sorted(p.name for p in left.iterdir())
    (left / name[2]).unlink()
    (right / name[4]).unlink()
    (left / name[6]).write_bytes(b"no image")
    (right / name[7]).write_bytes((right / name[7]).read_bytes()[:40])
    seq.write_image(left / name[9], np.zeros((10, 10), np.uint8))
    source = open_source(path)
    frames = seq.frames_of(source)
    assert [k for _, k in frames] == [0, 1, 3, 5, 8, *range(10, 24)]
    step = frames[1][0] - frames[0][0]
    assert [round((t - frames[0][0]) / step) for t, _ in frames] == [k for _, k in frames]
    report = source.report
    assert (report.missing, report.unreadable, report.frames) == (2, 3, 19)
    assert report.gaps == 4
    assert report.notes


def test_euroc_lists_with_every_disorder(tmp_path):
    path = seq.write_euroc(tmp_path / "s")
    t = seq.stamps(12)
    lists = {c: path / "mav0" / c / "data.csv" for c in ("cam0", "cam1")}
    # Left: 5 before 4, 7 twice, one far in the future. Right: 3 not listed, one line of rubbish.
    order = [0, 1, 2, 3, 5, 4, 6, 7, 7, 8, 9, 10, 11]
    future = t[0] + 10**15
    shutil.copy(path / f"mav0/cam0/data/{t[0]}.png", path / f"mav0/cam0/data/{future}.png")
    left = [f"{t[k]},{t[k]}.png" for k in order]
    left.insert(10, f"{future},{future}.png")
    lists["cam0"].write_text("#head\n" + "\n".join(left) + "\n")
    right = [f"{t[k]},{t[k]}.png" for k in range(12) if k != 3] + ["rubbish", "12,../../../etc/passwd"]
    lists["cam1"].write_text("\n".join([*right, f"{future},{future}.png"]) + "\n")
    shutil.copy(path / f"mav0/cam0/data/{future}.png", path / f"mav0/cam1/data/{future}.png")
    source = open_source(path)
    assert seq.frames_of(source) == [*((t[k], k) for k in (0, 1, 2, 4, 5, 6, 7, 8, 9, 10, 11)), (future, 0)]
    report = source.report
    assert (report.duplicate, report.out_of_order, report.missing, report.unreadable) == (1, 0, 1, 2)
    assert report.gaps == 2
    assert "cam0/data.csv is not in time order: sorted by stamp" in report.notes


def test_euroc_lists_and_imu_in_any_order(tmp_path):
    path = seq.write_euroc(tmp_path / "s", 40)
    for camera in ("cam0", "cam1"):
        file = path / "mav0" / camera / "data.csv"
        head, *lines = file.read_text().splitlines()
        file.write_text("\n".join([head, *np.random.default_rng(0).permutation(lines)]))
    imu = path / "mav0" / "imu0" / "data.csv"
    lines = imu.read_text().splitlines()
    imu.write_text("\n".join([*lines[:7], lines[3], lines[6], *lines[7:]]))
    source = open_source(path)
    assert [k for _, k in seq.frames_of(source)] == list(range(40))
    assert source.report.notes[:2] == [f"cam{i}/data.csv is not in time order: sorted by stamp" for i in (0, 1)]
    assert "2 of 402 IMU samples repeat or go back in time: dropped" in source.report.notes
    assert len(source.imu.t_ns) == 400


def _delay_the_right(path, kind: str, delay_ns: int) -> None:
    if kind == "folder":
        for file in (path / "right").iterdir():
            file.rename(file.with_stem(str(int(file.stem) + delay_ns)))
        return
    lines = [f"{t + delay_ns},{t}.png" for t in seq.stamps(12) if t != seq.stamps(12)[5]]
    (path / "mav0/cam1/data.csv").write_text("\n".join(lines))


@pytest.mark.parametrize("kind", ["euroc", "folder"])
def test_the_right_camera_a_little_late(tmp_path, kind):
    path = MAKERS[kind](tmp_path / "s")
    _delay_the_right(path, kind, 1_500_000)
    source = open_source(path)
    expected = [(t, k) for k, t in enumerate(seq.stamps(12)) if kind == "folder" or k != 5]
    assert seq.frames_of(source) == expected
    assert source.report.missing == 12 - len(expected)
    with pytest.raises(SourceError, match=r"no pair within 1 ms; the nearest are 1\.5 ms apart") as caught:
        open_source(path, tolerance_s=1e-3)
    assert "--pair-tolerance" in _one_line(caught)
    # However much is allowed, each image has one partner.
    assert seq.frames_of(open_source(path, tolerance_s=1.0)) == expected


def test_kitti_times_with_disorder(tmp_path):
    path = seq.write_kitti(tmp_path / "s")
    times = [0.0, 0.1, 0.2, 0.2, 0.4, 99.0, 0.6, 0.7, 0.65, 0.9, 1.0, 1.1]
    (path / "times.txt").write_text("".join(f"{t}\n" for t in times))
    source = open_source(path)
    assert [k for _, k in seq.frames_of(source)] == [0, 1, 2, 4, 6, 8, 9, 10, 11]
    assert (source.report.duplicate, source.report.out_of_order) == (1, 2)


def test_kitti_names_that_only_look_like_numbers_are_left_out(tmp_path):
    path = seq.write_kitti(tmp_path / "s", poses=False)
    shutil.copy(path / "image_0" / "000000.png", path / "image_0" / "\u00b2.png")
    assert len(seq.frames_of(open_source(path))) == 12


def test_numbers_that_count_no_frames_are_refused(tmp_path):
    path = seq.write_folder(tmp_path / "s")
    for side in ("left", "right"):
        for k, file in enumerate(sorted((path / side).iterdir())):
            file.rename(file.with_name(f"{k}_a.png" if k else f"{'9' * 25}_a.png"))
    with pytest.raises(SourceError, match=r"s: the image names hold numbers too large"):
        open_source(path, rate_hz=10.0)


@pytest.mark.parametrize("kind", ["euroc", "folder"])
@pytest.mark.parametrize("seconds", [float("nan"), float("inf"), -0.1, 11.0])
def test_a_tolerance_that_is_none_is_refused(tmp_path, kind, seconds):
    with pytest.raises(SourceError, match="stamps of a pair cannot differ by .* takes 0 to 10"):
        open_source(MAKERS[kind](tmp_path / "s"), tolerance_s=seconds)


def test_kitti_more_images_than_times(tmp_path):
    path = seq.write_kitti(tmp_path / "s", poses=False)
    (path / "times.txt").write_text("".join(f"{k * 0.1}\n" for k in range(9)))
    source = open_source(path)
    assert len(seq.frames_of(source)) == 9
    assert source.report.missing == 3


def test_kitti_colour_and_poses_beside_the_sequences(tmp_path):
    path = seq.write_kitti(tmp_path / "sequences" / "07", folders=("image_2", "image_3"))
    (tmp_path / "poses").mkdir()
    shutil.move(path / "poses.txt", tmp_path / "poses" / "07.txt")
    source = open_source(path)
    assert len(source) == 12
    # Camera 2 sits 5 cm to the left of camera 0, whose poses these are.
    offset = se3.exp(np.array([-0.05, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(source.truth.T_world_cam, seq.true_poses(12) @ offset, atol=1e-5)
    assert source.truth.sigma_translation_m == 3e-3


def test_kitti_with_a_corrected_calibration(tmp_path):
    path = seq.write_kitti(tmp_path / "s", folders=("image_2", "image_3"))
    T_right_left = se3.exp(np.array([-0.1, 0.0, 0.0, 0.01, 0.02, 0.03]))
    rig = read_kitti_calib(path / "calib.txt", left=2, right=3, size=(seq.WIDTH, seq.HEIGHT))
    (tmp_path / "kc.yaml").write_text(camchain(replace(rig, T_right_left=T_right_left)))
    source = open_source(path, calibration=tmp_path / "kc.yaml")
    assert len(seq.frames_of(source)) == 12
    T_cam0_left = se3.exp(np.array([-0.05, 0, 0, 0, 0, 0]))
    T_left_cam = se3.from_rt(rectifying_rotations(T_right_left)[0].T, np.zeros(3))
    np.testing.assert_allclose(source.truth.T_world_cam, seq.true_poses(12) @ T_cam0_left @ T_left_cam, atol=1e-5)


def test_euroc_truth_is_of_the_rectified_left_camera(tmp_path):
    source = open_source(seq.write_euroc(tmp_path / "s"))
    assert source.truth is not None
    assert source.imu is not None
    expected = seq.true_poses(12) @ source.mounting.T_imu_cam
    np.testing.assert_allclose(source.truth.T_world_cam, expected, atol=1e-9)
    np.testing.assert_allclose(source.mounting.T_imu_cam, seq.T_BODY_LEFT, atol=1e-9)
    assert source.truth.sigma_translation_m == 0.0
    np.testing.assert_array_equal(source.imu.gyro_radps[0], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(source.imu.acc_mps2[0], [0, 0, 9.81])
    assert source.mounting.T_body_cam is None


def test_euroc_truth_without_the_place_of_the_imu(tmp_path):
    path = seq.write_euroc(tmp_path / "s")
    (tmp_path / "camchain.yaml").write_text(seq.camchain_yaml())
    source = open_source(path, calibration=tmp_path / "camchain.yaml")
    assert source.truth is None
    note = "ground truth not used: the calibration does not say where the IMU sits"
    assert source.report.notes.count(note) == 1
    list(source)
    assert source.report.notes.count(note) == 1
    assert note not in open_source(path).report.notes


def test_body_that_says_it_is_flu_and_stated_noise(tmp_path):
    path = seq.write_euroc(tmp_path / "s")
    (path / "mav0" / "body.yaml").write_text("comment: made\naxes: FLU\n")
    sensor = path / "mav0" / "state_groundtruth_estimate0" / "sensor.yaml"
    sensor.write_text("sigma_translation_m: 0.002\nsigma_rotation_rad: 0.001\n")
    source = open_source(path)
    np.testing.assert_allclose(source.mounting.T_body_cam, seq.T_BODY_LEFT, atol=1e-9)
    assert (source.truth.sigma_translation_m, source.truth.sigma_rotation_rad) == (0.002, 0.001)


def test_vicon_marker_and_leica(tmp_path):
    path = seq.write_euroc(tmp_path / "s", truth=False)
    (path / "mav0" / "leica0").mkdir()
    (path / "mav0" / "leica0" / "data.csv").write_text("#t,x,y,z\n1,2,3,4\n")
    assert open_source(path).truth is None
    assert any("leica0" in note for note in open_source(path).report.notes)
    seq.write_euroc_truth(path / "mav0" / "vicon0" / "data.csv", 12)
    T_body_marker = se3.exp(np.array([0.1, 0.0, 0.05, 0.0, 0.1, 0.0]))
    (path / "mav0" / "vicon0" / "sensor.yaml").write_text(seq.sensor_yaml(T_body_marker))
    source = open_source(path)
    expected = seq.true_poses(12) @ se3.inverse(T_body_marker) @ seq.T_BODY_LEFT
    np.testing.assert_allclose(source.truth.T_world_cam, expected, atol=1e-9)
    assert source.truth.sigma_rotation_rad == 8e-4


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("cam0", "cam1"),
        ("left/data", "right/data"),
        ("image_left", "image_right"),
        ("Left", "Right"),
        ("infra1", "infra2"),
        ("cam_0", "cam_1"),
        ("camera0", "camera1"),
        ("camera1", "camera2"),
        ("stereo_left", "stereo_right"),
        ("left_images/data", "right_images/data"),
        ("images-cam0", "images-cam1"),
    ],
)
def test_folder_names(tmp_path, left, right):
    path = seq.write_folder(tmp_path / "s", left=left, right=right)
    for empty in ("log_left", "log_right", "other"):
        (path / empty).mkdir()
    assert guess(path) == "folder"
    assert [k for _, k in seq.frames_of(open_source(path))] == list(range(12))


def test_a_hot_picture_takes_no_contrast_from_later_ones():
    depth, scene = Depth(), np.linspace(7300, 7600, 64 * 64).reshape(64, 64).astype(np.uint16)
    before, hot = depth.to8(scene), scene.copy()
    hot[:4] = 16383
    depth.to8(hot)
    np.testing.assert_array_equal(depth.to8(scene), before)


def test_pairs_of_images_are_read_before_folders_beside_them(tmp_path):
    for name in ("{0}_{1}", "mask_{1}/{0}"):
        for k in range(3):
            for side in ("left", "right"):
                image = seq.grey(k) if "mask" not in name else np.full_like(seq.grey(k), 255)
                seq.write_image(tmp_path / f"{name.format(k, side)}.png", image)
    (tmp_path / "camchain.yaml").write_text(seq.camchain_yaml())
    assert [k for _, k in seq.frames_of(open_source(tmp_path, rate_hz=20.0))] == [0, 1, 2]


def test_of_several_pairs_of_folders_none_is_guessed(tmp_path):
    for what in ("colour", "depth"):
        path = seq.write_folder(tmp_path / "s", left=f"{what}_left", right=f"{what}_right")
    with pytest.raises(SourceError, match="not recognised"):
        guess(path)


@pytest.mark.parametrize(
    "name", ["{1}_{0:04d}", "{1}{0:02d}", "{1}_frame_{0:04d}_color", "{0:04d}{1}", "frame_{0:d}-{1}", "{2}_{0:d}"]
)
def test_sides_at_either_end_of_the_names(tmp_path, name):
    for k in range(12):
        for side, camera in (("left", "cam0"), ("right", "cam1")):
            seq.write_image(tmp_path / f"{name.format(k, side, camera)}.png", seq.grey(k))
    (tmp_path / "camchain.yaml").write_text(seq.camchain_yaml())
    assert guess(tmp_path) == "folder"
    assert [k for _, k in seq.frames_of(open_source(tmp_path, rate_hz=20.0))] == list(range(12))
    (tmp_path / "times.txt").write_text("".join(f"{10 + 0.05 * k:.3f}\n" for k in range(12)))
    source = open_source(tmp_path, rate_hz=20.0)
    assert [k for _, k in seq.frames_of(source)] == list(range(12))
    assert "--rate-hz is not used: the stamps are those of times.txt" in source.report.notes


def test_numbers_count_on_although_names_differ_by_side(tmp_path):
    path = seq.write_folder(tmp_path / "s")
    for side in ("left", "right"):
        for k, file in enumerate(sorted((path / side).iterdir())):
            file.rename(file.with_stem(f"img{side == 'right':d}_{2 * k}"))
    assert [t for t, _ in seq.frames_of(open_source(path, rate_hz=20.0))] == [100_000_000 * k for k in range(12)]


@pytest.mark.parametrize("cameras", [(0, 1), (2, 3)])
@pytest.mark.parametrize("beside", [True, False])
def test_raw_drives_of_kitti(tmp_path, cameras, beside):
    """The calibration is that of the day."""
    drive = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    seq.write_kitti(drive, folders=[f"image_0{c}/data" for c in cameras], poses=False)
    text = (drive / "calib.txt").read_text().replace("P", "P_rect_0")
    size = "".join(f"S_rect_0{c}: {seq.WIDTH:e} {seq.HEIGHT:e}\n" for c in cameras)
    calib = (drive if beside else drive.parent) / "calib_cam_to_cam.txt"
    calib.write_text("calib_time: 09-Jan-2012 13:57:47\n" + size + text)
    for name in ("calib.txt", "times.txt"):
        (drive / name).unlink()
    for c in cameras:
        times = "".join(f"2011-09-26 13:02:{59 + k // 10:02d}.{k % 10}64389445\n" for k in range(10))
        (drive / f"image_0{c}" / "timestamps.txt").write_text(times + "2011-09-26 13:03:00.5\n2011-09-26 13:03:00.6\n")
    assert guess(drive) == "kitti"
    frames = seq.frames_of(open_source(drive))
    assert [k for _, k in frames] == list(range(12))
    assert frames[0][0] == 1_317_042_179_064_389_445
    calib.write_text(calib.read_text().replace("S_rect_00: 6.4", "S_rect_00: 9.2").replace("02: 6.4", "02: 9.2"))
    with pytest.raises(CalibrationError, match=r"for rectified images of 92x48, not 64x48 .*_sync"):
        open_source(drive)


def test_one_folder_with_sides_and_times(tmp_path):
    for k in range(12):
        for side in ("left", "right"):
            if (k, side) not in {(3, "left"), (8, "right")}:
                seq.write_image(tmp_path / f"frame_{k:04d}_{side}.png", seq.grey(k))
    (tmp_path / "camchain.yaml").write_text(seq.camchain_yaml())
    with pytest.raises(SourceError, match=r"no times\.txt"):
        open_source(tmp_path)
    assert [k for _, k in seq.frames_of(open_source(tmp_path, rate_hz=20.0))] == [0, 1, 2, 4, 5, 6, 7, 9, 10, 11]
    (tmp_path / "times.txt").write_text("".join(f"{10 + 0.05 * k:.3f}\n" for k in range(12)))
    source = open_source(tmp_path)
    frames = seq.frames_of(source)
    assert [k for _, k in frames] == [0, 1, 2, 4, 5, 6, 7, 9, 10, 11]
    assert [t for t, _ in frames] == [10_000_000_000 + 50_000_000 * k for _, k in frames]
    assert source.report.missing == 2
    # The last two frames without a line.
    (tmp_path / "times.txt").write_text("".join(f"{10 + 0.05 * k:.3f}\n" for k in range(10)))
    assert [k for _, k in seq.frames_of(open_source(tmp_path))] == [0, 1, 2, 4, 5, 6, 7, 9]


def _named(path, name):
    """The folder of 30 pairs with other names."""
    seq.write_folder(path, 30)
    for side in ("left", "right"):
        for k, file in enumerate(sorted((path / side).iterdir())):
            file.rename(file.with_stem(name(k)))
    return path


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (
            lambda k: f"2024-05-01_12-{30 + (k + 10) // 20}-{(570 + k) % 600 / 10:09.6f}",
            r"not stamps \(dates are not read",
        ),
        (lambda k: f"20240501_12{30 + (k + 10) // 20}{(570 + k) % 600 / 10:09.6f}", r"not stamps \(dates are not read"),
        (lambda k: f"20231114_2213{20 + k // 10}_{103 * k % 1000:03d}", r"not stamps \(dates are not read"),
        (lambda k: f"20231114_221320_{10 * k:03d}", r"not stamps \(dates are not read"),
        (lambda k: f"{1_700_000_000 + k // 10}_{k % 10 * 100}", "not stamps, and there is no"),
        (lambda k: f"{103 * k - k // 3}", "not stamps, and there is no"),
        (lambda k: f"frame_{k:04d}_v1.2", "not stamps, and there is no"),
        (lambda k: f"frame-{k:04d}-640x480", "not stamps, and there is no"),
    ],
)
def test_numbers_in_names_that_are_no_stamps(tmp_path, name, reason):
    path = _named(tmp_path / "s", name)
    with pytest.raises(SourceError, match=reason) as caught:
        open_source(path)
    assert "times.txt" in _one_line(caught)
    assert "or give --rate-hz" not in _one_line(caught)
    with pytest.raises(SourceError, match="does not count the images") as caught:
        open_source(path, rate_hz=10.0)
    assert name(0) in _one_line(caught)
    (path / "times.txt").write_text("".join(f"{10 + 0.1 * k:.3f}\n" for k in range(30)))
    assert [k for _, k in seq.frames_of(open_source(path))] == list(range(30))


def test_lines_of_times_by_order_or_by_number(tmp_path):
    path = _named(tmp_path / "s", lambda k: f"frame_{100 + k}")
    times = path / "times.txt"
    times.write_text("time\n" + "".join(f"{10 + 0.1 * k:.3f}\n" for k in range(30)))
    assert [k for _, k in seq.frames_of(open_source(path))] == list(range(30))
    times.write_text("".join(f"{10 + 0.1 * k:.3f}\n" for k in range(101)))
    with pytest.raises(SourceError, match=r"times.txt: holds 101 stamps for 30 images .give a line per pair"):
        open_source(path)
    times.write_text("".join(f"{10 + 0.1 * k:.3f}\n" for k in range(110)))
    source = open_source(path)
    assert [t for t, _ in seq.frames_of(source)] == [20_000_000_000 + 100_000_000 * k for k in range(10)]
    assert "20 images without a line in times.txt" in source.report.notes


@pytest.mark.parametrize("name", ["{:.6f}", "img_{:.6f}", "cam2_v1.2_{:.6f}"])
def test_names_in_seconds(tmp_path, name):
    path = _named(tmp_path / "s", lambda k: name.format(1_400_000_000 + 0.1 * k))
    source = open_source(path, rate_hz=10.0)
    assert len(seq.frames_of(source)) == 30
    assert source.report.notes == ["--rate-hz is not used: the stamps are the image names"]


def test_names_of_seconds_and_nanoseconds_without_leading_zeros(tmp_path):
    stamps = [divmod(1_700_000_000_012_345_678 + 103_000_000 * k, 10**9) for k in range(30)]
    path = _named(tmp_path / "s", lambda k: "{}.{:09d}".format(*stamps[k]))
    assert len(seq.frames_of(open_source(path))) == 30
    bad = _named(tmp_path / "b", lambda k: "{}.{}".format(*stamps[k]))
    with pytest.raises(SourceError, match=r"b: the fractions .* lack their leading zeros .*%d\.%09d") as caught:
        open_source(bad)
    _one_line(caught)


def test_imu_below_a_line_of_names(tmp_path):
    path = seq.write_folder(tmp_path / "s", 4)
    rows = "\n".join(f"{t},0.1,0,0,0,0,9.8" for t in seq.stamps(4))
    (path / "imu.csv").write_text(f"timestamp [ns],w_RS_S_x [rad s^-1],wy,wz,ax,ay,az\n{rows}")
    assert open_source(path).imu.gyro_radps[0, 0] == 0.1
    (path / "imu.csv").write_text(f"timestamp,accel_x,accel_y,accel_z,gx,gy,gz\n{rows}")
    with pytest.raises(SourceError, match="imu.csv: line 1: 'accel_x' comes before the gyroscope .put the columns"):
        open_source(path)


def test_imu_stamps_of_another_unit_are_refused(tmp_path):
    path = seq.write_folder(tmp_path / "s", 4)
    rows = [f"{t // 1000},0.1,0,0,0,0,9.8" for t in seq.stamps(4)]
    (path / "imu.csv").write_text("\n".join(rows))
    with pytest.raises(SourceError, match="imu.csv: the stamps look like microseconds.*nanoseconds"):
        open_source(path)


def test_folder_with_truth_and_imu(tmp_path):
    path = seq.write_folder(tmp_path / "s")
    euroc = seq.write_euroc(tmp_path / "e")
    shutil.copy(euroc / "mav0" / "imu0" / "data.csv", path / "imu.csv")
    from gpvo.io.trajectory import write_tum

    write_tum(path / "truth.tum", np.array(seq.stamps(12)), seq.true_poses(12))
    source = open_source(path)
    assert source.imu is not None
    np.testing.assert_allclose(source.truth.T_world_cam, seq.true_poses(12), atol=1e-8)


def test_sixteen_bit_images(tmp_path):
    path = seq.write_folder(tmp_path / "s", 4)
    for side in ("left", "right"):
        for k, file in enumerate(sorted((path / side).iterdir())):
            seq.write_image(file, seq.grey(k).astype(np.uint16) * 256)
    assert [k for _, k in seq.frames_of(open_source(path))] == [0, 1, 2, 3]
    for side in ("left", "right"):
        for k, file in enumerate(sorted((path / side).iterdir())):
            seq.write_image(file, seq.grey(k).astype(np.uint16) * 16)
    assert [k for _, k in seq.frames_of(open_source(path, bits=12))] == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("bits", "most", "doubt"),
    [
        (16, 1020, "reach only 1020: are these 10 bits"),
        (16, 4095, "reach only 4095: are these 12 bits"),
        (16, 4096, None),
        (12, 4095, None),
        (12, 1020, None),
        (12, 65520, "reach 65520, more than 12 bits hold"),
        (10, 4095, r"reach 4095, more than 10 bits hold: .* \(--bits 12\)"),
    ],
)
def test_depth_that_does_not_fit(tmp_path, bits, most, doubt):
    path = seq.write_folder(tmp_path / "s", 4)
    for file in path.rglob("*.png"):
        seq.write_image(file, np.full((seq.HEIGHT, seq.WIDTH), most, np.uint16))
    source = open_source(path, bits=bits)
    for _ in range(2):
        list(source)
        notes = source.report.notes
        assert len(notes) == 1 if doubt else not notes
        assert doubt is None or re.search(doubt, notes[0])


@pytest.mark.parametrize("bits", [14, 16])
def test_a_thermal_picture_on_an_offset_uses_eight_bits(tmp_path, bits):
    """Raw counts of 14 bits that differ by 300 become grey values that differ by half of all; brighter and darker
    pictures, and the black border of a rectified one, do not change the first. A scene in the dark keeps its light."""
    path = seq.write_folder(tmp_path / "s", 4)
    ramp = np.tile(np.linspace(7280, 7580, seq.WIDTH), (seq.HEIGHT, 1))
    ramp[:5] = 0
    for side in ("left", "right"):
        for k, file in enumerate(sorted((path / side).iterdir())):
            shown = ramp + (0, 60, -60, 1500)[k]
            seq.write_image(file, np.where(ramp > 0, shown, 0).astype(np.uint16))
    source = open_source(path, bits=bits)
    rows = [frame.left[20].astype(float) for frame in source]
    assert [round(row[-4] - row[3]) for row in rows[:3]] == [pytest.approx(114, abs=3)] * 3
    assert rows[1].mean() - rows[0].mean() == pytest.approx(25, abs=2)
    assert rows[0].mean() == pytest.approx(127, abs=2)
    assert 20 < rows[3][-4] - rows[3][3] < 60
    assert rows[3].max() < 255
    assert [n for n in source.report.notes if "keep to a small range" in n]
    dark = np.tile(np.linspace(0, 300, seq.WIDTH), (seq.HEIGHT, 1)).astype(np.uint16)
    for file in path.rglob("*.png"):
        seq.write_image(file, dark)
    assert max(int(frame.left.max()) for frame in open_source(path, bits=12)) <= 20


def test_a_raw_colour_mosaic_is_smoothed(tmp_path):
    """Whatever its pattern; texture, noise and interlaced rows are none."""
    rng = np.random.default_rng(0)
    h, w = 96, 128
    scene = cv2.resize(rng.uniform(40, 200, (h // 4, w // 4)), (w, h), interpolation=cv2.INTER_CUBIC)
    noise = rng.normal(0, 3, (h, w))
    for red, blue, y, x in ((0.4, 0.6, 0, 0), (0.5, 0.8, 0, 1), (1.4, 1.2, 1, 0)):
        gain = np.ones((h, w))
        gain[y::2, x::2], gain[1 - y :: 2, 1 - x :: 2] = red, blue
        mosaic = np.clip(scene * gain * 0.7 + noise, 0, 255).astype(np.uint8)
        assert is_mosaic(mosaic)
        smooth = smooth_mosaic(mosaic)
        assert not is_mosaic(smooth)
        assert smooth[4:-4, 4:-4].mean() == pytest.approx(mosaic[4:-4, 4:-4].mean(), abs=0.6)
        error = smooth - scene * 0.7 * (2 + red + blue) / 4
        assert error[8:-8, 8:-8].std() < 6
    woven = np.where(np.arange(h)[:, None] % 2, scene, np.roll(scene, 5, axis=1))
    for image in (scene, scene + 8 * noise, woven, rng.uniform(0, 255, (h, w)), np.full((h, w), 90), scene[:20, :20]):
        assert not is_mosaic(np.clip(image, 0, 255).astype(np.uint8))


def test_user_mask_reaches_the_source(tmp_path):
    path = seq.write_folder(tmp_path / "s", 3)
    mask = np.full((seq.HEIGHT, seq.WIDTH), 255, np.uint8)
    mask[:, :10] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    source = open_source(path, mask_left=tmp_path / "mask.png")
    assert source.mask is not None
    assert not source.mask[20, 5]
    assert source.mask[20, 30]


def test_stopping_early_ends_the_thread(tmp_path):
    import threading

    source = open_source(seq.write_folder(tmp_path / "s"))
    iterator = iter(source)
    next(iterator)
    iterator.close()
    assert not any(t.name == "gpvo-decode" for t in threading.enumerate())


# What is refused, each in one line that names the file and the cure.


def _one_line(caught) -> str:
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 600
    return text


def test_empty_folder(tmp_path):
    with pytest.raises(SourceError, match="the folder is empty") as caught:
        open_source(tmp_path)
    assert str(tmp_path) in _one_line(caught)


def test_nothing_there_and_nothing_known(tmp_path):
    with pytest.raises(SourceError, match="no such file"):
        open_source(tmp_path / "nowhere")
    (tmp_path / "readme.md").write_text("hello")
    with pytest.raises(SourceError, match="not recognised"):
        open_source(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    with pytest.raises(SourceError, match="is a run, not a sequence .*gpvo evaluate"):
        open_source(tmp_path / "run")
    with pytest.raises(SourceError, match="holds runs, not a sequence: run .give one of them"):
        open_source(tmp_path)
    with pytest.raises(SourceError, match="unknown source 'x'"):
        open_source(tmp_path, kind="x")
    with pytest.raises(SourceError, match="no option 'colour'"):
        open_source(seq.write_folder(tmp_path / "s"), colour=True)
    with pytest.raises(SourceError, match=r"no option 'tolerance_s' \(--pair-tolerance\)"):
        open_source(seq.write_kitti(tmp_path / "k"), tolerance_s=0.1)


@pytest.mark.parametrize(
    ("kind", "files", "cure"),
    [
        ("euroc", ("mav0/cam0/sensor.yaml",), r"camchain\.yaml"),
        ("kitti", ("calib.txt",), r"calib\.txt"),
        ("folder", ("camchain.yaml",), r"camchain\.yaml"),
    ],
)
def test_missing_calibration(tmp_path, kind, files, cure):
    path = MAKERS[kind](tmp_path / "s")
    for file in files:
        (path / file).unlink()
    with pytest.raises(CalibrationError, match="no calibration") as caught:
        open_source(path)
    assert re.search(cure, _one_line(caught))


@pytest.mark.parametrize("kind", ["euroc", "folder"])
def test_wrong_resolution(tmp_path, kind):
    path = MAKERS[kind](tmp_path / "s")
    for file in [*path.rglob("sensor.yaml"), *path.rglob("camchain.yaml")]:
        file.write_text(file.read_text().replace("[64, 48]", "[128, 96]"))
    with pytest.raises(CalibrationError, match="64x48, the calibration is for 128x96") as caught:
        open_source(path)
    assert ".png" in _one_line(caught)


def test_swapped_cameras(tmp_path):
    path = seq.write_euroc(tmp_path / "s")
    a, b = (path / "mav0" / c / "sensor.yaml" for c in ("cam0", "cam1"))
    text = a.read_text()
    a.write_text(b.read_text())
    b.write_text(text)
    with pytest.raises(CalibrationError, match="left and right are swapped") as caught:
        open_source(path)
    _one_line(caught)


def _textured_pair(path, swap: bool) -> None:
    """Noise on a wall whose disparity is 6 px, in place of the grey images."""
    wall = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (240, 400), dtype=np.uint8), (0, 0), 1.5)
    wall = cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX)
    for k, t in enumerate(seq.stamps(4)):
        views = (wall[:, k : k + 320], wall[:, k + 6 : k + 326])
        for side, image in zip(("right", "left") if swap else ("left", "right"), views, strict=True):
            seq.write_image(path / side / f"{t}.png", image)
    text = seq.camchain_yaml().replace("[64, 48]", "[320, 240]").replace("31.5, 23.5", "159.5, 119.5")
    (path / "camchain.yaml").write_text(text)


def test_swapped_images(tmp_path):
    _textured_pair(tmp_path / "right", swap=False)
    assert len(list(open_source(tmp_path / "right"))) == 4
    _textured_pair(tmp_path / "wrong", swap=True)
    with pytest.raises(SourceError, match="images are swapped") as caught:
        list(open_source(tmp_path / "wrong"))
    assert str(tmp_path / "wrong") in _one_line(caught)


def test_nan_in_truth_names_the_line(tmp_path):
    path = seq.write_euroc(tmp_path / "s")
    truth = path / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    lines = truth.read_text().splitlines()
    lines[5] = lines[5].split(",")[0] + ",nan" * 9
    truth.write_text("\n".join(lines))
    with pytest.raises(SourceError, match="line 6 holds NaN") as caught:
        open_source(path)
    assert str(truth) in _one_line(caught)


def test_nan_in_kitti_poses_names_the_line(tmp_path):
    path = seq.write_kitti(tmp_path / "s")
    lines = (path / "poses.txt").read_text().splitlines()
    lines[3] = "nan " + lines[3].split(" ", 1)[1]
    (path / "poses.txt").write_text("\n".join(lines))
    with pytest.raises(SourceError, match="line 4 holds NaN"):
        open_source(path)


def test_truth_of_another_time(tmp_path):
    path = seq.write_euroc(tmp_path / "s")
    truth = path / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    truth.write_text(truth.read_text().replace("\n14036", "\n15036"))
    with pytest.raises(SourceError, match="does not overlap") as caught:
        open_source(path)
    assert str(truth) in _one_line(caught)


@pytest.mark.parametrize(("factor", "unit"), [(10**3, "microseconds"), (10**6, "milliseconds")])
def test_names_in_another_unit(tmp_path, factor, unit):
    path = seq.write_folder(tmp_path / "s")
    for file in path.rglob("*.png"):
        file.rename(file.with_stem(str(int(file.stem) // factor)))
    with pytest.raises(SourceError, match=f"look like {unit}") as caught:
        open_source(path)
    assert "nanoseconds" in _one_line(caught)


@pytest.mark.parametrize("rate_hz", [0.6, 2.0, 10.0, 30.0])
@pytest.mark.parametrize("kind", ["euroc", "folder"])
def test_microseconds_at_low_rates(tmp_path, kind, rate_hz):
    """16 digits, whose intervals would do for nanoseconds of a very fast camera."""
    path = MAKERS[kind](tmp_path / "s")
    name = {t: str(round(1.4e15 + k * 1e6 / rate_hz)) for k, t in enumerate(seq.stamps(12))}
    for file in path.rglob("*.png"):
        file.rename(file.with_stem(name[int(file.stem)]))
    for camera in ("cam0", "cam1") if kind == "euroc" else ():
        (path / "mav0" / camera / "data.csv").write_text("".join(f"{t},{t}.png\n" for t in name.values()))
    with pytest.raises(SourceError, match="look like microseconds"):
        open_source(path)


@pytest.mark.parametrize("uptime_s", [5, 3600, 20 * 86400])
def test_nanoseconds_since_the_start_of_a_computer(tmp_path, uptime_s):
    path = seq.write_folder(tmp_path / "s")
    names = [f"{uptime_s * 10**9 + k * 5_000_000:013d}" for k in range(12)]  # 200 Hz
    for side in ("left", "right"):
        for file, name in zip(sorted((path / side).iterdir()), names, strict=True):
            file.rename(file.with_stem(name))
    assert [t for t, _ in seq.frames_of(open_source(path))] == [int(n) for n in names]


FAR = "99999999999999999999"  # beyond 64 bit


@pytest.mark.parametrize(
    ("file", "reason"),
    [
        ("imu0", r"imu0/data\.csv: line 3: expected t\[ns\]"),
        ("state_groundtruth_estimate0", r"data\.csv: line 3: '9{20}' is not a stamp in nanoseconds"),
        ("cam0", None),
    ],
)
def test_stamps_beyond_64_bit(tmp_path, file, reason):
    path = seq.write_euroc(tmp_path / "s")
    table = path / "mav0" / file / "data.csv"
    lines = table.read_text().splitlines()
    lines[2] = FAR + lines[2][19:]
    table.write_text("\n".join(lines))
    if reason is None:
        assert len(seq.frames_of(open_source(path))) == 11
        return
    with pytest.raises(SourceError, match=reason) as caught:
        open_source(path)
    _one_line(caught)


def test_names_beyond_64_bit(tmp_path):
    path = seq.write_folder(tmp_path / "s")
    for side in ("left", "right"):
        file = next((path / side).iterdir())
        file.rename(file.with_stem(FAR))
    with pytest.raises(SourceError, match="'9{20}' is not a stamp in nanoseconds"):
        open_source(path)


def test_times_in_microseconds(tmp_path):
    path = seq.write_kitti(tmp_path / "s")
    (path / "times.txt").write_text("".join(f"{k * 100_000}\n" for k in range(12)))
    with pytest.raises(SourceError, match="look like microseconds"):
        open_source(path)


def test_kitti_poses_of_another_length(tmp_path):
    path = seq.write_kitti(tmp_path / "s")
    lines = (path / "poses.txt").read_text().splitlines()
    (path / "poses.txt").write_text("\n".join(lines[:-2]))
    with pytest.raises(SourceError, match="10 poses for the 12 lines"):
        open_source(path)


def test_what_a_mac_leaves_beside_images_is_no_image(tmp_path):
    path = seq.write_folder(tmp_path / "s", 4)
    for file in list(path.rglob("*.png")):
        file.with_name(f"._{file.name}").write_bytes(b"\x00\x05\x16\x07")
    source = open_source(path)
    assert [k for _, k in seq.frames_of(source)] == [0, 1, 2, 3]
    assert source.report.duplicate == 0


def test_a_sequence_is_named_by_its_folder_wherever_one_stands(tmp_path, monkeypatch):
    bag = stereo_bag(False, 3).write(tmp_path / "flight_2024.05.06")
    for path in (seq.write_kitti(tmp_path / "03"), seq.write_folder(tmp_path / "hall"), bag):
        monkeypatch.chdir(path)
        assert [open_source(p).name for p in (".", path)] == [path.name] * 2


def test_samples_of_no_known_range_are_named(tmp_path):
    path = seq.write_folder(tmp_path / "s", 4)
    for file in path.rglob("*.png"):
        seq.write_image(file.with_suffix(".tiff"), np.full((seq.HEIGHT, seq.WIDTH), 0.5, np.float32))
        file.unlink()
    with pytest.raises(SourceError, match="no readable image pair.*samples are float32, .*8 or 16 bit"):
        list(open_source(path))


def test_all_images_unreadable(tmp_path):
    path = seq.write_folder(tmp_path / "s")
    for file in path.rglob("*.png"):
        file.write_bytes(b"")
    with pytest.raises(SourceError, match="no readable"):
        list(open_source(path))


def test_all_images_of_another_size(tmp_path):
    path = seq.write_folder(tmp_path / "s", 4)
    source = open_source(path)
    for file in (path / "right").iterdir():
        seq.write_image(file, seq.grey(0).T)
    with pytest.raises(SourceError, match=r"no image pair has the size .* 64x48 and 48x64"):
        list(source)


@pytest.mark.parametrize("orientation", [3, 6])
def test_an_exif_orientation_turns_nothing(tmp_path, orientation):
    path = seq.write_folder(tmp_path / "s", 4)
    picture = np.add.outer(np.arange(seq.HEIGHT), 3 * np.arange(seq.WIDTH)).astype(np.uint8)
    jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
    tag = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0" + bytes([orientation, 0, 0, 0]) + bytes(4)
    exif = b"\xff\xe1" + (len(tag) + 8).to_bytes(2, "big") + b"Exif\0\0" + tag
    for file in path.rglob("*.png"):
        file.with_suffix(".jpg").write_bytes(jpeg[:2] + exif + jpeg[2:])
        file.unlink()
    for frame in open_source(path):
        assert np.abs(frame.left[2:-2, 2:-2].astype(int) - picture[2:-2, 2:-2]).mean() < 3


@pytest.mark.parametrize("kind", MAKERS)
def test_no_traceback_whatever_is_cut(tmp_path, kind):
    """Any one text file cut short or filled with rubbish gives a GpvoError or works, nothing else."""
    shown = []
    for how in (lambda raw: raw[: len(raw) // 3], lambda raw: b"\xff\xfe\x00" * 50, lambda raw: b""):
        path = MAKERS[kind](tmp_path / "s", 4)
        files = [p for p in path.rglob("*") if p.suffix in (".csv", ".yaml", ".txt")]
        for file in files:
            raw = file.read_bytes()
            file.write_bytes(how(raw))
            try:
                list(open_source(path))
            except GpvoError as error:
                shown.append(str(error))
            file.write_bytes(raw)
        shutil.rmtree(path)
    assert shown
    assert not any("\n" in text for text in shown)


def test_sources_of_other_packages(monkeypatch):
    class Entry:
        name = "mine"

        @staticmethod
        def load():
            return dict

    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [Entry] if group == "gpvo.sources" else [])
    assert source_kinds.__wrapped__()["mine"]() is dict
