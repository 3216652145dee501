"""Other people's logs as records: CSV by name and by mapping, formats by their look, covariances of every kind."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from foreign_trajectories import write_euroc_csv, write_kitti_poses
from gpvo.cli.files import import_log
from gpvo.errors import SourceError
from gpvo.geometry import covariance, se3
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.io.foreign import check_same_rows, guess_format, read_foreign
from gpvo.io.stamps import cure_of_seconds, likely_unit
from gpvo.io.stated import to_records
from gpvo.io.trajectory import write_tum
from gpvo.stats.consistency import SEEN
from gpvo.types import IMPORTED, Status, VoLog

N = 25
T_NS = np.array([1_403_636_579_763_555_584 + k * 50_000_000 for k in range(N)])
POSES = se3.exp(np.outer(np.arange(N), [0.02, 0.01, 0.1, 0.01, 0.02, -0.01]))
MOTIONS = se3.inverse(POSES[:-1]) @ POSES[1:]


def _csv(path, header, extra=(), separator=",", stamp="{}"):
    lines = [header]
    for k in range(N):
        q = se3.rotation_to_quaternion_xyzw(POSES[k, :3, :3])
        values = [stamp.format(T_NS[k]), *(repr(float(v)) for v in (*POSES[k, :3, 3], *q))]
        lines.append(separator.join([*values, *(str(e[k]) for e in extra)]))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("header", "separator"),
    [
        ("t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w", ","),
        ("timestamp;tx;ty;tz;qx;qy;qz;qw", ";"),
        ("#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_x [], q_RS_y [], q_RS_z [], q_RS_w []", ","),
        ("time\tx\ty\tz\tqx\tqy\tqz\tqw", "\t"),
        ("# from somewhere\n# t px py pz qx qy qz qw", " "),
        (
            "%time,field.pose.pose.position.x,field.pose.pose.position.y,field.pose.pose.position.z,"
            "field.pose.pose.orientation.x,field.pose.pose.orientation.y,field.pose.pose.orientation.z,"
            "field.pose.pose.orientation.w",
            ",",
        ),
        ("stamp,pos_x,pos_y,pos_z,quat_x,quat_y,quat_z,quat_w", ","),
        ("__time,/o/pose/position/x,/o/pose/position/y,/o/pose/position/z,/o/q/x,/o/q/y,/o/q/z,/o/q/w", ","),
    ],
)
def test_columns_by_name(tmp_path, header, separator):
    log = read_foreign(_csv(tmp_path / "a.csv", header, separator=separator), "csv")
    np.testing.assert_array_equal(log.t_ns, T_NS)
    np.testing.assert_allclose(log.trajectory.T_world_body, POSES, atol=1e-12)
    assert log.covariance is None


def test_covariances_of_openvins_own_files_are_read(tmp_path):
    """As its recorder writes them: the rotation's block, then the translation's, upper triangles."""
    numbers = [f"{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3) if i <= j]
    names = [f"{block}{n}" for block in ("Pr", "Pt") for n in numbers]
    values = [3e-4, 1e-5, 2e-5, 4e-4, 3e-5, 5e-4, 3e-2, 1e-3, 2e-3, 4e-2, 3e-3, 5e-2]
    header = "# timestamp(s) tx ty tz qx qy qz qw " + " ".join(names)
    path = _csv(tmp_path / "state_estimate.txt", header, [[v] * N for v in values], " ")
    path.write_text(re.sub(r"(?m)^(\d{10})(\d{9})", r"\1.\2", path.read_text()))
    log = read_foreign(path, covariance_axes="body")
    np.testing.assert_allclose(log.covariance[0][np.triu_indices(6)].reshape(-1)[[0, 1, 2, 6, 7, 11]], values[6:])
    np.testing.assert_allclose(log.covariance[0][3:, 3:][np.triu_indices(3)], values[:6])


@pytest.mark.parametrize("names", ["OpenVINS", "world"])
def test_the_rotation_of_openvins_own_files_errs_about_axes_of_the_body(tmp_path, names):
    """Its evaluation has ``R_true = R_est Exp(e)`` and ``p_true = p_est + e``; other columns are in the world's."""
    i, j = np.triu_indices(3)
    own, of_position = names == "OpenVINS", np.diag([1e-2, 4e-2, 9e-2])
    of_rotation = np.array([[9e-4, 1e-4, 0], [1e-4, 1e-4, 0], [0, 0, 4e-4]])
    R = POSES[:, :3, :3]
    in_world = [R @ C @ np.swapaxes(R, 1, 2) for C in (of_position, of_rotation)]
    stated = in_world[0], np.broadcast_to(of_rotation, (N, 3, 3)) if own else in_world[1]
    blocks = ("Pt{}{}", 1), ("Pr{}{}", 1)
    if not own:
        blocks = ("cov_{}{}", 0), ("cov_{}{}", 3)
    columns = [name.format(a + first, b + first) for name, first in blocks for a, b in zip(i, j)]
    values = [C[:, a, b] for C in stated for a, b in zip(i, j)]
    path = _csv(tmp_path / "a.csv", ",".join(["t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w", *columns]), values)
    log = read_foreign(path)
    for block, C in ((slice(0, 3), of_position), (slice(3, 6), of_rotation)):
        np.testing.assert_allclose(log.covariance[:, block, block], np.broadcast_to(C, (N, 3, 3)), atol=1e-9)
    assert any("OpenVINS" in note for note in log.notes) is own
    fixed = read_foreign(path, covariance_axes="world").covariance[-1, 3:, 3:]
    np.testing.assert_allclose(R[-1] @ fixed @ R[-1].T, stated[1][-1], atol=1e-9)


def test_openvins_is_least_sure_of_its_heading(real_data):
    log = read_foreign(real_data / "openvins_mh01_cov" / "MH01_ov_est.csv")
    least_sure = np.linalg.eigh(log.covariance[1500:, 3:, 3:])[1][:, :, -1]
    vertical = log.trajectory.T_world_body[1500:, 2, :3]
    assert np.abs((least_sure * vertical).sum(axis=1)).min() > 0.99


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_what_is_no_text_is_said_to_be_none(tmp_path, encoding):
    (tmp_path / "log.csv").write_bytes("t,x,y\0\n1,2,3\n".encode(encoding))
    with pytest.raises(SourceError, match=r"no text file, or one in UTF-16 \(give it as UTF-8"):
        read_foreign(tmp_path / "log.csv")


def test_a_log_that_ends_in_nul_says_what_happened_and_how_to_keep_the_rest(tmp_path):
    """As file systems leave it where power was lost: as long as it was to be, the last block never written."""
    path = _csv(tmp_path / "log.csv", "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w")
    whole = path.read_bytes()
    path.write_bytes(whole[:-30] + bytes(3_000_000))
    with pytest.raises(SourceError, match=r"log\.csv: line 26 holds NUL bytes, as where power was lost") as refused:
        read_foreign(path)
    (kept,) = re.findall(r"head -n (\d+) log\.csv > NEW", str(refused.value))
    path.write_bytes(b"".join(whole.splitlines(True)[: int(kept)]))
    np.testing.assert_array_equal(read_foreign(path).t_ns, T_NS[:-1])


def test_as_many_covariances_are_left_out_as_is_said(tmp_path):
    """One that says that two axes err as one cannot be inverted: no filter takes it."""
    singular = np.eye(6)
    singular[0, 1] = singular[1, 0] = 1.0
    stated = [1e-4 * (singular if k in (5, 9) else np.eye(6)) for k in range(N)]
    names = [f"cov_{i}{j}" for i in range(6) for j in range(6)]
    columns = np.reshape(stated, (N, 36)).T.tolist()
    path = _csv(tmp_path / "log.csv", ",".join(["t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w", *names]), columns)
    records, notes = to_records(read_foreign(path, covariance_of="motion", covariance_axes="body"))
    assert [k for k, r in enumerate(records) if not r.covariances][1:] == [5, 9]
    assert any(note == f"left out: 2 of {N - 1} covariances, not positive definite" for note in notes)


@pytest.mark.parametrize(
    ("step", "doubt"), [("20", "20 s apart .*milliseconds"), ("1", "numbers of frames"), ("0.5", "")]
)
def test_stamps_that_are_hardly_seconds_are_remarked(tmp_path, step, doubt):
    lines = (f"{float(step) * k:g} {0.1 * k} 0 0 0 0 0 1" for k in range(50))
    (tmp_path / "a.tum").write_text("\n".join(lines))
    notes = to_records(read_foreign(tmp_path / "a.tum"))[1]
    assert re.search(doubt, notes[0]) if doubt else not notes


@pytest.mark.parametrize("stamp", ["field.header.stamp", "header.stamp.secs,header.stamp.nsecs", "sec,nanosec"])
def test_the_time_of_the_sensor_goes_before_that_of_recording(tmp_path, stamp):
    """As ``rostopic echo -p``, bagpy and copies of ROS 2's fields write them."""
    path = _csv(tmp_path / "a.csv", "time,x,y,z,qx,qy,qz,qw")
    lines = [line.split(",") for line in path.read_text().splitlines()[1:]]
    rows = [f"time,seq,{stamp},x,y,z,qx,qy,qz,qw"] if "header" in stamp else [f"seq,{stamp},x,y,z,qx,qy,qz,qw"]
    for k, (t_ns, *pose) in enumerate(lines):
        own = [t_ns] if "," not in stamp else [str(int(t_ns) // 10**9), str(int(t_ns) % 10**9)]
        recorded = [str(int(t_ns) + 7_000_000 * (k % 3))] if "header" in stamp else []
        rows.append(",".join([*recorded, str(k), *own, *pose]))
    path.write_text("\n".join(rows))
    np.testing.assert_array_equal(read_foreign(path).t_ns, T_NS)
    if "header" in stamp:
        recorded = read_foreign(path, mapping={"time": "t_ns"}).t_ns
        np.testing.assert_array_equal(recorded - T_NS, 7_000_000 * (np.arange(N) % 3))


def test_columns_by_mapping_with_counts_and_covariance(tmp_path):
    header = "when,e,n,u,a,b,c,d,vx,vy,vz,vroll,vpitch,vyaw,matches,blur"
    variances = [[(i + 1) * 1e-4 + k * 1e-6 for k in range(N)] for i in range(6)]
    counts, blur = [100 + k for k in range(N)], [0.5 * k for k in range(N)]
    path = _csv(tmp_path / "a.csv", header, [*variances, counts, blur])
    names = {"when": "t_ns", "e": "p_x", "n": "p_y", "u": "p_z", "a": "q_x", "b": "q_y", "c": "q_z", "d": "q_w"}
    names |= {v: f"cov_{i}{i}" for i, v in enumerate(("vx", "vy", "vz", "vroll", "vpitch", "vyaw"))}
    names |= {"matches": "n_inliers", "blur": "sharpness"}
    log = read_foreign(path, mapping=names, covariance_of="motion", covariance_axes="body")
    records, notes = to_records(log)
    beyond = _csv(tmp_path / "b.csv", header, [*variances, [*counts[:5], 1e30, *counts[6:]], blur])
    with pytest.raises(SourceError, match=r"line 7: 1e\+30 is no count \(n_inliers\)"):
        read_foreign(beyond, mapping=names)
    assert not notes
    assert records[0].status is Status.START
    assert records[7].n_inliers == 107
    assert records[7].sharpness == 3.5
    np.testing.assert_allclose(np.diag(records[7].covariances["imported"]), [v[7] for v in variances])
    np.testing.assert_allclose(records[7].T_prev_cur, MOTIONS[6], atol=1e-9)
    assert records[7].t_prev_ns == T_NS[6]


def test_world_axes_are_turned_into_the_body(tmp_path):
    header = "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w," + ",".join(f"cov_{i}{i}" for i in range(6))
    path = _csv(tmp_path / "a.csv", header, [[1e-4 * (i + 1)] * N for i in range(6)])
    log = read_foreign(path, covariance_of="motion", covariance_axes="world")
    R = POSES[9, :3, :3]
    np.testing.assert_allclose(log.covariance[9][:3, :3], R.T @ np.diag([1e-4, 2e-4, 3e-4]) @ R, atol=1e-12)


def test_covariances_of_motions_are_in_the_axes_of_the_body(tmp_path):
    """What a motion knows is of the camera that saw it; read in the world's axes it was turned with the vehicle."""
    header = "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w," + ",".join(f"cov_{i}{i}" for i in range(6))
    path = _csv(tmp_path / "a.csv", header, [[1e-4 * (i + 1)] * N for i in range(6)])
    stated = read_foreign(path, covariance_of="motion").covariance
    np.testing.assert_allclose(stated, np.tile(np.diag(1e-4 * np.arange(1, 7)), (N, 1, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("written", "read", "remarked"),
    [("body", "auto", True), ("world", "body", True), ("world", "auto", False), ("body", "body", False)],
)
def test_covariances_that_grow_in_other_axes_than_read_are_remarked(tmp_path, written, read, remarked):
    """Errors that add up, as GTSAM states them, about axes of the body, and as ROS does, about those of the world."""
    C = [1e-10 * np.eye(6)]
    for k, motion in enumerate(MOTIONS):
        added = np.diag([1e-4 if k < 3 else 1e-8, 1e-8, 1e-8, 1e-10, 1e-10, 1e-10])
        C.append(covariance.compound(motion, C[-1], added))
    stated = np.array(C) if written == "body" else se3.rotate_covariance(POSES[:, :3, :3], np.array(C))
    names = [f"cov_{i}{j}" for i in range(6) for j in range(6)]
    header = ",".join(["t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w", *names])
    path = _csv(tmp_path / "a.csv", header, np.reshape(stated, (N, 36)).T.tolist())
    records, notes = to_records(read_foreign(path, covariance_axes=read))
    assert set(records[5].covariances) == {"imported_pose" if remarked else "imported"}
    assert any(f"--covariance-axes {written}" in note for note in notes) is remarked


def test_pose_covariance_of_a_filter_is_not_passed_off_as_a_motions(tmp_path):
    header = "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w," + ",".join(f"cov_{i}{i}" for i in range(6))
    path = _csv(tmp_path / "a.csv", header, [[1e-4] * N] * 6)
    records, notes = to_records(read_foreign(path))
    assert "imported_pose" in notes[0]
    assert "if they are of single motions, --covariance-of motion" in notes[0]
    assert set(records[5].covariances) == {"imported_pose"}


@pytest.mark.parametrize("empty", [0.0, np.nan])
@pytest.mark.parametrize(("zeros", "covariance_of"), [(6, "pose"), (3, "pose"), (3, "motion")])
def test_covariances_that_state_nothing_are_left_out_with_one_remark(tmp_path, zeros, covariance_of, empty):
    """All zeros, or zeros for the rotation, are a placeholder, as is NaN; they were said to grow as a filter's, or left
    out without a word."""
    variances = [np.full(N, empty if i >= 6 - zeros else 1e-4) for i in range(6)]
    header = "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w," + ",".join(f"cov_{i}{i}" for i in range(6))
    log = read_foreign(_csv(tmp_path / "a.csv", header, variances), covariance_of=covariance_of)
    records, notes = to_records(log)
    assert not any(r.covariances for r in records)
    assert notes == ["its covariances are NaN or not positive definite and were left out"]


def test_a_motion_that_is_stated_as_unknown_is_lost(tmp_path):
    """Three motions of which nothing is known; all of them in the plane, where roll and pitch are not known at all."""
    header = "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w," + ",".join(f"cov_{i}{i}" for i in range(6))
    small, some = [1e-4] * N, [25.0 if k in (0, 8, 9, 10) else 1e-4 for k in range(N)]
    read = {"covariance_of": "motion", "covariance_axes": "body"}
    records, notes = to_records(read_foreign(_csv(tmp_path / "a.csv", header, [some] * 6), **read))
    assert [k for k, r in enumerate(records) if r.status is Status.LOST] == [8, 9, 10, 11]
    assert notes[0].endswith("unknown: 4")
    # Whatever the poses of such rows are, the last known one holds, and the path goes on where it is known again.
    placed = VoLog(records).trajectory()
    np.testing.assert_allclose(placed[8:11], np.tile(placed[7], (3, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(POSES[7]) @ POSES[11], records[11].T_prev_cur, atol=1e-9)
    planar = [small, small, [1e6] * N, [1e6] * N, [1e6] * N, small]
    records, notes = to_records(read_foreign(_csv(tmp_path / "b.csv", header, planar), **read))
    assert all(r.usable for r in records[1:])
    assert not notes


def test_the_motion_over_a_gap_is_lost(tmp_path):
    stamps = T_NS.copy()
    stamps[12:] += 20_000_000_000
    write_tum(tmp_path / "a.tum", stamps, POSES)
    records, notes = to_records(read_foreign(tmp_path / "a.tum"))
    assert [k for k, r in enumerate(records) if r.status is Status.LOST] == [12]
    assert notes[0].endswith("usual steps: 1")


def test_rows_without_a_pose_are_left_out_and_counted(tmp_path):
    path = _csv(tmp_path / "a.csv", "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w")
    lines = path.read_text().splitlines()
    lines[5] = lines[5].split(",")[0] + ",nan" * 7
    lines[6] = lines[6].split(",")[0] + "," * 7
    path.write_text("\n".join(lines))
    records, notes = to_records(read_foreign(path))
    assert len(records) == N - 2
    assert notes == ["left out: 2 rows without a pose"]
    assert records[4].dt_s == pytest.approx(0.15)
    with pytest.raises(SourceError, match="line 6 holds NaN"):
        read_foreign(path, complete=True)


def test_formats_by_their_look(tmp_path):
    write_tum(tmp_path / "a", T_NS, POSES)
    write_kitti_poses(tmp_path / "b", POSES)
    write_euroc_csv(tmp_path / "c", T_NS, POSES)
    assert [guess_format(tmp_path / n) for n in "abc"] == ["tum", "kitti", "csv"]
    np.testing.assert_array_equal(read_foreign(tmp_path / "a").t_ns, T_NS)
    np.testing.assert_array_equal(read_foreign(tmp_path / "c").t_ns, T_NS)
    np.testing.assert_allclose(read_foreign(tmp_path / "c").trajectory.T_world_body, POSES, atol=1e-8)
    with pytest.raises(SourceError, match="no stamps"):
        read_foreign(tmp_path / "b")
    assert read_foreign(tmp_path / "b", rate_hz=10.0).t_ns[3] == 300_000_000
    (tmp_path / "times.txt").write_text("".join(f"{0.1 * k:.4f}\n" for k in range(N)))
    assert read_foreign(tmp_path / "b").t_ns[3] == 300_000_000


def test_rows_that_only_their_numbers_stamp_must_be_those_of_the_log(tmp_path):
    write_kitti_poses(tmp_path / "log", POSES)
    write_kitti_poses(tmp_path / "truth", POSES[1:])
    write_tum(tmp_path / "truth.tum", T_NS, POSES)
    log, truth = (read_foreign(tmp_path / name, rate_hz=10.0) for name in ("log", "truth"))
    check_same_rows(log, log)
    check_same_rows(read_foreign(tmp_path / "truth.tum"), log)
    with pytest.raises(SourceError, match="truth: holds 24 poses for the 25 of log .*--times"):
        import_log(log, truth, tmp_path / "run")


def test_body_becomes_camera(tmp_path):
    """A FLU body that drives along its x axis is a camera that moves along z."""
    poses = se3.exp(np.outer(np.arange(N), [1.0, 0, 0, 0, 0, 0.1]))
    write_tum(tmp_path / "a.tum", T_NS, poses)
    records, _ = to_records(read_foreign(tmp_path / "a.tum").seen_from(T_FLU_OPTICAL))
    xi = se3.log(records[1].T_prev_cur)
    np.testing.assert_allclose(xi, [0, 0, 1, 0, -0.1, 0], atol=1e-6)


@pytest.mark.parametrize(
    "header",
    [
        "#timestamp x y z qw qx qy qz",
        "# timestamp(s) tx ty tz qw qx qy qz",
        "# timestamp_s x y z qw qx qy qz id",
        "#timestamp x y z qw qx qy qz vx vy vz id",
    ],
)
def test_a_comment_that_names_the_columns_is_their_header(tmp_path, header):
    """With w first, with more columns than TUM has, and with as many as KITTI has."""
    further = len(header.lstrip("# ").split()) - 8
    q = se3.rotation_to_quaternion_xyzw(POSES[:, :3, :3])
    rows = [
        " ".join([f"{t * 1e-9:.9f}", *(f"{v:.12g}" for v in (*T[:3, 3], r[3], *r[:3])), *["7"] * further])
        for t, T, r in zip(T_NS, POSES, q, strict=True)
    ]
    (tmp_path / "a.txt").write_text("\n".join(["# made by hand", header, *rows]) + "\n")
    np.testing.assert_allclose(read_foreign(tmp_path / "a.txt").trajectory.T_world_body, POSES, atol=1e-9)


@pytest.mark.parametrize(
    "above",
    [
        ["# timestamp tx ty tz qw qx qy qz", "# made by hand", "#"],
        ["# t,x,y,z,qw,qx,qy,qz"],  # commas above blanks
        ["# t x[mm] y[mm] z[mm] qw qx qy qz"],
        ["# timestamp [s] tx [mm] ty [mm] tz [mm] qw [-] qx [-] qy [-] qz [-]"],
    ],
)
def test_the_names_of_columns_are_found_among_the_comments(tmp_path, above):
    """With w first, and in millimetres, they were read as TUM has them: as if x were first, and in metres."""
    q, per_m = se3.rotation_to_quaternion_xyzw(POSES[:, :3, :3]), 1000 if "mm" in above[0] else 1
    rows = [
        " ".join([f"{t * 1e-9:.9f}", *(f"{v:.12g}" for v in (*T[:3, 3] * per_m, r[3], *r[:3]))])
        for t, T, r in zip(T_NS, POSES, q, strict=True)
    ]
    (tmp_path / "a.txt").write_text("\n".join([*above, *rows]) + "\n")
    np.testing.assert_allclose(read_foreign(tmp_path / "a.txt").trajectory.T_world_body, POSES, atol=1e-9)


def test_a_comment_may_state_the_units_of_tum_or_others(tmp_path):
    write_tum(tmp_path / "a.tum", T_NS, POSES)
    for unit in ("m", "mm", "in"):
        names = f"# timestamp [s] tx[{unit}] ty[{unit}] tz[{unit}] qx qy qz qw\n"
        (tmp_path / f"{unit}.tum").write_text(names + (tmp_path / "a.tum").read_text())
    assert guess_format(tmp_path / "m.tum") == "tum"
    np.testing.assert_allclose(
        read_foreign(tmp_path / "mm.tum").trajectory.T_world_body[:, :3, 3], 1e-3 * POSES[:, :3, 3], atol=1e-9
    )
    with pytest.raises(SourceError, match="no unit that is read"):
        read_foreign(tmp_path / "in.tum")


def test_the_comment_that_tum_has_changes_nothing(tmp_path):
    write_tum(tmp_path / "a.tum", T_NS, POSES)
    text = (tmp_path / "a.tum").read_text()
    (tmp_path / "b.tum").write_text("# timestamp tx ty tz qx qy qz qw\n" + text)
    assert guess_format(tmp_path / "b.tum") == "tum"
    (tmp_path / "c.tum").write_text("# a b c d e f g h\n" + text)
    assert guess_format(tmp_path / "c.tum") == "tum"


@pytest.mark.parametrize("p, q", [("p_WS_W", "q_WS"), ("p_RS_R", "q_RS"), ("p_GI_G", "q_GI"), ("p_WB", "q_WB")])
def test_columns_that_name_their_frames(tmp_path, p, q):
    """As those of OKVIS do, with the quaternion's w last, and those of EuRoC, with w first."""
    names = [*(f"{p}_{a}" for a in "xyz"), *(f"{q}_{a}" for a in "xyzw"), *(f"v_WS_W_{a}" for a in "xyz"), "b_g_x"]
    Q = se3.rotation_to_quaternion_xyzw(POSES[:, :3, :3])
    rows = [
        ", ".join([str(int(t)), *(f"{v:.12g}" for v in (*T[:3, 3], *r)), "1", "2", "3", "4"])
        for t, T, r in zip(T_NS, POSES, Q, strict=True)
    ]
    (tmp_path / "a.csv").write_text("\n".join([", ".join(["timestamp", *names]), *rows]))
    np.testing.assert_allclose(read_foreign(tmp_path / "a.csv").trajectory.T_world_body, POSES, atol=1e-9)


def test_the_cure_of_absent_stamps_names_their_units(tmp_path):
    (tmp_path / "a.csv").write_text("TimeUS,x,y,z,qx,qy,qz,qw\n" + "".join(f"{k},0,0,0,0,0,0,1\n" for k in range(5)))
    with pytest.raises(SourceError, match=r"--map COLUMN=t_s \(or t_ms, t_us, t_ns\)"):
        read_foreign(tmp_path / "a.csv")


def test_a_plain_column_goes_before_one_that_says_whose(tmp_path):
    path = _csv(tmp_path / "a.csv", "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w,gt_p_x", [[9.0] * N])
    np.testing.assert_allclose(read_foreign(path).trajectory.T_world_body, POSES, atol=1e-6)
    text = path.read_text().splitlines()
    swapped = [",".join([*line.split(",")[:1], line.split(",")[8], *line.split(",")[1:8]]) for line in text]
    path.write_text("\n".join(swapped) + "\n")
    np.testing.assert_allclose(read_foreign(path).trajectory.T_world_body, POSES, atol=1e-6)


def test_a_robot_in_a_plane_may_state_its_three_axes_alone(tmp_path):
    flat = se3.exp(np.outer(np.arange(N), [0.1, 0, 0, 0, 0, 0.05]))
    header = "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w,cov_xx,cov_yy,cov_yawyaw"
    q = se3.rotation_to_quaternion_xyzw(flat[:, :3, :3])
    lines = [",".join(map(str, [t, *T[:3, 3], *r, 1e-4, 2e-4, 1e-6])) for t, T, r in zip(T_NS, flat, q, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join([header, *lines]) + "\n")
    read = {"covariance_of": "motion", "covariance_axes": "body"}
    log = read_foreign(tmp_path / "a.csv", **read)
    np.testing.assert_allclose(np.diagonal(log.covariance[5])[[0, 1, 5]], [1e-4, 2e-4, 1e-6])
    assert all("imported" in r.covariances for r in to_records(log)[0][1:])
    assert not log.notes
    path = _csv(tmp_path / "b.csv", header, [[1e-4] * N, [2e-4] * N, [1e-6] * N])  # this one flies
    log = read_foreign(path, **read)
    assert log.covariance is None
    assert "it has no cov_22, cov_33, cov_44" in log.notes[-1]


@pytest.mark.filterwarnings("error")
def test_an_infinite_variance_is_an_unknown_one(tmp_path):
    header = "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w," + ",".join(f"cov_{i}{i}" for i in range(6))
    columns = [[1e-4] * 5 + ["inf"] + [1e-4] * (N - 6), *[[1e-4] * N] * 5]
    log = read_foreign(_csv(tmp_path / "a.csv", header, columns))
    assert np.isfinite(log.covariance).all(axis=(1, 2)).sum() == N - 1


@pytest.mark.parametrize("text", ["9300000000", "99000000000"])
def test_nanoseconds_that_count_from_zero_are_named(text):
    assert likely_unit(text) == "ns"
    assert "nanoseconds" in cure_of_seconds(text)


def test_covariance_follows_the_frame(tmp_path):
    header = "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w," + ",".join(f"cov_{i}{i}" for i in range(6))
    path = _csv(tmp_path / "a.csv", header, [[1e-4 * (i + 1)] * N for i in range(6)])
    log = read_foreign(path, covariance_of="motion", covariance_axes="body").seen_from(T_FLU_OPTICAL)
    np.testing.assert_allclose(np.diag(log.covariance[3]), [2e-4, 3e-4, 1e-4, 5e-4, 6e-4, 4e-4])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "not look like a trajectory"),
        ("a,b,c\n1,2,3\n", r"no column for t_s, p_x.*--map COLUMN=t_s"),
        ("t,x,y,z,qx,qy,qz,qw\n", "no rows"),
        ("t,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0\n", "line 2 holds 7 fields"),
        ("t,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,x\n", "line 2"),
        ("t,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n1,0,0,0,0,0,0,1\n", "line 3: the stamp .* repeats"),
        ("t,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,3\n", "length 3.0000"),
        ("t_ns,x,y,z,qx,qy,qz,qw\n99999999999999999999,0,0,0,0,0,0,1\n", "line 2: .* is not a stamp in nanosec"),
        ("t_ns,x,y,z,qx,qy,qz,qw\n1e999999999,0,0,0,0,0,0,1\n", "line 2: '1e9{9}' is not a stamp in nanosec"),
        ("t_ns,x,y,z,qx,qy,qz,qw\n-1e999999999,0,0,0,0,0,0,1\n", "line 2: '-1e9{9}' is not a stamp in nanosec"),
        ("t_ns,x,y,z,qx,qy,qz,qw\ninf,0,0,0,0,0,0,1\n", "line 2: 'inf' is not a stamp in nanosec"),
        ("1,0,0,0,0,0,0,1\n", "no header line"),
        ("t,gt_p_x,vo_p_x\n1,0,0\n", "'gt_p_x' and 'vo_p_x' may both be p_x .say which with --map COLUMN=p_x"),
        ("1 2 3\n", "not look like a trajectory"),
        ("t,vx,vy,vz\n1,0,0,0\n", "velocities alone are not read: integrate them to poses"),
        ("t,twist.twist.linear.x,twist.twist.linear.y\n1,0,0\n", "velocities alone are not read"),
        ("t,latitude,longitude,altitude,qx,qy,qz,qw\n1,48,11,0,0,0,0,1\n", "convert latitude and longitude to metres"),
        (
            "t," + ",".join(f"position[{k}]" for k in range(3)) + ",qx,qy,qz,qw\n",
            r"give --map 'position\[0\]=p_x' --map",
        ),
    ],
)
def test_bad_logs_in_one_line(tmp_path, text, reason):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(SourceError, match=reason) as caught:
        read_foreign(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("unit", "per_s"), [("us", 10**6), ("ms", 10**3)])
def test_stamps_in_other_units(tmp_path, unit, per_s):
    header = "timestamp,p_x,p_y,p_z,q_x,q_y,q_z,q_w"
    path = _csv(tmp_path / "a.csv", header)
    t = T_NS // 10**6 * 10**6
    text = path.read_text()
    for k in range(N):
        text = text.replace(str(T_NS[k]), str(int(t[k]) * per_s // 10**9))
    path.write_text(text)
    reason = (
        "look like microseconds.*--map timestamp=t_us"
        if unit == "us"
        else "line 2: '1403636579763' is not a stamp in seconds .*--map timestamp=t_ms"
    )
    with pytest.raises(SourceError, match=reason):
        read_foreign(path)
    np.testing.assert_array_equal(read_foreign(path, mapping={"timestamp": f"t_{unit}"}).t_ns, t)
    path.write_text(text.replace("timestamp", f"#timestamp [{unit}]"))
    np.testing.assert_array_equal(read_foreign(path).t_ns, t)


@pytest.mark.parametrize(("unit", "per_s"), [("us", 10**6), ("ms", 10**3)])
def test_stamps_since_the_start_in_other_units(tmp_path, unit, per_s):
    """Small enough for seconds; their intervals are none of an odometry."""
    t = [k * per_s // 20 for k in range(N)]
    path = _csv(tmp_path / "a.csv", "timestamp,p_x,p_y,p_z,q_x,q_y,q_z,q_w")
    text = path.read_text()
    for k in range(N):
        text = text.replace(str(T_NS[k]), str(t[k]))
    path.write_text(text)
    with pytest.raises(SourceError, match=f"--map timestamp=t_{unit}"):
        read_foreign(path)
    (tmp_path / "a.tum").write_text("\n".join(line.replace(",", " ") for line in text.splitlines()[1:]))
    with pytest.raises(SourceError, match=f"divide them by .*'t_{unit} p_x"):
        read_foreign(tmp_path / "a.tum")
    write_kitti_poses(tmp_path / "k", POSES)
    (tmp_path / "times").write_text("\n".join(map(str, t)))
    with pytest.raises(SourceError, match="times: the stamps look like .*holds seconds"):
        read_foreign(tmp_path / "k", times=tmp_path / "times")


def test_microseconds_at_a_low_rate(tmp_path):
    path = _csv(tmp_path / "a.csv", "timestamp,p_x,p_y,p_z,q_x,q_y,q_z,q_w", stamp="{}")
    text = path.read_text()
    for k in range(N):
        text = text.replace(str(T_NS[k]), str(1_400_000_000_000_000 + 500_000 * k))
    path.write_text(text)
    with pytest.raises(SourceError, match="look like microseconds.*--map timestamp=t_us"):
        read_foreign(path)
    assert read_foreign(path, mapping={"timestamp": "t_ns"}).t_ns[1] == 1_400_000_000_500_000
    assert read_foreign(path, mapping={"timestamp": "t_us"}).t_ns[1] == 1_400_000_000_500_000_000


def test_a_column_mapped_to_seconds_is_seconds(tmp_path):
    path = _csv(tmp_path / "a.csv", "when,p_x,p_y,p_z,q_x,q_y,q_z,q_w", stamp="{}")
    with pytest.raises(SourceError, match="line 2: '1403636579763555584' is not a stamp in seconds"):
        read_foreign(path, mapping={"when": "t_s"})
    text = path.read_text()
    for k in range(N):
        text = text.replace(str(T_NS[k]), f"{k * 50_000:016d}")
    path.write_text(text)
    with pytest.raises(SourceError, match="look like microseconds"):
        read_foreign(path, mapping={"when": "t_s"})


def test_bad_mapping(tmp_path):
    path = _csv(tmp_path / "a.csv", "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w")
    with pytest.raises(SourceError, match="unknown name 'speed'"):
        read_foreign(path, mapping={"p_x": "speed"})
    with pytest.raises(SourceError, match="no column 'foo'"):
        read_foreign(path, mapping={"foo": "p_x"})


def test_real_logs(real_data):
    vo, _ = to_records(read_foreign(real_data / "kitti_stereo_vo" / "00_est.txt"))
    assert len(vo) == 4541
    openvins, notes = to_records(read_foreign(real_data / "openvins_mh01_cov" / "MH01_ov_est.csv"))
    assert set(openvins[9].covariances) == {"imported_pose"}
    as_motions = read_foreign(real_data / "openvins_mh01_cov" / "MH01_ov_est.csv", covariance_of="motion")
    assert any("look like those of poses" in note for note in to_records(as_motions)[1])
    assert notes
    for name in ("odometry", "of_opencv_odometry", "optical_flow_odometry"):
        records, _ = to_records(read_foreign(real_data / "euroc_v1_01_vo" / f"stamped_{name}_trajectory_all.txt"))
        assert len(records) > 2600


@pytest.mark.parametrize("unseen", [0.0, 1e-9, 1e6])
@pytest.mark.parametrize("of", ["motion", "pose"])
def test_a_robot_in_a_plane_states_three_axes(tmp_path: Path, of: str, unseen: float) -> None:
    """Drivers of wheels state zero, or a constant, for height, roll and pitch: those do not unmake the others."""
    n, seen, variance = 60, [0, 1, 5], np.array([1e-6, 4e-6, 1e-6])
    motion, T, C = se3.exp(np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.02])), np.eye(4), np.diag([unseen] * 6)
    A, C[seen, seen] = se3.adjoint(se3.inverse(motion)), 0.0
    rows = []
    for k in range(n):
        q = se3.rotation_to_quaternion_xyzw(T[:3, :3])
        rows.append([1e9 * 0.05 * (k + 1), *T[:3, 3], *q, *C.ravel()])
        T = T @ motion
        C = A @ C @ A.T if of == "pose" else np.zeros((6, 6))
        C[seen, seen] += variance
        for axis in (2, 3, 4):
            C[axis], C[:, axis] = 0.0, 0.0
            C[axis, axis] = unseen
    names = ",".join(f"cov_{i}{j}" for i in range(6) for j in range(6))
    lines = [
        "t_ns,p_x,p_y,p_z,q_x,q_y,q_z,q_w," + names,
        *(",".join([str(int(r[0])), *map(repr, map(float, r[1:]))]) for r in rows),
    ]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    records, notes = to_records(read_foreign(tmp_path / "log.csv", covariance_of=of, covariance_axes="body"))
    assert not notes
    for r in records[1:]:
        stated = np.diag(r.covariances[IMPORTED])
        np.testing.assert_allclose(stated[seen], variance, rtol=1e-6)
        np.testing.assert_allclose(stated[2:5], max(unseen, SEEN**2))
