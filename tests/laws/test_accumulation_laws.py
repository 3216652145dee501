"""Whoever adds up the errors of a flight comes to one covariance: keyframes metres and tens of degrees apart, lost
frames, errors of calibration; and it is that of drawn flights."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from gpvo.accumulation import PoseError, adjoints_to_end, along, carry, frame_jitter, persistence, persistent_sum
from gpvo.evaluation.forecast import _sum_up
from gpvo.filters.eskf import ErrorStateFilter
from gpvo.filters.measurement import Gate
from gpvo.filters.propagation import CORE, Nominal
from gpvo.geometry import se3
from gpvo.geometry.covariance import change_body
from gpvo.publish.odometry import OdometryBuilder
from gpvo.types import MotionError, Prediction, Status, VoRecord
from hypothesis import given, settings
from hypothesis import strategies as st

STEP_NS = 300_000_000
POSE = [0, 1, 2, 6, 7, 8]
"""Position and attitude in the filter's core."""


@dataclass(frozen=True)
class Made:
    """Motions (N, 4, 4) with their stated errors, the pose that each starts from, and whether others start there."""

    T_prev_cur: np.ndarray
    errors: list[Prediction]
    parent: list[int]
    kept: list[bool]

    @property
    def poses(self) -> np.ndarray:
        out = [np.eye(4)]
        for T, p in zip(self.T_prev_cur[1:], self.parent[1:]):
            out.append(out[p] @ T)
        return np.array(out)

    @property
    def records(self) -> list[VoRecord]:
        return [
            VoRecord(k * STEP_NS, max(p, 0) * STEP_NS, e.status if k else Status.START, T, is_reference=kept)
            for k, (T, e, p, kept) in enumerate(zip(self.T_prev_cur, self.errors, self.parent, self.kept))
        ]


def _spd(rng: np.random.Generator) -> np.ndarray:
    A = rng.standard_normal((6, 6)) * 10.0 ** rng.uniform(-3, -1.5)
    return A @ A.T + 1e-8 * np.eye(6)


def _motions(rng: np.random.Generator, n: int) -> np.ndarray:
    """Three metres and thirty degrees each, in any direction."""
    xi = rng.standard_normal((n, 2, 3))
    xi *= np.array([3.0, np.deg2rad(30.0)])[:, None] / np.linalg.norm(xi, axis=2, keepdims=True)
    return se3.exp(xi.reshape(n, 6))


def _flight(seed: int, n: int = 14, lost: float = 0.2, kept: float = 0.6) -> Made:
    rng = np.random.default_rng(seed)
    tau_s = np.exp(rng.uniform(-2, 4, 12))
    T, parent, is_kept, reference = _motions(rng, n), [-1], [True], 0
    errors = [Prediction(**_parts(rng, tau_s), epistemic=np.zeros(6), confidence=1.0, in_domain=1.0)]
    for k in range(1, n):
        parent.append(reference)
        is_kept.append(bool(rng.random() < kept))
        status = Status.LOST if rng.random() < lost else Status.OK
        of_motion = _parts(rng, tau_s, lost=status is Status.LOST)
        duration, sure = (k - reference) * STEP_NS, {"epistemic": np.zeros(6), "confidence": 1.0, "in_domain": 1.0}
        errors.append(Prediction(**of_motion, **sure, dt_s=duration * 1e-9, t_ns=k * STEP_NS, status=status))
        reference = k if is_kept[-1] else reference
    return Made(T, errors, parent, is_kept)


def _parts(rng: np.random.Generator, tau_s: np.ndarray, lost: bool = False) -> dict:
    zero, root = np.zeros((6, 6)), rng.standard_normal((6, 12)) * 10.0 ** rng.uniform(-3, -1.5)
    jitter, white = _spd(rng), _spd(rng)
    return {
        "mean": np.zeros(6),
        "jitter": zero if lost else jitter,
        "white": white,
        "persistent_root": 0.0 * root if lost else root,
        "persistent_tau_s": tau_s,
    }


def _assert_same(C: np.ndarray, expected: np.ndarray) -> None:
    sigma = np.sqrt(np.diagonal(expected))
    assert (np.abs(C - expected) / np.outer(sigma, sigma)).max() < 1e-9


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6))
def test_messages_state_what_adds_up(seed: int) -> None:
    made = _flight(seed)
    _, stated = along(made.T_prev_cur, made.errors, made.parent)
    builder = OdometryBuilder(np.eye(4), floor=0.0)
    builder.step(made.records[0])
    for k, (record, error) in enumerate(zip(made.records[1:], made.errors[1:]), start=1):
        out = builder.step(record, error)
        _assert_same(_in_camera(out.T_odom_body, out.pose_covariance), stated[k])


def _in_camera(T: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    turn = np.kron(np.eye(2), T[:3, :3].T)
    return turn @ covariance @ turn.T


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6))
def test_a_filter_that_knows_nothing_else_states_what_adds_up(seed: int) -> None:
    """Before each measurement its pose is unknown, so that afterwards it is known by the measurements alone."""
    made = _flight(seed, n=10)
    _, stated = along(made.T_prev_cur, made.errors, made.parent)
    zero = np.zeros((1, 3))
    filter = ErrorStateFilter(Nominal(zero, zero, np.eye(3)[None], zero, zero), np.zeros((CORE, CORE)))
    aged_ns = 0
    for k, (error, T, T_world) in enumerate(zip(made.errors, made.T_prev_cur, made.poses)):
        if k == 0:
            continue
        filter.x.position, filter.x.R_world_imu = T_world[None, :3, 3].copy(), T_world[None, :3, :3].copy()
        filter.P[:, :CORE] = filter.P[:, :, :CORE] = 0.0
        filter.P[:, POSE, POSE] = 1e10
        filter.decay_bias((k * STEP_NS - aged_ns) * 1e-9, error.persistent_tau_s)
        aged_ns = k * STEP_NS
        filter.update_motion(T, error.row(None), Gate(on_fail="accept"))
        to_camera = np.eye(6)
        to_camera[:3, :3] = T_world[:3, :3].T
        _assert_same(to_camera @ filter.P[0][np.ix_(POSE, POSE)] @ to_camera.T, stated[k])
        if made.kept[k]:
            filter.clone(measured=not error.lost)
        else:
            filter.forget_current()


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), m=st.integers(1, 12))
def test_windows_state_what_adds_up_part_by_part(seed: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    made = [_flight(int(s), n=m + 1, lost=0.0, kept=1.0) for s in rng.integers(0, 10**6, 3)]
    T = np.array([f.T_prev_cur[1:] for f in made])
    tau_s = made[0].errors[0].persistent_tau_s

    def stacked(name: str) -> np.ndarray:
        return np.array([[getattr(e, name) for e in f.errors[1:]] for f in made])

    fields = {name: stacked(name) for name in ("mean", "jitter", "white", "persistent_root", "dt_s")}
    batch = MotionError(**fields, persistent_tau_s=tau_s)
    to_end, phi = adjoints_to_end(T), persistence(batch.dt_s, tau_s)
    # The noise of a frame between two motions cancels.
    sums = ((to_end[:, [0, -1]], frame_jitter(batch.jitter[:, [0, -1]])), (to_end, batch.white))
    found = dict(zip(("jitter", "white"), ((A @ C @ A.swapaxes(-1, -2)).sum(axis=1) for A, C in sums)))
    found["persistent"] = persistent_sum(to_end @ batch.persistent_root, phi)
    found["covariance"] = sum(found.values())
    for w in range(len(made)):
        for part in ("jitter", "white", "persistent", "covariance"):
            names = {"jitter", "white", "persistent_root"} - {"persistent_root" if part == "persistent" else part}
            blank = {} if part == "covariance" else {n: np.zeros_like(getattr(batch, n)) for n in names}
            only = MotionError(**fields | blank, persistent_tau_s=tau_s).row(w)
            pose = PoseError()
            for k in range(m):
                pose = pose.after(T[w, k], only.row(k))
            _assert_same(found[part][w], pose.covariance)


@settings(max_examples=10)
@given(seed=st.integers(0, 10**6))
def test_a_forecast_states_what_adds_up(seed: int) -> None:
    made = _flight(seed, lost=0.0)
    rows = made.errors[1:]
    arrays = {n: np.array([getattr(e, n) for e in rows]) for n in ("mean", "jitter", "white", "persistent_root")}
    spans = np.array([e.dt_s for e in rows])
    said = Prediction(
        **arrays, persistent_tau_s=rows[0].persistent_tau_s, dt_s=spans,
        epistemic=np.zeros((len(rows), 6)), confidence=np.ones(len(rows)), in_domain=np.ones(len(rows)),
    )  # fmt: skip
    plan = SimpleNamespace(T_world_cam=made.poses)
    covariance, _ = _sum_up(np.array(made.parent), said, plan)
    _, stated = along(made.T_prev_cur, made.errors, made.parent)
    for C, expected in zip(covariance[1:], stated[1:]):
        _assert_same(C, expected)


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6))
def test_a_lost_frame_only_adds_to_what_is_unknown(seed: int) -> None:
    """Of the pose that it starts from nothing is known better afterwards, in whatever axes it is looked at."""
    made = _flight(seed, lost=0.4)
    _, stated = along(made.T_prev_cur, made.errors, made.parent)
    for k, error in enumerate(made.errors):
        if k and error.lost:
            moved = carry(made.T_prev_cur[k])
            added = stated[k] - moved @ stated[made.parent[k]] @ moved.T
            np.testing.assert_allclose(added, error.white, atol=1e-9 * np.abs(stated[k]).max())


def test_the_published_sigma_never_falls_by_a_lost_frame() -> None:
    """150 m straight on, one frame lost there: position sigma before, at and after it."""
    forward, zero = se3.exp(np.array([0, 0, 1.0, 0, 0, 0])), np.zeros((6, 6))
    C = np.diag([4e-5, 4e-5, 4e-5, 1e-7, 1e-7, 1e-7])
    parts = {"mean": np.zeros(6), "persistent_root": np.zeros((6, 12)), "persistent_tau_s": np.ones(12), "dt_s": 0.1}
    sure = {"epistemic": np.zeros(6), "confidence": 1.0, "in_domain": 1.0}
    builder, sigma, reference = OdometryBuilder(np.eye(4), floor=0.0), [], 0
    for k in range(1, 160):
        lost, t_ns = k == 150, k * 10**8
        status = Status.LOST if lost else Status.OK
        T = np.linalg.matrix_power(forward, k - reference)
        white = 0.3 * C if lost else 0.5 * C
        error = Prediction(**parts, **sure, jitter=zero if lost else 0.5 * C, white=white, status=status, t_ns=t_ns)
        out = builder.step(VoRecord(t_ns, reference * 10**8, status, T, is_reference=not lost), error)
        sigma.append(np.sqrt(np.trace(out.pose_covariance[:3, :3])))
        reference = reference if lost else k
    assert (np.diff(sigma) > 0).all()


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_covariance_of_drawn_flights(seed: int) -> None:
    """4,000 draws of six motions, errors a hundredth as large: variances scatter by 2.2 %; within 11 % on each axis."""
    made, draws = _flight(seed, n=7, lost=0.3), 4000
    rng = np.random.default_rng(seed)
    _, stated = along(made.T_prev_cur, made.errors, made.parent)
    small = 1e-2

    def draw(C: np.ndarray) -> np.ndarray:
        values, vectors = np.linalg.eigh(C)
        return small * rng.standard_normal((draws, 6)) @ (vectors * np.sqrt(np.maximum(values, 0))).T

    poses, noise = {0: np.tile(np.eye(4), (draws, 1, 1))}, {0: None}
    unit = {0: rng.standard_normal((draws, 12))}
    for k in range(1, len(made.errors)):
        error, p, T = made.errors[k], made.parent[k], made.T_prev_cur[k]
        phi = np.exp(-error.dt_s / error.persistent_tau_s)
        unit[k] = phi * unit[p] + np.sqrt(1 - phi**2) * rng.standard_normal((draws, 12))
        if error.lost:
            poses[k], noise[k] = poses[p] @ T @ se3.exp(draw(error.white)), None
            continue
        # The first motion that starts at a frame says how noisy that is.
        before = draw(0.5 * error.jitter) @ se3.adjoint(T).T if noise[p] is None else noise[p]
        noise[p] = before
        noise[k] = draw(0.5 * error.jitter)
        rest = draw(error.white) + small * unit[k] @ error.persistent_root.T + noise[k]
        poses[k] = poses[p] @ se3.exp(-before) @ T @ se3.exp(rest)
    truth = made.poses[-1]
    e = se3.log(se3.inverse(truth) @ poses[len(made.errors) - 1]) / small
    np.testing.assert_allclose(np.diagonal(e.T @ e / draws), np.diagonal(stated[-1]), rtol=0.11)


def test_another_body_frame_moves_it_by_the_adjoint() -> None:
    """Accumulated in the axes of another frame of the body, it is the same covariance moved there."""
    made, rng = _flight(5, lost=0.0), np.random.default_rng(5)
    X = _motions(rng, 1)[0]
    Ad = se3.adjoint(X)
    T = X @ made.T_prev_cur @ se3.inverse(X)
    moved = [
        MotionError(
            mean=e.mean, jitter=Ad @ e.jitter @ Ad.T, white=Ad @ e.white @ Ad.T,
            persistent_root=Ad @ e.persistent_root, persistent_tau_s=e.persistent_tau_s, dt_s=e.dt_s,
        )
        for e in made.errors
    ]  # fmt: skip
    _, here = along(made.T_prev_cur, made.errors, made.parent)
    _, there = along(T, moved, made.parent)
    _assert_same(there[-1], change_body(X, here[-1]))
