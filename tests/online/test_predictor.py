"""The predictor: honest far away, the same for one and many, finite and positive definite whatever comes in."""

from __future__ import annotations

import copy
import hashlib
import pickle
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gpvo.dataset.build import build
from gpvo.errors import GpvoError, ModelError
from gpvo.geometry import se3
from gpvo.geometry.covariance import is_positive_definite
from gpvo.online import modelfile
from gpvo.online.division import divide, ln_faster
from gpvo.online.guard import DEGRADED_BELOW, AdaptiveScale
from gpvo.online.observer import Observer, joined
from gpvo.online.predictor import Predictor
from gpvo.types import MotionError, Status, VoLog
from small_model import small_model, training_sets
from synthetic_runs import CAMERA, make_run

TUNNEL = Path(__file__).parents[2] / "models" / "tunnel.gpvo"


@pytest.fixture
def predictor() -> Predictor:
    return small_model().predictor()


@pytest.fixture(scope="module")
def flight():
    return make_run(50, n=120)


def test_step_is_what_training_would_have_seen(predictor, flight):
    log, truth = flight
    s = build(log, truth, name="x", columns=predictor.features)
    said = {p.t_ns: p for p in map(predictor.step, log) if p is not None}
    many = predictor.predict(s.X, s.covariances["pointing_matching"], s.dt_s)
    for k, t in enumerate(s.t_ns):
        np.testing.assert_allclose(said[int(t)].covariance, many.covariance[k], rtol=1e-9)
        np.testing.assert_allclose(said[int(t)].mean, many.mean[k], atol=1e-12)
    one = predictor.predict(s.X[7], s.covariances["pointing_matching"][7], s.dt_s[7])
    np.testing.assert_allclose(one.covariance, many.covariance[7], rtol=1e-9)


def test_confidence_is_the_same_in_flight_and_for_rows_of_features(predictor, flight):
    """Exports, which know no status, are compared with the latter."""
    predictor.reset()
    for record in flight[0].records[:60]:
        said = predictor.step(record if record.dt_s == 0 else replace(record, status=Status.DEGRADED))
    alone = predictor.predict(predictor._last[1], record.covariances["pointing_matching"], said.dt_s)
    assert said.confidence == pytest.approx(alone.confidence, rel=1e-9)


def test_a_motion_that_takes_longer_errs_by_more(predictor):
    """Each row by its own duration; without one, by that of the training."""
    for one in (predictor, Predictor.load(TUNNEL)):
        x, dt_s = one.model.domain.centre, float(one.model.dt_s)
        durations = np.array([0.5, 1.0, 3.0]) * dt_s
        many = one.predict(np.tile(x, (3, 1)), dt_s=durations)
        for k, duration_s in enumerate(durations):
            np.testing.assert_allclose(many.covariance[k], one.predict(x, dt_s=duration_s).covariance, rtol=1e-12)
        np.testing.assert_allclose(many.covariance[1], one.predict(x).covariance, rtol=1e-12)
        np.testing.assert_allclose(many.dt_s, durations)
        trace = np.trace(many.covariance, axis1=1, axis2=2)
        assert trace[0] <= trace[1] <= trace[2]
    assert trace[1] < 0.9 * trace[2]


def test_parts_sum_to_the_covariance(predictor, flight):
    for record in flight[0]:
        p = predictor.step(record)
        np.testing.assert_allclose(p.jitter + p.white + p.persistent, p.covariance, rtol=1e-9)
        assert is_positive_definite(p.covariance)
        assert 0 <= p.confidence <= 1
        assert 0 <= p.in_domain <= 1
        assert (p.epistemic <= np.diagonal(p.covariance) * (1 + 1e-9)).all()


def test_what_lies_outside_the_domain_is_degraded_and_nothing_else(predictor, flight):
    told = []
    for k, record in enumerate(flight[0].records[1:60]):
        given = replace(record, n_inliers=10**6) if k % 7 == 5 else record
        given = replace(given, status=Status.DEGRADED) if k % 5 == 3 else given
        said = predictor.step(given)
        outside = said.in_domain < DEGRADED_BELOW
        assert said.status is (Status.DEGRADED if outside else given.status), k
        told.append((outside, given.status))
    assert set(told) == {(far, status) for far in (False, True) for status in (Status.OK, Status.DEGRADED)}


def test_covariance_grows_with_the_distance_from_the_training_data(predictor, flight):
    log, truth = flight
    s = build(log, truth, name="x", columns=predictor.features)
    domain = predictor.model.domain
    for j in range(len(predictor.features)):
        for side in (-1.0, 1.0):
            edge = domain.centre[j] + domain.scale[j] * (domain.low if side < 0 else domain.high)[j]
            rows = np.tile(s.X[10], (6, 1))
            rows[:, j] = edge + side * domain.scale[j] * np.array([0.0, 0.5, 1, 2, 5, 50])
            out = predictor.predict(rows)
            assert (np.diff(np.log(out.sigma), axis=0) > 0).all(), predictor.features[j]
            assert (np.diff(out.in_domain) <= 0).all()
            assert (np.diff(out.epistemic, axis=0) > 0).all()
            assert out.in_domain[-1] < 1e-6
            assert out.confidence[-1] < 1e-6


def test_never_a_small_covariance_outside(predictor, flight):
    log, truth = flight
    s = build(log, truth, name="x", columns=predictor.features)
    usual = np.quantile(predictor.predict(s.X).sigma, 0.25, axis=0)
    rng = np.random.default_rng(0)
    domain = predictor.model.domain
    far = domain.centre + domain.scale * rng.normal(size=(300, len(predictor.features))) * 30
    assert (predictor.predict(far).sigma > usual).all()


def test_a_jump_that_its_own_noise_explains_is_no_other_place(predictor, flight):
    """Twenty deviations off in speed: far away where the motion is well known, near where its geometry is poor."""
    log, truth = flight
    s = build(log, truth, name="x", columns=predictor.features)
    names, domain = list(predictor.features), predictor.model.domain
    sure = s.X[10].copy()
    jump_mps = 20.0 * domain.scale[names.index("v_y_mps")]
    sure[names.index("v_y_mps")] += jump_mps
    poor = sure.copy()
    geometric = [names.index(c) for c in predictor.model.base.columns[6:12]]
    poor[geometric] += 2.0 * np.log(jump_mps * predictor.model.dt_s) - poor[geometric[1]]
    still = poor.copy()
    still[names.index("v_y_mps")] = s.X[10, names.index("v_y_mps")]
    place = predictor.model.locate(np.array([sure, poor, still]))
    by_geometry = predictor.model.domain.locate(still[None]).distance[0]
    assert place.distance[0] > 10.0
    assert place.distance[1] < by_geometry + 2.0
    assert place.distance[2] <= by_geometry
    assert predictor.predict(poor).sigma[1] > jump_mps * predictor.model.dt_s


def test_what_is_missing_or_absurd_stays_finite(predictor, flight):
    record = flight[0].records[5]
    bad = [
        replace(record, covariances={}),
        replace(record, n_inliers=-1),
        replace(record, T_prev_cur=se3.exp(np.full(6, 1e3))),
        replace(record, status=Status.LOST, T_prev_cur=np.eye(4)),
        replace(record, covariances={"pointing_matching": np.full((6, 6), np.nan)}),
        replace(record, covariances={"pointing_matching": np.eye(6) * 1e-30}),
        replace(record, covariances={"pointing_matching": np.eye(6) * 1e170}),
        replace(record, covariances={"pointing_matching": np.eye(6) * 1e300}),
        replace(record, T_prev_cur=se3.from_rt(np.eye(3), np.full(3, 1e80))),
    ]
    for b in bad:
        predictor.reset()
        for before in flight[0].records[:5]:
            predictor.step(before)
        p = predictor.step(b)
        assert is_positive_definite(p.covariance)
        assert np.isfinite(p.mean).all()
        assert np.isfinite(p.epistemic).all()
    assert p.status is not Status.OK or p.in_domain > 0.5


def test_a_slip_is_lost_and_its_covariance_covers_the_jump(predictor, flight):
    records = list(flight[0].records)
    records[80] = replace(records[80], T_prev_cur=records[80].T_prev_cur @ se3.exp(np.array([0, 0, 10.0, 0, 0, 0])))
    said = [predictor.step(r) for r in records]
    assert said[80].status is Status.LOST
    assert said[80].confidence == 0
    assert said[80].sigma[2] > 5.0
    # The jump is along z alone: of the other axes no more is unknown than that the velocity may have changed.
    assert said[80].sigma[:2].max() < 0.5
    wrong = se3.log(se3.inverse(flight[0].records[80].T_prev_cur) @ records[80].T_prev_cur)
    assert wrong @ np.linalg.solve(said[80].covariance, wrong) < 22.5  # chi-square of 6 at 99.9 %
    assert said[81].status is not Status.LOST


def test_a_motion_that_ends_before_it_begins_is_no_jump(predictor, flight):
    """It lasted as long as usual: its stamps alone are wrong."""
    records = list(flight[0].records[:61])
    records[60] = replace(records[60], t_prev_ns=records[60].t_ns + 50_000_000)
    lost = [predictor.step(r) for r in records][-1]
    assert lost.status is Status.LOST
    assert lost.sigma[2] < 0.5 * np.linalg.norm(records[60].T_prev_cur[:3, 3])


def _losing(log: VoLog, gone: int) -> tuple[VoLog, list[int]]:
    """The log with stretches of ``gone`` motions lost, in which VO gives its last velocity from the last good frame on,
    and the last frames of the stretches."""
    records, ends = list(log.records), []
    for first in range(20, len(records) - gone, 40):
        start = records[first - 1]
        rate = se3.log(start.T_prev_cur) / start.dt_s
        for k in range(first, first + gone):
            vague = np.diag([0.1**2] * 3 + [0.05**2] * 3)
            lost = replace(
                records[k],
                t_prev_ns=start.t_ns,
                status=Status.LOST,
                covariances=dict.fromkeys(records[k].covariances, vague),
            )
            records[k] = replace(lost, T_prev_cur=se3.exp(rate * lost.dt_s))
        ends.append(first + gone - 1)
    return VoLog(records, log.camera), ends


@pytest.mark.parametrize("gone", [1, 3, 10])
def test_a_lost_motion_is_as_wrong_as_velocities_change(predictor, gone):
    """Forty flights of another seed, seven stretches each: squared errors over what is stated, per axis. Odometry's own
    words on a lost motion are no pixel noise: the scale learnt for that must not multiply them."""
    squared = []
    for seed in range(300, 340):
        log, truth = make_run(seed, n=300)
        log, ends = _losing(log, gone)
        said = list(predictor.replay(log).values())
        for k in ends:
            begin, end = np.searchsorted(truth.t_ns, [log.records[k].t_prev_ns, log.records[k].t_ns])
            moved = se3.inverse(truth.T_world_cam[begin]) @ truth.T_world_cam[end]
            squared.append(se3.log(se3.inverse(moved) @ log.records[k].T_prev_cur) ** 2 / said[k].sigma ** 2)
            assert not said[k].mean.any()
            assert not said[k].jitter.any()
    # 280 stretches: a mean of squares of normal values has a deviation of 0.085. Over a long stretch the velocity's
    # mean differs less than its value in the middle.
    assert (np.mean(squared, axis=0) < 1.3).all()
    assert (np.mean(squared, axis=0) > 0.4).all()


def test_a_lost_motion_is_at_most_as_wrong_as_the_vehicle_is_fast(predictor):
    """Longer ago than training shows, the last velocity says nothing but how fast the vehicle is."""
    rate, none = np.array([0.0, 0.0, 1.5, 0.0, 0.1, 0.0]), np.zeros(6)
    variance = np.diag(predictor.model.velocities.lost_covariance(predictor.model.dt_s, 2.0, 1e3, rate, none, none))
    most = 4.0 * np.maximum(predictor.model.velocities.usual_rate_var, np.repeat([2.25, 0.01], 3))
    np.testing.assert_allclose(variance, most)
    ages = [
        np.diag(predictor.model.velocities.lost_covariance(predictor.model.dt_s, 2.0, age, rate, none, none))
        for age in np.geomspace(0.01, 100.0, 40)
    ]
    assert (np.diff(ages, axis=0) >= 0).all()
    assert (ages[0] < 0.5 * most).all()


def test_a_lost_motion_is_no_surer_than_the_velocity_that_it_goes_on_with(predictor, flight):
    """Few inliers before the loss: what VO says of the lost motion is as poor as the motion before it."""
    records = list(flight[0].records[:60])
    poor = {"pointing_matching": 1e4 * records[59].covariances["pointing_matching"]}
    records[59] = replace(records[59], covariances=poor)
    before = [predictor.step(r) for r in records][-1]
    lost = predictor.step(replace(flight[0].records[60], status=Status.LOST, T_prev_cur=records[59].T_prev_cur))
    assert (lost.sigma >= before.sigma).all()
    assert (lost.sigma < 1.5 * before.sigma).any()


@pytest.mark.parametrize("speed_mps", [2.0, 20.0, 200.0])
def test_a_lost_motion_is_the_less_sure_the_faster_the_vehicle(predictor, flight, speed_mps):
    """Training knew 1 m/s: one that is faster than that changes its velocity by more, too."""
    said = {}
    for speed in (1.0, speed_mps):
        step = se3.exp(np.array([0, 0, speed * predictor.model.dt_s, 0, 0, 0]))
        records = [replace(r, T_prev_cur=step) if r.status is not Status.START else r for r in flight[0].records[:60]]
        predictor.reset()
        measured = [predictor.step(r) for r in records][-1]
        assert measured.status is not Status.LOST
        said[speed] = predictor.step(replace(flight[0].records[60], status=Status.LOST, T_prev_cur=step))
    assert said[speed_mps].sigma[2] > 0.9 * speed_mps * said[1.0].sigma[2]


def test_explanation_names_the_input_that_changed(predictor, flight):
    for record in flight[0].records[:30]:
        predictor.step(record)
    few = replace(flight[0].records[30], n_inliers=3, covariances={"pointing_matching": np.eye(6)})
    before = predictor.explain(few)  # also what is not predicted yet
    predictor.step(few)
    assert before == predictor.explain(few) == predictor.explain()
    first = before[0]
    assert first.feature.startswith(("ln_var", "n_inliers"))
    assert "sigma" in str(first)


def test_intervals_cover_flights_that_the_model_has_not_seen(predictor):
    inside = {0.5: [], 0.9: []}
    for s in training_sets(range(200, 206), n=300):
        log, _ = make_run(int(s.name.removeprefix("flight")), n=300)
        said = {p.t_ns: p for p in map(predictor.step, log) if p is not None}
        for level, hits in inside.items():
            ends = np.array([predictor.interval(said[t], level) for t in s.t_ns])
            hits.append((np.abs(s.Y - ends.mean(axis=2)) <= 0.5 * np.ptp(ends, axis=2)).mean())
        predictor.reset()
    # Of five flights the model has seen four, and the fifth counts as if it covered nothing.
    for level, hits in inside.items():
        assert level - 0.05 < np.mean(hits) < min(1.25 * level, 1.0) + 0.05
    with pytest.raises(ModelError, match="no interval at level 0.123"):
        predictor.interval(said[s.t_ns[0]], 0.123)


@pytest.mark.parametrize("nu", [np.inf, 4.0, 3.0])
def test_late_truth_restores_scale_and_coverage_whatever_the_tails(nu):
    rng = np.random.default_rng(0)
    unit = 1.0 if np.isinf(nu) else np.sqrt((nu - 2.0) / nu)
    half_width = unit * (1.644854 if np.isinf(nu) else {4.0: 2.131847, 3.0: 2.353363}[nu])  # tables of Student's t
    adaptive, hits, scales = AdaptiveScale(), [], []
    for k in range(6000):
        actual = 3.0 if k > 1000 else 1.0
        drawn = rng.standard_normal(6) if np.isinf(nu) else rng.standard_t(nu, 6)
        error, sigma = actual * unit * drawn, adaptive.scale
        hits.append(np.abs(error) <= half_width * sigma)
        scales.append(sigma)
        adaptive.observe(error, sigma, nu)
    # 4,000 steps of which a twentieth is forgotten each time: the spread of the mean over axes is about 0.02.
    assert np.mean(hits[2000:], axis=0) == pytest.approx(0.9, abs=0.015)
    assert np.mean(scales[2000:]) == pytest.approx(3.0, rel=0.06)


def test_observe_widens_the_next_prediction(predictor, flight):
    for record in flight[0].records[:40]:
        p = predictor.step(record)
    before = predictor.step(flight[0].records[40])
    for record in flight[0].records[41:90]:
        p = predictor.step(record)
        predictor.observe(p.mean + 6 * p.sigma)
    after = predictor.step(flight[0].records[90])
    assert (after.sigma > 2 * before.sigma).all()


def test_late_truth_of_lost_motions_changes_nothing(predictor, flight):
    """A lost motion is stated so wide that its error always lies within: that is no news of the others."""
    for record in flight[0].records[:40]:
        predictor.step(record)
    before = predictor.step(flight[0].records[40])
    for record in flight[0].records[41:90]:
        predictor.step(replace(record, status=Status.LOST))
        predictor.observe(np.zeros(6))
    after = predictor.step(flight[0].records[90])
    assert (after.sigma > 0.5 * before.sigma).all()
    assert (predictor._adaptive.scale == 1.0).all()


def test_load_refuses_what_does_not_fit(tmp_path: Path):
    from gpvo.online import modelfile

    model = small_model()
    path = tmp_path / "m.gpvo"
    modelfile.save(path, model.arrays, {**model.header, "target": "position"})
    with pytest.raises(ModelError, match="position"):
        Predictor.load(path)
    modelfile.save(
        path, model.arrays, {**model.header, "features": [*model.header["features"][:-1], "no_such_feature"]}
    )
    with pytest.raises(ModelError, match="no_such_feature"):
        Predictor.load(path)
    modelfile.save(path, {k: v for k, v in model.arrays.items() if k != "share"}, model.header)
    with pytest.raises(ModelError, match="share"):
        Predictor.load(path)
    with pytest.raises(ModelError, match=r"nowhere: no such model file.*gpvo train RUN\.\.\. -o MODEL"):
        Predictor.load(tmp_path / "nowhere")


def test_it_flies_with_numpy_and_safetensors_alone(tmp_path: Path):
    """A fresh interpreter that can see the standard library, NumPy, safetensors and gpvo, and nothing else."""
    import gpvo
    import numpy
    import safetensors
    from gpvo.online import modelfile

    model = small_model()
    modelfile.save(tmp_path / "m.gpvo", model.arrays, model.header)
    site = tmp_path / "site"
    site.mkdir()
    for package in (numpy, safetensors, gpvo):
        folder = Path(package.__file__).parent
        (site / folder.name).symlink_to(folder)
        libraries = folder.parent / f"{folder.name}.libs"
        if libraries.is_dir():
            (site / libraries.name).symlink_to(libraries)
    code = f"""
import sys
sys.path.insert(0, {str(site)!r})
import numpy as np
from gpvo.online.predictor import Predictor
from gpvo.types import VoRecord, Status
p = Predictor.load({str(tmp_path / "m.gpvo")!r})
out = p.predict(np.zeros(len(p.features)))
assert np.isfinite(out.covariance).all()
T = np.eye(4); T[2, 3] = 0.05
p.step(VoRecord(0, 0, Status.START, np.eye(4)))
said = p.step(VoRecord(50_000_000, 0, Status.OK, T, n_inliers=90))
assert np.isfinite(said.covariance).all()
p.observe(np.zeros(6)); p.explain()
heavy = {{"torch", "sklearn", "pandas", "scipy", "cv2", "pyarrow", "gpytorch", "matplotlib"}} & set(sys.modules)
assert not heavy, heavy
"""
    done = subprocess.run([sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_another_camera_is_told_by_reset(predictor, flight):
    predictor.reset(replace(CAMERA, fx_px=800.0))
    assert predictor.step(flight[0].records[0]).status is Status.START


def test_errors_add_up_at_rest_as_at_the_typical_speed_and_faster_above():
    speeds = np.array([0.0, 0.3, 1.0, 3.0])
    faster = ln_faster(speeds[:, None] * [0.6, 0.0, 0.8], [0.0])
    share = np.array([[0.6], [0.3], [0.1]])
    white = divide(share, np.array([[1.0], [0.5]]), np.zeros((4, 1)), faster)[:, 1, 0]
    np.testing.assert_allclose(white[:3], 0.3)
    np.testing.assert_allclose(white[3], 0.9 / 1.8)
    assert ln_faster(np.full((1, 3), np.nan), [0.0]) == 0.0


def test_a_window_knows_a_count_if_all_its_motions_do(flight):
    motions = flight[0].records[1:4]
    counts = [r.n_inliers for r in motions]
    assert joined(motions).n_inliers == sum(counts) // 3
    assert joined([replace(motions[0], n_inliers=-1), *motions[1:]]).n_inliers == -1


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))])
def test_a_copy_goes_on_where_it_stands(predictor, flight, copied):
    records = list(flight[0])
    for record in records[:20]:
        predictor.step(record)
    other = copied(predictor)
    for record in records[20:40]:
        np.testing.assert_array_equal(other.step(record).covariance, predictor.step(record).covariance)


def test_arrays_of_records_may_be_used_again(predictor, flight):
    """As a node does that fills the same matrices for each motion."""
    records, T = list(flight[0])[:60], np.empty((4, 4))
    wanted, got = (Observer(predictor.features, "window:1s", CAMERA) for _ in range(2))
    for record in records:
        T[:] = record.T_prev_cur
        one, other = wanted.step(record), got.step(replace(record, T_prev_cur=T))
        if one is not None:
            np.testing.assert_array_equal(other[0].T_prev_cur, one[0].T_prev_cur)
    C = np.eye(6)
    stated = MotionError.independent(C)
    C *= 9.0
    np.testing.assert_array_equal(stated.covariance, np.eye(6))


def test_what_late_truth_cannot_mean_is_refused(predictor, flight):
    """A column had made the scale a matrix, and a scale of zero or NaN the covariance."""
    for record in list(flight[0])[:3]:
        predictor.step(record)
    for wrong in (np.zeros((6, 1)), np.zeros(3)):
        with pytest.raises(GpvoError, match=r"shape \(\d, ?1?\).* \(give \(6,\)"):
            predictor.observe(wrong)
    for wrong in (np.zeros(6), -np.ones(6), np.full(6, np.nan), np.ones(3)):
        with pytest.raises(GpvoError, match="not possible"):
            predictor.reset(scale=wrong)


def test_a_status_may_be_given_as_text(flight):
    record = replace(flight[0].records[1], status="lost")
    assert record.status is Status.LOST
    with pytest.raises(ValueError, match="'fine' is not a valid Status"):
        replace(record, status="fine")


def test_the_digest_is_that_of_the_arrays_that_were_read(tmp_path, monkeypatch):
    """Also where the file is replaced meanwhile, as by a training that ends."""
    path, trained = tmp_path / "m.gpvo", small_model()
    modelfile.save(path, trained.arrays, trained.header)
    ours = hashlib.sha256(path.read_bytes()).hexdigest()
    check = modelfile._check_document

    def replaced(*given):
        modelfile.save(path, trained.arrays, {**trained.header, "note": "another"})
        check(*given)

    monkeypatch.setattr(modelfile, "_check_document", replaced)
    assert Predictor.load(path).digest == ours
    assert hashlib.sha256(path.read_bytes()).hexdigest() != ours


def test_predictions_of_a_run_take_two_kilobytes_each(predictor):
    """Also once their covariances were asked for, as filters and scores do of all."""
    took = []
    for n in (200, 1200):
        log = make_run(50, n=n)[0]
        predictor.replay(log)
        tracemalloc.start()
        said = predictor.replay(log)
        assert all(p.covariance[0, 0] > 0 for p in said.values())
        took.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
        assert len(said) == len(log)
    assert (took[1] - took[0]) / 1000 < 2000


def test_predictions_kept_as_columns_are_those_that_were_made(predictor, flight):
    log = flight[0]
    kept = predictor.replay(log)
    predictor.reset(log.camera)
    made = [p for p in map(predictor.step, log) if p is not None]
    assert list(kept) == [p.t_ns for p in made]
    for p in made:
        for name, value in vars(kept[p.t_ns]).items():
            assert np.array_equal(value, vars(p)[name]), name
        assert np.array_equal(kept[p.t_ns].covariance, p.covariance)
    assert list(kept.only([made[3].t_ns])) == [made[3].t_ns]
    assert 0 not in kept.only([])
