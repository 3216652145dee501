"""``gpvo fuse --twins``: what a filter would do, told without ground truth, beside what it did."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from gpvo.cli import app
from gpvo.dataset.errors import motion_errors
from gpvo.errors import GpvoError
from gpvo.evaluation.flights import flight_of
from gpvo.geometry import se3
from gpvo.io import open_source
from gpvo.io.run import read_run, write_run
from gpvo.runner import run
from gpvo.sim.paths import smooth_path
from gpvo.sim.points import simulate_points
from gpvo.twin.replicate import TwinSettings, make_twins
from gpvo.types import TruthLog, VoLog
from gpvo.vo.config import VoConfig
from typer.testing import CliRunner

WHAT = ("--policies", "triangulation,pointing_matching", "--json")


def fused(*arguments):
    done = CliRunner().invoke(app, ["fuse", *(str(a) for a in arguments)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Runs of one flight of twelve seconds: with its truth, and without."""
    folder = tmp_path_factory.mktemp("flown")
    flight = simulate_points("tunnel-clean", seed=21, duration_s=12.0, tracks=110)
    run(open_source(flight.save(folder / "flight.npz")), folder / "seen", keep_tracks=True)
    _without_truth(folder / "seen", folder / "blind")
    return folder / "seen", folder / "blind"


def _without_truth(path, out, imu_scale=1.0):
    real = read_run(path)
    imu = replace(real.imu, acc_mps2=imu_scale * real.imu.acc_mps2)
    write_run(out, real.log, config=asdict(VoConfig()), mounting=real.mounting, imu=imu)
    (out / "tracks.parquet").write_bytes((path / "tracks.parquet").read_bytes())
    return out


@pytest.mark.parametrize("imu", [(), ("--no-imu",)])
def test_twins_foretell_the_filters_error(flown, imu):
    seen, blind = flown
    own = json.loads(fused(seen, *WHAT, *imu))
    told = json.loads(fused(blind, "--twins", "--replicates", 4, *WHAT, *imu))
    assert own["simulated_truth"] == []
    assert [(s["of"], s["twins"], s["seed"]) for s in told["simulated_truth"]] == [("blind", 4, 1)]
    assert len(told["runs"]) == 4
    for policy in ("triangulation", "pointing_matching"):
        scores = [d["mean"][policy] for d in (own, told)]
        assert scores[1]["nis_dof"] == pytest.approx(scores[0]["nis_dof"], rel=0.35)
        # The error of one flight of 3 m is one draw; the mean is of four.
        assert 0.15 < scores[1]["ate_rmse_m"] / scores[0]["ate_rmse_m"] < 7.0


def test_runs_with_truth_are_filtered_as_they_are_and_that_is_told(flown):
    done = CliRunner().invoke(app, ["fuse", str(flown[0]), "--twins", "--no-imu", *WHAT])
    assert [r["run"] for r in json.loads(done.stdout)["runs"]] == ["seen"]
    assert "seen has ground truth: no twins are made of it" in done.stderr


def test_the_table_says_that_truth_is_simulated_and_fits_80_columns(flown):
    shown = fused(flown[1], "--twins", "--replicates", 2, "--policies", "pointing_matching", "--tolerance", "kitti")
    assert "blind has no ground truth: means over 2 twins, whose truth is simulated (tolerance kitti)" in shown
    table = shown[shown.index("\npolicy") + 1 :]
    assert max(map(len, table.splitlines())) <= 80
    assert "         2\n" in table


def test_the_imu_of_a_twin_flew_its_path(flown, tmp_path):
    twins = [read_run(p) for p in make_twins(flown[1], tmp_path, TwinSettings(replicates=2))]
    one, again, other = (flight_of(t) for t in (twins[0], twins[0], twins[1]))
    assert np.array_equal(one.imu.acc_mps2, again.imu.acc_mps2)
    assert not np.array_equal(one.imu.acc_mps2, other.imu.acc_mps2)
    t_ns = np.array([r.t_ns for r in one.records])
    frame = np.searchsorted(one.imu.t_ns, t_ns)
    turned = np.array([se3.so3_exp(w * 5e-3) for w in 0.5 * (one.imu.gyro_radps[1:] + one.imu.gyro_radps[:-1])])
    R = one.T_world_imu[:, :3, :3]
    off = []
    for i, j, a, b in zip(frame, frame[1:], R, R[1:]):
        whole = np.eye(3)
        for step in turned[i:j]:
            whole = whole @ step
        off.append(se3.so3_log(a.T @ b @ whole.T) / ((j - i) * 5e-3))
    noise = one.imu.noise.gyro_density_radps_sqrthz / np.sqrt(0.05)
    assert np.std(off, axis=0) == pytest.approx(noise, rel=0.25)
    # Its motions err as those of the twin do.
    errors = [
        motion_errors(VoLog(r), t).xi
        for r, t in (
            (twins[0].log.records, twins[0].truth),
            (one.records, TruthLog(t_ns, one.T_world_cam)),
        )
    ]
    assert np.allclose(*errors, atol=1e-9)
    # Gravity is where the run's own IMU has it, and the bias no larger than a filter expects.
    force = np.einsum("nij,nj->ni", R, one.imu.acc_mps2[frame])
    assert force.mean(axis=0) == pytest.approx([0.0, 0.0, 9.81], abs=0.25)


def test_an_imu_in_other_units_is_refused_on_twins_too(flown, tmp_path):
    wrong = _without_truth(flown[0], tmp_path / "in_g", 1 / 9.80665)
    with pytest.raises(GpvoError, match="it is in g"):
        fused(wrong, "--twins", "--replicates", 2, *WHAT)


def test_a_smooth_path_is_near_its_poses_and_does_not_jitter():
    t_s = np.arange(200) * 0.05
    flown = np.stack([t_s, np.sin(t_s), 0 * t_s], axis=1)
    R = se3.so3_exp(np.stack([0 * t_s, 0.3 * np.sin(t_s), 0.2 * t_s], axis=1))
    noise_m = 1e-3 * np.random.default_rng(0).standard_normal((200, 3))
    path = smooth_path(t_s, se3.from_rt(R, flown + noise_m))
    inside = slice(10, -10)
    assert np.abs(path.position(t_s) - flown)[inside].max() < 6e-3
    assert np.abs(se3.so3_log(np.swapaxes(path.attitude(t_s), 1, 2) @ R))[inside].max() < 3e-3
    jitter = np.diff(path.position(t_s) - flown, n=2, axis=0)[inside] / 0.05**2
    assert jitter.std() < 0.05 * (np.diff(noise_m, n=2, axis=0) / 0.05**2).std()
