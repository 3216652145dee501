"""What an import does not use is named; what people call a covariance is understood."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sequences as seq
from bag_maker import BagMaker, stereo_bag
from gpvo.cameras.readers import read_stereo_yaml
from gpvo.cli.files import import_log
from gpvo.dataset.errors import motion_errors
from gpvo.errors import CalibrationError, SourceError
from gpvo.geometry import se3
from gpvo.io import open_source
from gpvo.io.foreign import ForeignLog, read_foreign
from gpvo.io.run_read import read_run
from gpvo.io.trajectory import Trajectory, read_tum, write_tum

POSE = "0,0,0,0,0,0,1"


def _csv(path: Path, columns: str, values: str) -> Path:
    rows = [f"{k * 0.1:.1f},{POSE},{values}" for k in range(5)]
    path.write_text("\n".join([f"t,x,y,z,qx,qy,qz,qw,{columns}", *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    "columns",
    [
        "cov_xx,cov_yy,cov_zz,cov_rollroll,cov_pitchpitch,cov_yawyaw",
        "var_x,var_y,var_z,var_roll,var_pitch,var_yaw",
        "cov_x_x,cov_y_y,cov_z_z,cov_rx_rx,cov_ry_ry,cov_rz_rz",
    ],
)
def test_covariance_columns_by_their_usual_names(columns: str, tmp_path: Path) -> None:
    log = read_foreign(_csv(tmp_path / "log.csv", columns, "1,2,3,4,5,6"))
    assert log.covariance is not None
    np.testing.assert_array_equal(np.diagonal(log.covariance[0]), [1, 2, 3, 4, 5, 6])
    assert log.notes == ()


def test_columns_of_uncertainty_that_are_not_understood_are_named(tmp_path: Path) -> None:
    log = read_foreign(_csv(tmp_path / "log.csv", "sigma_x,std_yaw,temperature", "1,2,3"))
    assert log.covariance is None
    [note] = log.notes
    assert "sigma_x, std_yaw" in note
    assert "temperature" not in note
    assert "--map" in note


@pytest.mark.parametrize("name", ["std_x", "pos_stddev_x", "X standard deviation"])
def test_a_standard_deviation_is_not_mapped_to_a_variance(name: str, tmp_path: Path) -> None:
    """A sigma of 1 cm was read as one of 10 cm."""
    path = _csv(tmp_path / "log.csv", f"{name},var_y", "1,2")
    with pytest.raises(SourceError, match=f"'{name}' is a standard deviation .*cov_00 a variance .square"):
        read_foreign(path, mapping={name: "cov_00"})
    assert len(read_foreign(path, mapping={"var_y": "cov_00"}).t_ns) == 5


def test_a_covariance_of_the_position_alone_is_named(tmp_path: Path) -> None:
    log = read_foreign(_csv(tmp_path / "log.csv", "cov_xx,cov_yy,cov_zz", "1,2,3"))
    assert log.covariance is None
    [note] = log.notes
    assert "cov_33, cov_44, cov_55" in note


def test_odometry_of_a_bag_that_is_not_used_is_named_with_the_option_that_takes_it(tmp_path: Path) -> None:
    maker: BagMaker = stereo_bag(ros1=False)
    for t, T in zip(seq.stamps(12), seq.true_poses(12), strict=True):
        maker.odometry("/wheels/odom", t, T, np.eye(6), np.eye(6))
    bag = maker.write(tmp_path / "bag")
    notes = open_source(bag).report.notes
    assert any("/wheels/odom" in n and "--topic /wheels/odom" in n and "--truth-topic" in n for n in notes)
    log = read_foreign(bag)
    assert log.topic == "/wheels/odom"
    assert log.other_topics == ("/vicon/head/head",)
    notes = import_log(log, None, tmp_path / "run").notes
    assert any("/vicon/head/head" in n and "--truth-topic" in n for n in notes)


def _stalling(path: Path, held: np.ndarray) -> tuple[Path, Path]:
    """Odometry at 10 Hz whose rows ``held`` (N,) repeat the pose before, and its exact truth."""
    s = np.arange(len(held)) * 0.1
    t_ns = np.rint(s * 1e9).astype(np.int64)
    T = se3.from_rt(se3.so3_exp(np.outer(0.3 * np.sin(s), [0, 1, 0])), np.stack([np.cos(s), 0 * s, 1.5 * s], 1))
    rows = np.maximum.accumulate(np.where(held, 0, np.arange(len(s))))
    write_tum(path / "truth.tum", t_ns, T)
    write_tum(path / "log.tum", t_ns, T[rows])
    return path / "log.tum", path / "truth.tum"


@pytest.mark.parametrize("frozen", [False, True])
def test_poses_that_odometry_only_repeats_are_no_motions(tmp_path: Path, frozen: bool) -> None:
    """One in ten, as of slower odometry logged at a fixed rate; or two seconds, as while it is lost. They made errors
    of half a motion and more, and a model learned these."""
    rng = np.random.default_rng(0)
    held = (np.arange(300) // 20 == 7) if frozen else (rng.random(300) < 0.1) & (np.arange(300) > 0)
    log, truth = (read_foreign(path) for path in _stalling(tmp_path, held))
    summary = import_log(log, truth, tmp_path / "run")
    assert any(f"{held.sum()} of 300 poses" in n for n in summary.notes)
    run = read_run(tmp_path / "run")
    np.testing.assert_array_equal(run.log.t_ns, log.t_ns[~held])
    assert run.truth is not None
    assert np.abs(motion_errors(run.log, run.truth).xi).max() < 1e-6


def test_a_log_without_the_rows_that_repeat_states_nothing_of_motions_over_them() -> None:
    T = np.tile(np.eye(4), (4, 1, 1))
    log = ForeignLog(Path("a"), Trajectory(np.arange(4), T), np.tile(np.eye(6), (4, 1, 1)), columns={"x": np.arange(4)})
    kept = log.rows(np.array([True, True, False, True]))
    assert kept.columns["x"].tolist() == [0, 1, 3] == kept.t_ns.tolist()
    assert kept.covariance is not None
    assert np.isfinite(kept.covariance).all(axis=(1, 2)).tolist() == [True, True, False]


def _camera_info(path: Path, tx: float) -> None:
    path.write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: c\ndistortion_model: plumb_bob\n"
        "camera_matrix: {rows: 3, cols: 3, data: [400, 0, 320, 0, 400, 240, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.05, 0, 0, 0]}\n"
        "rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}\n"
        f"projection_matrix: {{rows: 3, cols: 4, data: [380, 0, 320, {tx}, 0, 380, 240, 0, 0, 0, 1, 0]}}\n"
    )


def test_calibration_takes_ros_camera_info_of_both_cameras(tmp_path: Path) -> None:
    for side, tx in (("left", 0.0), ("right", -45.6)):
        _camera_info(tmp_path / f"{side}.yaml", tx)
    for side in ("left", "right"):
        rig = read_stereo_yaml(tmp_path / f"{side}.yaml")
        assert rig.baseline_m == pytest.approx(0.12)
        assert (rig.left.width, rig.left.fx_px) == (640, 400.0)
    (tmp_path / "right.yaml").unlink()
    with pytest.raises(CalibrationError, match=r"right\.yaml is not beside"):
        read_stereo_yaml(tmp_path / "left.yaml")


def test_calibration_takes_kittis_calib(tmp_path: Path) -> None:
    folder = seq.write_folder(tmp_path / "images")
    for found in folder.rglob("*.yaml"):
        found.unlink()
    row = "60 0 31.5 {} 0 60 23.5 0 0 0 1 0"
    (tmp_path / "calib.txt").write_text(f"P0: {row.format(0)}\nP1: {row.format(-6)}\n")
    source = open_source(folder, calibration=tmp_path / "calib.txt")
    assert source.camera.baseline_m == pytest.approx(0.1)
    with pytest.raises(CalibrationError, match="image size"):
        read_stereo_yaml(tmp_path / "calib.txt")


@pytest.mark.parametrize("name", ["cov[{}]", "covariance[{}]", "pose.covariance[{}]", "/odom/pose/covariance[{}]"])
def test_the_36_numbers_of_ros_by_their_place_in_the_row(name: str, tmp_path: Path) -> None:
    C = np.diag([1.0, 2, 3, 4, 5, 6]) + 0.1 * np.arange(1, 7)[:, None] @ np.arange(1, 7)[None] / 6
    names, values = ",".join(name.format(k) for k in range(36)), ",".join(repr(float(v)) for v in C.ravel())
    log = read_foreign(_csv(tmp_path / "log.csv", names, values))
    assert log.covariance is not None
    np.testing.assert_allclose(log.covariance[2], C, rtol=1e-12)
    assert log.notes == ()


@pytest.mark.parametrize("unit", ["_mm", " [mm]", "(cm)", "_km", "_m", " [ft]"])
def test_positions_are_in_the_unit_of_their_column(unit: str, tmp_path: Path) -> None:
    """They were read as metres where brackets named another unit, or ``--map`` the column."""
    metres = {"mm": 1e-3, "cm": 1e-2, "km": 1e3, "m": 1.0, "ft": 0.3048}[unit.strip(" _[]()")]
    rows = [f"{k * 0.1:.1f},{200.0 * k / metres!r},{-3.0 / metres!r},0,0,0,0,1" for k in range(5)]
    names = [f"{a}{unit}" for a in "xyz"]
    (tmp_path / "log.csv").write_text("\n".join([",".join(["t", *names, "qx,qy,qz,qw"]), *rows]))
    for mapping in ({}, dict(zip(names, ("p_x", "p_y", "p_z")))):
        log = read_foreign(tmp_path / "log.csv", mapping=mapping)
        np.testing.assert_allclose(log.trajectory.T_world_body[4, :3, 3], [800, -3, 0], rtol=1e-12)
        assert log.notes == ()


def test_covariances_are_in_the_unit_of_their_column(tmp_path: Path) -> None:
    """As logged in millimetres and degrees, squared; those of unnamed units beside such positions are remarked."""
    names = [f"var_{a} [mm^2]" for a in "xyz"] + [f"var_{a}_deg2" for a in ("roll", "pitch", "yaw")]
    log = read_foreign(_csv(tmp_path / "log.csv", ",".join(names), "1,4,9,1,4,9"))
    degree = np.pi / 180
    assert log.covariance is not None
    np.testing.assert_allclose(np.sqrt(np.diagonal(log.covariance[0])), [1e-3, 2e-3, 3e-3, *degree * np.arange(1, 4)])
    path = _csv(tmp_path / "mixed.csv", "cov_xx,cov_yy,cov_zz,cov_rollroll,cov_pitchpitch,cov_yawyaw", "1,2,3,4,5,6")
    path.write_text(path.read_text().replace(",x,", ",x_mm,", 1))
    [note] = read_foreign(path).notes
    assert "x_mm is converted to metres, the covariances, which name no unit, are not" in note


@pytest.mark.parametrize("unit", [" / mm", " mm", "[millimeters]", " (Centimetre)", "_kilometers"])
def test_a_unit_may_be_written_in_other_ways(unit: str, tmp_path: Path) -> None:
    """They were read as metres."""
    metres = {"mm": 1e-3, "mi": 1e-3, "ce": 1e-2, "ki": 1e3}[unit.lstrip(" /[(_")[:2].lower()]
    path = tmp_path / "log.csv"
    head = f"t,x{unit},y{unit},z{unit},qx,qy,qz,qw"
    path.write_text("\n".join([head, *(f"{k * 0.1:.1f},{3.0 * k / metres!r},0,0,0,0,0,1" for k in range(5))]))
    np.testing.assert_allclose(read_foreign(path).trajectory.T_world_body[4, :3, 3], [12, 0, 0], rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "column"),
    [("x [in]", 1), ("y (dm)", 2), ("z[um]", 3), ("cov_xx [mm*deg]", 8), ("cov_yaw_yaw (grad)", 8)],
)
def test_a_unit_that_is_not_known_is_asked_about(name: str, column: int, tmp_path: Path) -> None:
    """They were read as metres and radians; who says so has them read as such."""
    names = [*"txyz", "qx", "qy", "qz", "qw", "var_x"]
    names[column] = name
    path = tmp_path / "log.csv"
    path.write_text("\n".join([",".join(names), *(f"{k * 0.1:.1f},{POSE},1" for k in range(5))]))
    with pytest.raises(SourceError, match="is no unit that is read") as caught:
        read_foreign(path)
    (given,) = re.findall(r"--map '(.*)'", str(caught.value))
    assert given.startswith(f"{name}=")
    assert len(read_foreign(path, mapping=dict([given.rsplit("=", 1)])).t_ns) == 5


@pytest.mark.parametrize("unit", ["[]", "[m]", "(meters)", "[-]", "[1]", "_m"])
def test_a_unit_of_the_si_changes_nothing(unit: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("\n".join([f"t,x{unit},y,z,qx [-],qy [a],qz,qw", *(f"{k * 0.1:.1f},{POSE}" for k in range(5))]))
    assert len(read_foreign(path).t_ns) == 5


@pytest.mark.parametrize("unit", ["msec", "Milliseconds", "millisecond", "ms"])
def test_stamps_are_in_the_unit_of_their_column_however_it_is_written(unit: str, tmp_path: Path) -> None:
    """At 100 Hz and more, milliseconds from zero were read as seconds, with a remark."""
    path = tmp_path / "log.csv"
    path.write_text("\n".join([f"time [{unit}],x,y,z,qx,qy,qz,qw", *(f"{k * 10},{POSE}" for k in range(5))]))
    np.testing.assert_array_equal(read_foreign(path).t_ns, np.arange(5) * 10_000_000)


def test_a_unit_of_stamps_that_is_not_known_is_asked_about(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["time [min],x,y,z,qx,qy,qz,qw", *(f"{k * 0.01:.2f},{POSE}" for k in range(5))]))
    with pytest.raises(SourceError, match=r"'time \[min\]' is in 'min'.*write seconds, .*--map 'time \[min\]=t_s'"):
        read_foreign(path)


def test_of_a_twist_they_are_not_the_poses(tmp_path: Path) -> None:
    names = ",".join(f"twist.covariance[{k}]" for k in range(36))
    log = read_foreign(_csv(tmp_path / "log.csv", names, ",".join(["1"] * 36)))
    assert log.covariance is None
    [note] = log.notes
    assert note.count("twist") == 12
    assert "and 24 more" in note


HEAD = "t,pos x [m],pos y [m],pos z [m],qx,qy,qz,qw"


@pytest.mark.parametrize("word", ["", "NA", "None", "null", "N/A", "NaN", "#N/A", "<NA>"])
def test_what_stands_for_no_number_costs_its_row_alone(word: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(f"{HEAD}\n0.0,{POSE}\n0.1,0,{word},0,0,0,0,1\n0.2,{POSE}\n")
    log = read_foreign(path)
    np.testing.assert_array_equal(log.t_ns, [0, 200_000_000])
    assert log.notes == ("left out: 1 row without a pose",)


@pytest.mark.parametrize(
    ("text", "cure"),
    [
        (f"{HEAD.replace(',', ';')}\n0,1;0;0;0;0;0;0;1\n", r"line 2: '0,1' is not a number \(.*decimal point"),
        (f"{HEAD.replace(',', ';')}\n0.1;0,5;0;0;0;0;0;1\n", r"line 2: '0,5' is not a number \(.*decimal point"),
        # Seven more fields than names: each would be read as its neighbour.
        (f"{HEAD}\n0,1,0,5,0,0,0,0,0,0,0,0,0,0,1,0\n", r"line 2 holds 16 fields, the header 8 \(.*decimal point"),
        (f"{HEAD}\n7,0.1,{POSE}\n", r"line 2 holds 9 fields, the header 8 \(name every column"),
        (f"{HEAD}\n2020-09-13T12:26:40.5Z,{POSE}\n", r"line 2: .* is not a number \(dates are not read: write seconds"),
        (f"{HEAD}\n12:26:40.5,{POSE}\n", r"line 2: .* is not a number \(dates are not read"),
        (f"{HEAD}\n0,0,0,lost,0,0,0,1\n", r"line 2: 'lost' is not a number$"),
        ("t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n", r"quaternions alone: .*from_euler\('xyz', \[roll, pitch, yaw\]\)"),
        ("t,x,y,z,Roll [deg],pitch_deg,yaw_deg\n0,0,0,0,0,0,0\n", "quaternions alone: .*degrees=True"),
    ],
)
def test_a_table_of_another_custom_is_refused_with_the_cure(text: str, cure: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(SourceError, match=cure) as caught:
        read_foreign(path)
    assert str(path) in str(caught.value)


def test_vins_may_end_lines_with_a_comma(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(f"{HEAD}\n0.0,{POSE},\n0.1,{POSE},\n")
    assert len(read_foreign(path).t_ns) == 2


@pytest.mark.parametrize("read", [read_foreign, read_tum])
def test_tum_lines_with_decimal_commas_are_named_as_such(read: Callable[[Path], object], tmp_path: Path) -> None:
    path = tmp_path / "gt.tum"
    path.write_text("".join(f"{k},5 0,1 0,2 0,3 0,0 0,0 0,0 1,0\n" for k in range(3)))
    with pytest.raises(SourceError, match=r"'0,5' is not a number \(write numbers with a decimal point\)"):
        read(path)


@pytest.mark.parametrize(
    "names", ["P11,P22,P66", "p_00,p_11", "sigma_x,sigma_y", "num_inliers,feature_count", "mean_brightness"]
)
def test_an_uncertainty_or_a_feature_that_nothing_reads_is_named(names: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    more = ",0.01" * len(names.split(","))
    path.write_text(f"{HEAD},{names}\n0.0,{POSE}{more}\n0.1,{POSE}{more}\n")
    assert any(f"columns not used: {names.replace(',', ', ')};" in note for note in read_foreign(path).notes)


@pytest.mark.parametrize("name", ["log.tum", "log.csv"])
def test_a_file_that_breaks_off_in_a_line_is_told_from_one_of_another_kind(name: str, tmp_path: Path) -> None:
    """As of a full disk or a kill: the cure is that line, not another command."""
    separator, path = "," if name.endswith("csv") else " ", tmp_path / name
    lines = [separator.join([f"{k * 0.1:.1f}", *POSE.split(",")]) for k in range(5)]
    head = ["t,x,y,z,qx,qy,qz,qw"] * (separator == ",")
    path.write_text("\n".join([*head, *lines])[:-5])
    with pytest.raises(SourceError, match="the file breaks off in this line: remove it"):
        read_foreign(path)
    short = lines[2][:-5]
    path.write_text("\n".join([*head, *lines[:2], short, *lines[3:]]))
    with pytest.raises(SourceError) as raised:
        read_foreign(path)
    assert "breaks off" not in str(raised.value)


def test_poses_alone_are_sent_to_import(tmp_path: Path) -> None:
    """What has no images is no sequence, and no run yet: each refusal said how to make a run of images."""
    maker = BagMaker(ros1=False)
    for t, T in zip(seq.stamps(12), seq.true_poses(12), strict=True):
        maker.odometry("/wheels/odom", t, T, np.eye(6), np.eye(6))
    bag = maker.write(tmp_path / "bag")
    log = _csv(tmp_path / "log.csv", "a", "1")
    for path in (bag, log):
        with pytest.raises(SourceError, match="'gpvo import'"):
            open_source(path)
        with pytest.raises(SourceError, match="or 'gpvo import' of poses"):
            read_run(path)


@pytest.mark.parametrize(
    "names", ["q0,q1,q2,q3", "q[0],q[1],q[2],q[3]", "pose.quat_0,pose.quat_1,pose.quat_2,pose.quat_3"]
)
def test_numbered_quaternions_are_asked_about(names: str, tmp_path: Path) -> None:
    """PX4 and Hamilton put w first, ROS last: to map the first one to q_x, as was advised, is wrong for PX4."""
    path = tmp_path / "log.csv"
    rows = [f"{k * 0.1:.1f},0,0,0,1,0,0,0" for k in range(5)]
    path.write_text("\n".join([f"t,x,y,z,{names}", *rows]) + "\n")
    with pytest.raises(SourceError, match="which is w") as raised:
        read_foreign(path)
    columns = names.split(",")
    assert f"'{columns[0]}=q_w'" in str(raised.value)
    mapping = dict(zip(columns, ("q_w", "q_x", "q_y", "q_z")))
    np.testing.assert_array_equal(
        read_foreign(path, mapping=mapping).trajectory.T_world_body[:, :3, :3], [np.eye(3)] * 5
    )


@pytest.mark.parametrize("name", ["Rot {}", "quaternion.{}", "orientation_{}", "pose/quaternion/{}"])
def test_quaternions_by_their_usual_names(name: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    names = ",".join(name.format(a) for a in "WXYZ")
    path.write_text("\n".join([f"Time,Pos X,Pos Y,Pos Z,{names}", *(f"{k * 0.1:.1f},1,2,3,1,0,0,0" for k in range(5))]))
    T = read_foreign(path).trajectory.T_world_body
    np.testing.assert_array_equal(T[2], [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


@pytest.mark.parametrize("name", ["Pose.{}", "pose_{}", "pose/position/{}"])
def test_positions_by_their_usual_names(name: str, tmp_path: Path) -> None:
    path, names = tmp_path / "log.csv", ",".join(name.format(a) for a in "xyz")
    path.write_text(
        "\n".join([f"t,{names},Quat.x,Quat.y,Quat.z,Quat.w", *(f"{k * 0.1:.1f},1,2,3,0,0,0,1" for k in range(5))])
    )
    np.testing.assert_array_equal(read_foreign(path).trajectory.T_world_body[:, :3, 3], [[1, 2, 3]] * 5)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"mapping": {"a": "p_x"}}, "--map"),
        ({"topic": "/odom"}, "--topic"),
        ({"covariance_of": "motion"}, "--covariance-of motion"),
        ({"covariance_axes": "body"}, "--covariance-axes"),
    ],
)
def test_what_a_format_does_not_read_is_refused(given: dict[str, Any], named: str, tmp_path: Path) -> None:
    """It was ignored: a TUM file has no columns to map, no topic and no covariances."""
    path = tmp_path / "log.tum"
    path.write_text("".join(f"{k * 0.1:.1f} 0 0 0 0 0 0 1\n" for k in range(5)))
    with pytest.raises(SourceError, match=rf"{named} has no effect on this file .tum."):
        read_foreign(path, **given)
    assert len(read_foreign(path, covariance_of="pose").t_ns) == 5


@pytest.mark.parametrize(
    ("packed", "name"),
    [
        (gzip.compress(b"t,x,y,z,qx,qy,qz,qw\n", mtime=0x6B0E4972), "gzip"),
        (lzma.compress(b"t,x,y,z,qx,qy,qz,qw\n"), "xz"),
        (bz2.compress(b"t,x,y,z,qx,qy,qz,qw\n"), "bzip2"),
        (bytes.fromhex("28b52ffd24036100"), "Zstandard"),
        (b"PK\x03\x04\x14\x00", "zip"),
        (b"PAR1\x15\x04", "Parquet"),
    ],
)
def test_a_packed_file_is_named_as_such(packed: bytes, name: str, tmp_path: Path) -> None:
    """One of gzip without NUL in its first line was said to lack columns, and its bytes were shown."""
    path = tmp_path / "log.csv"
    path.write_bytes(packed)
    with pytest.raises(SourceError, match=f"is a file of {name}, no text .unpack it"):
        read_foreign(path)
