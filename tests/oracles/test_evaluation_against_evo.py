"""ATE and RPE are evo's, on the same files."""

from __future__ import annotations

import numpy as np
import pytest
from evaluation_runs import make_run
from gpvo.evaluation.trajectory import pairs_ahead, rpe, trajectory_errors
from gpvo.geometry import se3
from gpvo.io.trajectory import read_tum, write_tum

metrics = pytest.importorskip("evo.core.metrics", reason="the test oracle evo is not installed")
file_interface = pytest.importorskip("evo.tools.file_interface")

Relation = metrics.PoseRelation


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Estimate and truth in two files, as ours (t_ns, T_est, T_true) and as evo's trajectories."""
    folder = tmp_path_factory.mktemp("evo")
    log, truth = make_run(600)
    write_tum(folder / "est.tum", log.t_ns, log.trajectory())
    write_tum(folder / "true.tum", truth.t_ns, truth.T_world_cam)
    ours = read_tum(folder / "est.tum"), read_tum(folder / "true.tum")
    theirs = [file_interface.read_tum_trajectory_file(folder / name) for name in ("est.tum", "true.tum")]
    return (ours[0].t_ns, ours[0].T_world_body, ours[1].T_world_body), theirs


def _rpe(theirs, relation, delta, unit, all_pairs=True):
    metric = metrics.RPE(relation, delta=delta, delta_unit=unit, all_pairs=all_pairs, rel_delta_tol=0.1)
    metric.process_data((theirs[1], theirs[0]))
    return metric.get_all_statistics()


def test_ate_after_alignment(files):
    import copy

    ours, theirs = files
    e = trajectory_errors(*ours)
    aligned = copy.deepcopy(theirs[0])
    aligned.align(theirs[1], correct_scale=False)
    metric = metrics.APE(Relation.translation_part)
    metric.process_data((theirs[1], aligned))
    assert e.ate_rmse_m == pytest.approx(metric.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)


def test_error_with_the_first_poses_made_equal(files):
    import copy

    ours, theirs = files
    e = trajectory_errors(*ours)
    aligned = copy.deepcopy(theirs[0])
    aligned.align_origin(theirs[1])
    metric = metrics.APE(Relation.translation_part)
    metric.process_data((theirs[1], aligned))
    assert e.rmse_origin_m == pytest.approx(metric.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)
    assert e.final_error_m == pytest.approx(metric.error[-1], abs=1e-9)


@pytest.mark.parametrize("frames", [1, 20])
def test_rpe_over_frames(files, frames):
    ours, theirs = files
    start = np.arange(len(ours[0]) - frames)
    found = rpe(ours[1], ours[2], start, start + frames)
    for mine, relation in (
        (found.translation_m, Relation.translation_part),
        (found.rotation_rad, Relation.rotation_angle_rad),
    ):
        stats = _rpe(theirs, relation, frames, metrics.Unit.frames)
        for name in ("rmse", "mean", "median", "std", "min", "max"):
            assert getattr(mine, name) == pytest.approx(stats[name], abs=1e-9), name


def test_rpe_of_the_evaluation_is_per_frame_and_per_second(files):
    ours, theirs = files
    e = trajectory_errors(*ours)
    # 20 Hz: a second is twenty frames.
    for found, frames in ((e.rpe_frame, 1), (e.rpe_second, 20)):
        stats = _rpe(theirs, Relation.translation_part, frames, metrics.Unit.frames)
        assert found.translation_m.rmse == pytest.approx(stats["rmse"], abs=1e-9)
        stats = _rpe(theirs, Relation.rotation_angle_rad, frames, metrics.Unit.frames)
        assert found.rotation_rad.rmse == pytest.approx(stats["rmse"], abs=1e-9)


def test_ten_metres_are_counted_along_the_path(files):
    ours, _ = files
    arc = se3.path_length_m(ours[2][:, :3, 3])
    assert arc[-1] == pytest.approx(files[1][1].path_length, abs=1e-9)
    start, end = pairs_ahead(arc, 10.0)
    assert (arc[end] - arc[start] >= 10 * (1 - 1e-9)).all()
    assert (arc[end - 1] - arc[start] < 10).all()
    assert np.isfinite(se3.log(ours[1])).all()
