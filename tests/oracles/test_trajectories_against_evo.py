"""Files that gpvo writes are read by evo, and the other way round, to the digits written."""

from __future__ import annotations

import numpy as np
import pytest
from foreign_trajectories import write_euroc_csv, write_kitti_poses
from gpvo.geometry import se3
from gpvo.io.trajectory import (
    read_euroc_csv,
    read_kitti_poses,
    read_tum,
    write_tum,
)

file_interface = pytest.importorskip("evo.tools.file_interface")

T_NS = np.array([1_403_636_579_763_555_584 + k * 50_000_000 for k in range(40)])
POSES = se3.exp(np.random.default_rng(1).normal(size=(40, 6)))


@pytest.mark.parametrize(
    ("write", "read"),
    [(write_tum, "read_tum_trajectory_file"), (write_euroc_csv, "read_euroc_csv_trajectory")],
)
def test_evo_reads_what_we_write(tmp_path, write, read):
    write(tmp_path / "a.txt", T_NS, POSES)
    theirs = getattr(file_interface, read)(tmp_path / "a.txt")
    np.testing.assert_allclose(theirs.timestamps, T_NS * 1e-9, atol=1e-6)
    np.testing.assert_allclose(np.array(theirs.poses_se3), POSES, atol=3e-9)
    assert theirs.check()[0]


def test_evo_reads_our_kitti_poses(tmp_path):
    write_kitti_poses(tmp_path / "a.txt", POSES)
    theirs = file_interface.read_kitti_poses_file(tmp_path / "a.txt")
    np.testing.assert_allclose(np.array(theirs.poses_se3), POSES, atol=1e-9)


def test_we_read_what_evo_writes(tmp_path):
    write_tum(tmp_path / "a.tum", T_NS, POSES)
    trajectory = file_interface.read_tum_trajectory_file(tmp_path / "a.tum")
    file_interface.write_tum_trajectory_file(tmp_path / "b.tum", trajectory)
    file_interface.write_kitti_poses_file(tmp_path / "b.txt", trajectory)
    ours = read_tum(tmp_path / "b.tum")
    np.testing.assert_allclose(ours.T_world_body, POSES, atol=1e-8)
    np.testing.assert_allclose(ours.t_ns, T_NS, atol=1000)
    np.testing.assert_allclose(read_kitti_poses(tmp_path / "b.txt"), POSES, atol=1e-8)
    write_euroc_csv(tmp_path / "c.csv", T_NS, POSES)
    np.testing.assert_allclose(read_euroc_csv(tmp_path / "c.csv").T_world_body, POSES, atol=1e-8)


def test_run_folders_trajectory_is_read_by_evo(tmp_path):
    from gpvo.io.run import write_run
    from gpvo.types import Status, VoLog, VoRecord

    records = [VoRecord(int(T_NS[0]), int(T_NS[0]), Status.START, np.eye(4))]
    motions = se3.inverse(POSES[:-1]) @ POSES[1:]
    records += [VoRecord(int(T_NS[k + 1]), int(T_NS[k]), Status.OK, M) for k, M in enumerate(motions)]
    write_run(tmp_path / "run", VoLog(records))
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "run" / "trajectory.tum")
    np.testing.assert_allclose(np.array(theirs.poses_se3), se3.inverse(POSES[0]) @ POSES, atol=1e-7)
