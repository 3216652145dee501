"""Twins of simulated flights: the same conditions, other noise, exact truth; and the commands around them."""

import json
import shutil
import warnings
from dataclasses import asdict, replace

import numpy as np
import pytest
from gpvo.cameras.rig import TOLERANCES, Tolerance, TrueRig
from gpvo.dataset.errors import motion_errors
from gpvo.dataset.truth_noise import TruthNoise
from gpvo.errors import GpvoError, SourceError
from gpvo.evaluation.by_twins import ratios, twin_covariance
from gpvo.geometry import se3
from gpvo.io import open_source
from gpvo.io.run import copy_run, read_run
from gpvo.runner import run
from gpvo.sim.points import simulate_points
from gpvo.twin import replicate
from gpvo.twin.gap import Gap, pooled, read_gap
from gpvo.twin.replicate import TwinSettings, estimate, make_twins, read_tolerance, rig_errors, twin_source
from gpvo.types import StereoCamera
from gpvo.vo.config import VoConfig
from gpvo.vo.rig_error import N_COEFFICIENTS, N_TERMS, RigState
from gpvo.vo.rig_findings import read_start, read_state
from typer.testing import CliRunner


def gpvo(*arguments):
    from gpvo.cli import app

    return CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)


@pytest.fixture(scope="module")
def original(flown):
    """What that run says of its points and their noise."""
    return estimate(flown[0] / "run")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A flight of eight seconds with a dark second, its run, and three twins."""
    folder = tmp_path_factory.mktemp("twins")
    flight = simulate_points("tunnel-clean", seed=11, duration_s=8.0, tracks=110, dark=(3.0, 3.5))
    run(open_source(flight.save(folder / "flight.npz")), folder / "run", keep_tracks=True)
    made = make_twins(folder / "run", folder / "twins", TwinSettings(replicates=3))
    return folder, read_run(folder / "run"), [read_run(p) for p in made]


def test_twins_err_as_much_as_the_flight_did(flown):
    _, real, twins = flown
    own = motion_errors(real.log, real.truth).xi
    drawn = np.concatenate([motion_errors(t.log, t.truth).xi for t in twins])
    ratio = np.sqrt((drawn**2).mean(axis=0) / (own**2).mean(axis=0))
    # 150 motions: a standard deviation is known to 6 %, more or less by their correlation.
    assert ((ratio > 0.7) & (ratio < 1.4)).all()
    assert abs(np.log(ratio).mean()) < 0.15


def test_finished_twins_of_the_same_run_and_settings_are_kept(flown, tmp_path, monkeypatch):
    shutil.copytree(flown[0] / "twins", tmp_path / "twins")
    shutil.rmtree(tmp_path / "twins" / "run-twin1")
    make, made, told, all_three = replicate._make_twin, [], [], [0, 1, 2]
    monkeypatch.setattr(replicate, "_make_twin", lambda *of: made.append(of[2]) or make(*of))
    for seed, wanted in ((0, [1]), (0, []), (1, all_three)):
        settings = TwinSettings(replicates=3, seed=seed)
        found = make_twins(flown[0] / "run", tmp_path / "twins", settings, on_twin=lambda: told.append(1))
        assert found == [tmp_path / "twins" / f"run-twin{k}" for k in all_three]
        assert made == wanted
        if seed == 0:
            again = [read_run(p).log.trajectory() for p in found]
            assert [a.tobytes() for a in again] == [t.log.trajectory().tobytes() for t in flown[2]]
        made.clear()
    assert len(told) == 9
    shutil.copytree(flown[0] / "run", tmp_path / "run")
    (tmp_path / "run" / "config.toml").write_text((tmp_path / "run" / "config.toml").read_text() + "# other\n")
    make_twins(tmp_path / "run", tmp_path / "twins", settings)
    assert made == all_three
    made.clear()
    (tmp_path / "twins" / "run-twin2" / "vo_log.parquet").write_bytes(b"PAR1")
    make_twins(tmp_path / "run", tmp_path / "twins", settings)
    assert made == [2]  # which was damaged


def test_twins_see_what_the_flight_saw(flown):
    _, real, twins = flown
    for twin in twins:
        assert (twin.log.t_ns == real.log.t_ns).all()
        for name in ("n_inliers", "n_tracked", "reproj_rms_px", "disparity_p50_px"):
            own, drawn = (np.nanmedian(r.log.column(name)[r.log.usable]) for r in (real, twin))
            assert drawn == pytest.approx(own, rel=0.08)
        assert np.mean(twin.log.usable == real.log.usable) > 0.97
        assert (real.log.column("n_stereo") == twin.log.column("n_stereo")).all()


def test_an_outlier_whose_landmark_lies_in_the_camera_is_not_seen(original):
    structure, seen = original.structure, original.seen
    odd = int(np.flatnonzero(structure.weight == 0)[0])
    points = structure.points_world.copy()
    points[seen.track[odd]] = structure.T_world_cam[seen.frame[odd]] @ [1.0, 1.0, 1e-14, 1.0] @ np.eye(4, 3)
    twin = twin_source(replace(original, structure=replace(structure, points_world=points)), TwinSettings(), 0)
    for frame in twin.frames:
        assert (np.abs(np.stack([frame.uv_left, frame.uv_right])) < 2 * seen.camera.width).all()
    assert seen.track[odd] not in twin.frames[seen.frame[odd]].track


def test_noise_of_a_point_seen_twice_keeps_the_difference_of_its_measurements(original):
    length = np.bincount(original.seen.track)
    used = np.bincount(original.seen.track, original.structure.weight > 0)
    twice = np.flatnonzero((length == 2) & (used == 2))
    assert len(twice) > 20
    for track in twice[:20]:
        rows = np.flatnonzero(original.seen.track == track)
        left = original.structure.residual_px[rows]
        assert np.isfinite(left).all()
        # The fit halves the difference of two like measurements between them.
        assert np.abs(left.sum(axis=0)).max() < 0.5 * np.abs(left).sum() + 1e-3


def test_equal_seeds_make_equal_bytes_and_other_replicates_other_noise(flown, original):
    again = estimate(flown[0] / "run")
    one, two, other = (twin_source(o, TwinSettings(), k) for o, k in ((original, 0), (again, 0), (original, 1)))
    for a, b in zip(one.frames, two.frames, strict=True):
        assert a.uv_left.tobytes() == b.uv_left.tobytes()
        assert a.uv_right.tobytes() == b.uv_right.tobytes()
    assert not np.array_equal(one.frames[5].uv_left, other.frames[5].uv_left)


def test_frames_without_tracks_stay_without(original):
    dark = [k for k, r in enumerate(original.run.log) if not r.usable and k]
    assert dark
    assert any(len(twin_source(original, TwinSettings(), 0).frames[k].track) == 0 for k in dark)


def test_a_run_that_is_lost_for_most_of_its_time_has_twins(tmp_path):
    flight = simulate_points("tunnel-clean", seed=3, duration_s=4.0, tracks=80, dark=(1.0, 3.5), rest_s=0.0)
    run(open_source(flight.save(tmp_path / "flight.npz")), tmp_path / "run", keep_tracks=True)
    original = estimate(tmp_path / "run")
    usable = original.run.log.usable
    assert usable.mean() < 0.5
    # White noise of 0.15 px, as the flight has, give or take its own 15 %.
    assert np.nanmedian(original.structure.sigma_px[usable]) == pytest.approx(0.15, rel=0.4)


def test_each_twin_draws_its_own_rig(original):
    wide = TwinSettings(tolerance=Tolerance(baseline=0.05))
    e = rig_errors(wide)[:, :5]
    assert np.allclose(e.T @ e / len(e), np.eye(5))
    assert np.ptp(e[:, 0]) > 1.0
    disparity = [
        np.median(np.concatenate([(f.uv_left - f.uv_right)[:, 0] for f in twin_source(original, wide, k).frames]))
        for k in range(6)
    ]
    assert 0.01 < np.std(disparity) / np.mean(disparity) < 0.15


def test_the_rig_of_a_twin_is_wrong_as_odometry_found_it(original):
    fx = original.seen.camera.fx_px
    n = N_COEFFICIENTS
    mean, covariance = np.zeros(n), np.zeros((n, n))
    mean[[0, N_TERMS]], covariance[0, 0] = (2e-3, 1e-3), 3e-4**2  # the right image too far right, and too low

    def right(rig, k):
        frames = twin_source(replace(original, rig=rig), TwinSettings(), k).frames
        return np.concatenate([f.uv_right for f in frames])

    shift = np.stack([right(RigState(mean, covariance, 1.0), k).mean(axis=0) for k in range(8)])
    noise = np.stack([right(RigState.exact(), k).mean(axis=0) for k in range(8)])
    x, y = (shift - noise).T / fx
    assert y == pytest.approx(1e-3, rel=1e-3)
    # Moment matching: over eight twins the draws have unit size exactly.
    assert np.sqrt(np.mean((x - 2e-3) ** 2)) == pytest.approx(3e-4, rel=1e-3)


def test_a_run_without_self_calibration_has_twins_turned_by_the_tolerance(flown, tmp_path):
    run(open_source(flown[0] / "flight.npz"), tmp_path / "run", VoConfig(self_calibration=False), keep_tracks=True)
    original = estimate(tmp_path / "run")
    assert not original.rig.covariance.any()
    settings, rad = TwinSettings(tolerance=Tolerance(rotation_rad=1e-3)), 1e-3
    # Over eight twins the draws have unit size exactly; a turn about the horizontal axis moves rows by f.
    rows = [
        np.median(np.concatenate([(f.uv_right - f.uv_left)[:, 1] for f in twin_source(original, settings, k).frames]))
        for k in range(8)
    ]
    assert np.sqrt(np.mean(np.square(rows))) == pytest.approx(rad * original.seen.camera.fy_px, rel=0.2)


@pytest.mark.slow
def test_twins_know_of_their_rig_at_first_what_their_run_did(flown, tmp_path):
    flight, camera = open_source(flown[0] / "flight.npz"), flown[1].log.camera
    known = read_state(flown[0] / "run", camera)
    run(flight, tmp_path / "run", keep_tracks=True, calibration_state=known)
    [twin] = make_twins(tmp_path / "run", tmp_path / "twins", TwinSettings(replicates=1))
    assert read_start(flown[0] / "run", camera) is None
    for path in (tmp_path / "run", twin):
        start = read_start(path, camera)
        np.testing.assert_allclose(start.mean, known.mean)
        np.testing.assert_allclose(start.covariance, known.covariance, atol=1e-12)


def test_ratios_of_real_errors_to_those_that_twins_predict(flown, tmp_path):
    folder, real, _ = flown
    made = gpvo("twin", folder / "run", "--against", "--replicates", 3, "--json")
    (tmp_path / "gap.json").write_text(made.stdout)
    gap = read_gap(str(tmp_path / "gap.json"))
    # Seven windows of a second: a standard deviation is known to a quarter.
    assert all(0.4 < r < 2.5 for r in gap.ratio)
    assert gap.spread == (1.0,) * 6  # one run alone shows none
    assert json.loads(made.stdout)["pooled"]["10 m"]["ratio"] == [None] * 6
    shown = gpvo("twin", folder / "run", "--against", "--replicates", 2).stdout
    assert "1 s" in shown
    assert "nan" not in shown  # a flight of less than ten metres has no row for them
    with pytest.raises(SourceError, match="no ground truth"):
        ratios(replace(real, truth=None), [])


def test_ratios_know_of_a_truth_that_is_turned(flown, tmp_path):
    folder, real, _ = flown
    turn = se3.exp(np.array([0.0, 0.0, 0.0, 0.05, 0.0, 0.0]))
    copy_run(real, tmp_path / "run", replace(real.truth, T_world_cam=real.truth.T_world_cam @ turn))
    as_is, fitted = (
        json.loads(gpvo("twin", tmp_path / "run", "--against", "--replicates", 2, "--json", *option).stdout)
        for option in ((), ("--align", "rotation"))
    )
    ratio = [r["pooled"]["1 s"]["ratio"][1] for r in (as_is, fitted)]
    assert ratio[0] > 3.0
    assert 0.4 < ratio[1] < 2.5
    for wrong in (("-o", tmp_path / "twins", "--align", "rotation"), ("--against", "--align", "sideways")):
        with pytest.raises(GpvoError, match="--against|sideways"):
            gpvo("twin", folder / "run", *wrong)


def test_a_gap_makes_the_errors_of_twins_larger(flown, tmp_path):
    folder, _, twins = flown
    gap = Gap((1.0, 2.0, 3.0, 1.0, 1.0, 4.0), (1.0,) * 6)
    made = make_twins(folder / "run", tmp_path, TwinSettings(replicates=3, gap=gap))
    wide = read_run(made[0])
    ratio = motion_errors(wide.log, wide.truth).xi / motion_errors(twins[0].log, twins[0].truth).xi
    assert np.median(ratio, axis=0) == pytest.approx(gap.ratio, rel=1e-3)
    spread = Gap((2.0,) * 6, (1.5,) * 6).factors(7)
    assert spread[3] == pytest.approx(2.0)
    assert np.exp(np.log(spread[:, 0]).std()) == pytest.approx(1.5, rel=0.1)


def test_gaps_pool_over_runs_and_bad_files_are_refused(tmp_path):
    assert len(read_gap("drives").ratio) == 6
    mean, spread = pooled(np.array([[2.0, np.nan], [8.0, np.nan]]))
    assert mean[0] == pytest.approx(4.0)
    assert spread[0] == pytest.approx(np.exp(np.log(2.0) * np.sqrt(2)))
    assert np.isnan(mean[1])
    file = tmp_path / "gap.json"
    for text in ("{}", '{"pooled": {"1 s": {"ratio": [1], "spread": [1]}}}', '{"pooled": {"1 s": null}}'):
        file.write_text(text)
        with pytest.raises(SourceError, match="is not the output of"):
            read_gap(str(file))
    values = {"ratio": [1.0] * 6, "spread": [1.0] * 5 + [1e9]}
    file.write_text(json.dumps({"pooled": {"1 s": values}}))
    with pytest.raises(SourceError, match="is not the output of"):
        read_gap(str(file))


@pytest.mark.slow
def test_twins_of_a_wrong_baseline_are_too_sure_without_a_tolerance(tmp_path):
    """A baseline written 3 % too long makes the path 3 % too long, which leaves nothing in the residuals."""
    flight = simulate_points("tunnel-clean", seed=12, duration_s=12.0, tracks=110)
    camera = replace(flight.scenario.camera, baseline_m=1.03 * flight.scenario.camera.baseline_m)
    written = replace(flight, scenario=replace(flight.scenario, camera=camera)).save(tmp_path / "flight.npz")
    run(open_source(written), tmp_path / "run", keep_tracks=True)

    def forward_mm(of):
        z = motion_errors(of.log, of.truth).xi[:, 2]
        return 1e3 * np.sqrt((z[: len(z) // 20 * 20].reshape(-1, 20).mean(axis=1) ** 2).mean())

    def ratio(tolerance):
        made = make_twins(tmp_path / "run", tmp_path / f"{tolerance}", TwinSettings(6, Tolerance(baseline=tolerance)))
        return forward_mm(read_run(tmp_path / "run")) / np.sqrt(np.mean([forward_mm(read_run(p)) ** 2 for p in made]))

    assert ratio(0.0) > 3.0
    assert 0.6 < ratio(0.03) < 1.6


def test_a_rig_without_tolerance_is_the_calibrated_one():
    camera = StereoCamera(400.0, 400.0, 319.5, 239.5, 0.1, 640, 480)
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 9], (50, 3))
    left, right = TrueRig.of(camera, Tolerance(), np.ones(5)).pixels(points)
    assert np.allclose(np.c_[left[:, 0], left[:, 1], left[:, 0] - right[:, 0]], camera.project(points))
    assert np.allclose(left[:, 1], right[:, 1])


def test_sample_covariance_is_that_of_the_draws():
    """Monte Carlo: 40 twins of 60 motions whose covariance grows tenfold on the way; on average within 15 %."""
    from gpvo.geometry import se3
    from gpvo.io.run import Run
    from gpvo.types import Mounting, Status, TruthLog, VoLog, VoRecord

    rng = np.random.default_rng(5)
    t_ns = np.arange(61) * 50_000_000
    root = np.linalg.cholesky(np.diag([1e-6] * 6) + 4e-7)
    size = np.geomspace(1.0, 10.0, 61)
    truth = TruthLog(t_ns, np.tile(np.eye(4), (61, 1, 1)))

    def drawn():
        xi = np.sqrt(size)[:, None] * (rng.standard_normal((61, 6)) @ root.T)
        records = [
            VoRecord(int(t), int(t_ns[max(k - 1, 0)]), Status.OK if k else Status.START, se3.exp(xi[k] * (k > 0)))
            for k, t in enumerate(t_ns)
        ]
        return Run(None, "t", VoLog(records), truth, None, Mounting(), [])

    twins = [drawn() for _ in range(40)]
    found = twin_covariance(twins[0].log, twins)
    expected = size[1:, None, None] * (root @ root.T)
    ratio = np.linalg.solve(expected, found[1:])
    assert np.isnan(found[0]).all()
    assert np.trace(ratio, axis1=1, axis2=2).mean() / 6 == pytest.approx(1.0, abs=0.15)


@pytest.fixture(scope="module")
def blind(flown, tmp_path_factory):
    """The same run without its truth."""
    from gpvo.io.run import write_run

    folder, real, _ = flown
    path = tmp_path_factory.mktemp("blind") / "blind"
    write_run(path, real.log, config=asdict(VoConfig()), mounting=real.mounting)
    (path / "tracks.parquet").write_bytes((folder / "run" / "tracks.parquet").read_bytes())
    return path


def test_the_command_makes_runs_with_exact_truth(blind, tmp_path):
    made = gpvo("twin", blind, "-o", tmp_path / "t", "--replicates", 2, "--tolerance", "kitti", "--json")
    twins = [read_run(p) for p in json.loads(made.stdout)["twins"]]
    assert [t.meta["twin"]["tolerance_name"] for t in twins] == ["kitti"] * 2
    assert all(t.truth.sigma_translation_m == 0.0 for t in twins)


def test_twins_of_an_earlier_call_do_not_stay_among_those_of_this(blind, tmp_path):
    gpvo("twin", blind, "-o", tmp_path / "t", "--replicates", 3)
    with pytest.raises(SourceError, match="blind-twin2: is a twin that 2 replicates would not replace"):
        gpvo("twin", blind, "-o", tmp_path / "t", "--replicates", 2)
    # As a process leaves it that is killed while it replaces a twin.
    (tmp_path / "t" / "blind" / ".blind-twin0.new").mkdir()
    assert gpvo("twin", blind, "-o", tmp_path / "t", "--replicates", 3).exit_code == 0


def test_a_run_without_truth_is_refused_before_twins_are_made_to_compare_it_with(blind, tmp_path):
    with pytest.raises(GpvoError, match="no ground truth to compare"):
        gpvo("twin", blind, "-o", tmp_path / "t", "--against")
    assert not (tmp_path / "t").exists()


def test_evaluate_by_twins_with_and_without_truth(flown, blind, monkeypatch):
    own = json.loads(gpvo("evaluate", flown[0] / "run", "--twins", "--replicates", 3, "--json").stdout)["runs"][0]
    assert 0.4 < own["methods"]["twin"]["nees_dof"]["joint"] < 2.5
    assert "simulated_truth" not in own
    monkeypatch.setattr("gpvo.evaluation.evaluate.estimate_truth_noise", lambda *_: TruthNoise(np.full(6, 1e-3)))
    by_twins = json.loads(gpvo("evaluate", blind, "--twins", "--replicates", 2, "--json").stdout)["runs"][0]
    assert by_twins["simulated_truth"]["twins"] == 2
    assert by_twins["verdict"] is None  # words have no mean
    assert by_twins["truth_sigma"] == {"translation_m": 0.0, "rotation_rad": 0.0}  # what is simulated is exact
    assert "twin" not in str(by_twins["source"])
    for method in ("triangulation", "pointing_matching"):
        real, simulated = (d["methods"][method]["nees_dof"]["joint"] for d in (own, by_twins))
        assert simulated == pytest.approx(real, rel=0.35)


@pytest.mark.parametrize("command", ["train", "evaluate", "fuse"])
def test_options_of_twins_without_twins_are_refused(command, flown, tmp_path):
    with pytest.raises(GpvoError, match=r"--gap has no effect without --twins"):
        gpvo(command, flown[0] / "run", "--gap", "drives", *(["-o", tmp_path / "m.gpvo"] * (command == "train")))
    if command != "train":  # which draws by it too
        with pytest.raises(GpvoError, match=r"--seed has no effect without --twins"):
            gpvo(command, flown[0] / "run", "--seed", 3)


@pytest.mark.slow
def test_a_model_of_twins_says_so(flown, blind, tmp_path):
    trained = gpvo("train", blind, "--twins", "--replicates", 3, "-o", tmp_path / "m.gpvo", "--features", "thesis")
    assert trained.exit_code == 0, trained.output
    card = next(tmp_path.glob("m*.md")).read_text()
    assert "The truth was simulated" in card
    assert "3 twins of `blind`" in card
    judged = ["evaluate", blind, "--twins", "--replicates", 2, "--model", tmp_path / "m.gpvo", "--seed"]
    with pytest.warns(UserWarning, match="learned from these very twins of blind"):
        gpvo(*judged, 0)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*these very twins")
        gpvo(*judged, 1)
    again = ["--features", "thesis", "--update", tmp_path / "m.gpvo"]
    updated = gpvo("train", flown[0] / "run", *again, "-o", tmp_path / "u.gpvo")
    assert updated.exit_code == 0, updated.output
    assert "3 twins of `blind`" in next(tmp_path.glob("u*.md")).read_text()


def test_runs_without_tracks_are_refused_with_the_cure(flown, tmp_path):
    _, real, _ = flown
    from gpvo.io.run import write_run

    write_run(tmp_path / "log", replace(real.log, camera=None))
    with pytest.raises(SourceError, match="--keep-tracks"):
        estimate(tmp_path / "log")
    few = simulate_points("tunnel-clean", seed=1, duration_s=2.0, tracks=10)
    run(open_source(few.save(tmp_path / "few.npz")), tmp_path / "few", keep_tracks=True)
    with pytest.raises(SourceError, match="points per motion"):
        estimate(tmp_path / "few")


def test_tolerances_by_name_and_by_file(tmp_path):
    assert read_tolerance("zed2") == ("zed2", TOLERANCES["zed2"])
    (tmp_path / "mine.toml").write_text("baseline = 0.01\nrotation_rad = 1e-4\n")
    assert read_tolerance(str(tmp_path / "mine.toml")) == ("mine", Tolerance(0.01, 0.0, 1e-4))
    for text in ("baseline = 2", "width = 0.1", "", "baseline = [", "baseline = true"):
        (tmp_path / "bad.toml").write_text(text)
        with pytest.raises(GpvoError):
            read_tolerance(str(tmp_path / "bad.toml"))
    with pytest.raises(GpvoError, match="t265"):
        read_tolerance("t266")
