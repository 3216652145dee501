"""Trajectory files: round trips, and errors that name file, line and cure."""

from __future__ import annotations

import numpy as np
import pytest
from foreign_trajectories import write_euroc_csv, write_kitti_poses
from gpvo.errors import SourceError
from gpvo.geometry import se3
from gpvo.io.stamps import ns_to_seconds_text, text_to_ns
from gpvo.io.trajectory import (
    read_euroc_csv,
    read_kitti_poses,
    read_times,
    read_tum,
    write_tum,
)

T_NS = np.array([1_403_636_579_763_555_584 + k * 50_000_001 for k in range(30)])
POSES = se3.exp(np.random.default_rng(0).normal(size=(30, 6)))


def test_tum_round_trip(tmp_path):
    write_tum(tmp_path / "a.tum", T_NS, POSES)
    back = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(back.t_ns, T_NS)
    np.testing.assert_allclose(back.T_world_body, POSES, atol=1e-8)
    first = (tmp_path / "a.tum").read_text().splitlines()[0]
    assert first.startswith("1403636579.763555584 ")
    assert len(first.split(" ")) == 8


def test_euroc_round_trip(tmp_path):
    write_euroc_csv(tmp_path / "a.csv", T_NS, POSES)
    back = read_euroc_csv(tmp_path / "a.csv")
    np.testing.assert_array_equal(back.t_ns, T_NS)
    np.testing.assert_allclose(back.T_world_body, POSES, atol=1e-8)


def test_kitti_round_trip(tmp_path):
    write_kitti_poses(tmp_path / "a.txt", POSES)
    np.testing.assert_allclose(read_kitti_poses(tmp_path / "a.txt"), POSES, atol=1e-9)


GOOD = "10.0 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "holds no poses"),
        ("# only a comment\n", "holds no poses"),
        (GOOD + "# c\n11.0 nan 0 0 0 0 0 1\n", "line 3 holds NaN"),
        (GOOD + "11.0 0 0 inf 0 0 0 1\n", "line 2 holds NaN or infinity"),
        (GOOD + "11.0 0 0 0 0 0 1\n", "line 2 holds 7 fields, expected 8"),
        (GOOD + "11.0 0 0 0 0 0 0 1 5\n", "line 2 holds 9 fields, expected 8"),
        (GOOD + "11.0 0 0 x 0 0 0 1\n", "line 2 holds something that is not a number"),
        (GOOD + "nan 0 0 0 0 0 0 1\n", "line 2"),
        (GOOD + "ten 0 0 0 0 0 0 1\n", "line 2: 'ten' is not a number"),
        (GOOD + GOOD, "line 2: the stamp 10.000000000 s repeats"),
        (GOOD + "9.5 0 0 0 0 0 0 1\n", "line 2: the stamp 9.500000000 s goes back"),
        (GOOD + "11.0 0 0 0 0 0 0 2\n", "line 2: the quaternion has length 2.0000"),
        (GOOD + "1403636579763555584 0 0 0 0 0 0 1\n", "not a stamp in seconds"),
    ],
)
def test_bad_tum(tmp_path, text, reason):
    path = tmp_path / "bad.tum"
    path.write_text(text)
    with pytest.raises(SourceError, match=reason) as caught:
        read_tum(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bad_kitti_and_times(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1\n")
    with pytest.raises(SourceError, match="line 2 holds 11 numbers"):
        read_kitti_poses(path)
    path.write_text("2 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(SourceError, match="pose 1 is not a rigid transform"):
        read_kitti_poses(path)
    path.write_text("0.0\n0.1 0.2\n")
    with pytest.raises(SourceError, match="line 2"):
        read_times(path)
    with pytest.raises(SourceError, match="cannot be read: No such file"):
        read_tum(tmp_path / "nothing.tum")


def test_waypoints_may_be_far_apart(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text("".join(f"{60 * k} {k} 0 0 0 0 0 1\n" for k in range(5)))
    assert len(read_tum(path, any_spacing=True)) == 5
    with pytest.raises(SourceError, match="look like milliseconds: .*interval is 60 s .*'t_ms p_x"):
        read_tum(path)


def test_the_cure_of_a_kitti_pose_that_is_none_keeps_the_stamps_of_the_others(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 nan 0 1 0 0 0 0 1 0\n")
    with pytest.raises(SourceError, match="line 2 holds NaN or infinity .*and its stamp.*--times"):
        read_kitti_poses(path)


@pytest.mark.parametrize(("digits", "cure"), [(5, "12 of 20 do .they are rounded"), (7, None)])
def test_stamps_that_were_rounded_are_not_dropped(tmp_path, digits, cure):
    path = tmp_path / "a.tum"
    path.write_text("".join(f"{1000 + 0.035 * k:.{digits}g} 0 0 0 0 0 0 1\n" for k in range(20)))
    if cure is None:
        assert len(read_tum(path)) == 20
        return
    with pytest.raises(SourceError, match=f"repeats, as {cure}"):
        read_tum(path)


def test_a_single_line_that_is_there_twice_can_be_dropped(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text("".join(f"{k} 0 0 0 0 0 0 1\n" for k in [0, 1, 2, 3, 3, 4, 5]))
    with pytest.raises(SourceError, match="the stamp 3.0* s repeats .sort the file by time and drop repeated lines"):
        read_tum(path)


def test_quaternions_that_are_nearly_unit_are_normalised(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text("1.0 0 0 0 0 0 0.7071 0.7072\n")
    R = read_tum(path).T_world_body[0, :3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize(
    ("text", "t_ns"),
    [
        ("1403715274.302142858505", 1_403_715_274_302_142_859),
        ("1403715274.302142858", 1_403_715_274_302_142_858),
        ("1.403715274302142858e9", 1_403_715_274_302_142_858),
        ("0.1", 100_000_000),
        ("-0.5", -500_000_000),
    ],
)
def test_stamps_keep_their_nanoseconds(text, t_ns):
    assert text_to_ns(text) == t_ns
    assert text_to_ns(ns_to_seconds_text(t_ns)) == t_ns


@pytest.mark.parametrize("digits", [9, 6, 3])
@pytest.mark.parametrize("rate_hz", [2.0, 5.0, 30.0])
def test_fractions_without_their_leading_zeros(tmp_path, digits, rate_hz):
    """What a program writes that prints whole nanoseconds behind whole seconds; honest ones print fewer digits, too."""
    unit = 10**digits
    rng = np.random.default_rng(digits)
    t = 1_700_000_000 * unit + np.rint((0.0123 + (np.arange(400) + 0.02 * rng.random(400)) / rate_hz) * unit)
    parts = [divmod(int(k), unit) for k in t]
    pose = " 0 0 0 0 0 0 1\n"
    for honest in ([f"{s}.{n:0{digits}d}" for s, n in parts], [f"{s}.{n:0{digits}d}".rstrip("0") for s, n in parts]):
        (tmp_path / "t.tum").write_text("".join(stamp + pose for stamp in honest))
        assert len(read_tum(tmp_path / "t.tum")) == 400
    (tmp_path / "t.tum").write_text("".join(f"{s}.{n}{pose}" for s, n in parts))
    with pytest.raises(SourceError, match="lack their leading zeros") as caught:
        read_tum(tmp_path / "t.tum")
    assert str(caught.value).endswith(f"(write seconds and nanoseconds as %d.%0{digits}d)")
    assert "\n" not in str(caught.value)


def test_times_are_seconds_or_dates(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text("# of the left camera\ntimestamps\n2011-09-26 13:02:25.964389445\n2011-09-26T13:02:26Z\n1.5\n")
    assert read_times(path).tolist() == [1_317_042_145_964_389_445, 1_317_042_146_000_000_000, 1_500_000_000]
    for line in ("2011-02-30 13:02:25", "2011-09-26", "names below"):
        path.write_text(f"1.0\n{line}\n")
        with pytest.raises(SourceError, match=r"t\.txt: line 2: "):
            read_times(path)
