"""One run through the filter: the same start, gate and handling of lost frames for every policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import NO_TRUTH, GpvoError
from gpvo.filters import metrics
from gpvo.filters.eskf import ErrorStateFilter
from gpvo.filters.measurement import Gate
from gpvo.filters.plausible import saturated, usable
from gpvo.filters.policies import Policy
from gpvo.filters.propagation import DEFAULT_IMU_NOISE, TH, P, constant_velocity_noise, each
from gpvo.filters.rivals import Step
from gpvo.filters.start import Start, StartSigmas, from_rest, from_truth, tilt_of, vertical_in_world
from gpvo.filters.timeline import Timeline
from gpvo.geometry import se3
from gpvo.geometry.covariance import from_upper, upper
from gpvo.types import STANDARD_GRAVITY_MPS2, Array, ImuLog, Prediction, VoLog, VoRecord

Progress = Callable[[str], None]

# Truth whose vertical is measured further than this from +z, in sigmas, is in another frame: gravity is as measured.
_LEVEL_SIGMAS = 3.0
_SHORTEST_PATH_M = 0.1  # of which a drift is a part
_TOLD_EACH = 100  # records
_IMU_MARGIN_NS = 100_000_000  # that an IMU log begins after or ends before the images is usual


def no_progress(_: str) -> None:
    """Of use where nobody wants to see any."""


@dataclass(frozen=True)
class Flight:
    """One run as the filters take it.

    ``records`` in order of arrival; ``predictions`` by ``t_ns``; ``imu`` and ``T_imu_cam`` (4, 4) or None;
    ``T_world_cam`` (N, 4, 4) true poses at the records' stamps where ``truth_valid`` (N,), None without truth, whose
    own noise is ``truth_sigma`` per axis [m, rad].
    """

    name: str
    records: Sequence[VoRecord]
    imu: ImuLog | None = None
    T_imu_cam: Array | None = None
    T_world_cam: Array | None = None
    truth_valid: NDArray[np.bool_] | None = None
    predictions: Mapping[int, Prediction] = field(default_factory=dict)
    truth_sigma: tuple[float, float] = (0.0, 0.0)

    @property
    def T_world_imu(self) -> Array:
        """(N, 4, 4) true poses of the filter's state: the IMU, or the camera without one."""
        if self.T_world_cam is None:
            raise GpvoError("this run has no ground truth", where=self.name)
        return self.T_world_cam if self.T_imu_cam is None else self.T_world_cam @ se3.inverse(self.T_imu_cam)

    @property
    def covered(self) -> NDArray[np.bool_]:
        """(N,) which records the IMU reaches; all without one. Beyond its ends nothing is known to fuse with."""
        t_ns = VoLog(self.records).t_ns
        if self.imu is None or not len(self.imu.t_ns):
            return np.ones(len(t_ns), bool)
        known = self.imu.t_ns[usable(self.imu)]
        if not len(known):
            return np.zeros(len(t_ns), bool)
        return (t_ns >= known[0] - _IMU_MARGIN_NS) & (t_ns <= known[-1] + _IMU_MARGIN_NS)

    @property
    def has_truth(self) -> bool:
        """Whether any record that the IMU reaches has truth; truth elsewhere says nothing of what is filtered."""
        if self.T_world_cam is None:
            return False
        return self.truth_valid is None or bool((self.covered & self.truth_valid).any())

    @property
    def known(self) -> NDArray[np.bool_]:
        """(N,) which of these have truth, where there is any."""
        if self.truth_valid is None or not self.has_truth:
            return self.covered
        return self.covered & self.truth_valid

    @property
    def first(self) -> int:
        """Index of the record to start from: the first that the IMU reaches, with truth where there is any."""
        return int(np.argmax(self.known))


@dataclass(frozen=True)
class FuseOptions:
    """What all policies share."""

    init: Literal["truth", "static"] = "truth"
    gate: Gate = field(default_factory=Gate)
    sigmas: StartSigmas = field(default_factory=StartSigmas)
    history_s: float = 2.0


@dataclass(frozen=True)
class FusedRun:
    """The filtered run of one policy at its n records, with counts and scores.

    ``R_world_imu`` (n, 3, 3) and ``position`` (n, 3): the pose of the filter's state, ``covariance_upper`` (n, 45):
    upper triangle of its covariance, ``T_imu_cam`` (4, 4). ``outcomes``: what became of each record; ``residual``,
    ``residual_sigma`` (n, 6), ``nis`` (n,): its innovation, in the camera's axes, NaN where nothing was measured.
    """

    name: str
    policy: str
    t_ns: NDArray[np.int64]
    R_world_imu: Array
    position: Array
    covariance_upper: Array
    T_imu_cam: Array
    outcomes: Sequence[str]
    residual: Array
    residual_sigma: Array
    nis: Array
    counts: Mapping[str, int]
    scores: metrics.Scores

    @property
    def T_world_imu(self) -> Array:
        """(n, 4, 4) pose of the filter's state: the IMU, or the camera without one."""
        return se3.from_rt(self.R_world_imu, self.position)

    @property
    def T_world_cam(self) -> Array:
        """(n, 4, 4) pose of the camera."""
        return self.T_world_imu @ self.T_imu_cam

    @property
    def covariance(self) -> Array:
        """(n, 9, 9) of the error of position, velocity (world) and attitude (body)."""
        return from_upper(self.covariance_upper, TH.stop)


def begin(flight: Flight, options: FuseOptions) -> tuple[Start, Array | None]:
    """The start that every policy shares, and the gravity vector where it is not the usual one.

    Where truth's z is not up, gravity is measured in truth's world.
    """
    sigmas, valid = options.sigmas, np.flatnonzero(flight.known)
    t_ns = VoLog(flight.records).t_ns[valid]
    can_start_on_truth = flight.has_truth and len(valid) > 1
    otherwise = "use --init truth" if can_start_on_truth else f"{NO_TRUTH}; or fuse a recording that begins at rest"
    if options.init == "static":
        if flight.imu is None:
            cure = "use --init truth" if flight.has_truth else NO_TRUTH
            raise GpvoError("a static start needs an IMU", where=flight.name, cure=cure)
        if not flight.has_truth:
            return from_rest(flight.imu, flight.records[flight.first].t_ns, sigmas, otherwise=otherwise), None
    elif not flight.has_truth:
        cure = NO_TRUTH if flight.imu is None else f"{NO_TRUTH}; nor does --init static, at rest"
        raise GpvoError("--init truth needs ground truth", where=flight.name, cure=cure)
    elif len(valid) < 2:
        raise GpvoError("ground truth covers fewer than two frames", where=flight.name, cure="use --init static")
    T = flight.T_world_imu[valid]
    up, tilt, note = None, np.zeros((3, 3)), ""
    if flight.imu is not None and len(valid) > 1:
        up, tilt, note = _vertical(flight.imu, t_ns, T, sigmas)
    if options.init == "static":
        assert flight.imu is not None
        start = from_rest(flight.imu, int(t_ns[0]), sigmas, T_world_imu=T[0], up_world=up, otherwise=otherwise)
    else:
        start = from_truth(t_ns[:5], T[:5], sigmas, with_imu=flight.imu is not None)
        start.covariance[TH, TH] += T[0, :3, :3].T @ tilt @ T[0, :3, :3]
    gravity = None if up is None else -STANDARD_GRAVITY_MPS2 * up
    return replace(start, note=start.note + note, world_tilt=tilt), gravity


def _vertical(
    imu: ImuLog, t_ns: NDArray[np.int64], T_world_imu: Array, sigmas: StartSigmas
) -> tuple[Array | None, Array, str]:
    """The vertical (3,) in truth's world where that is not z, what it costs in tilt (3, 3), and a line that says so."""
    up, tilt = vertical_in_world(imu, t_ns, T_world_imu, sigmas.acc_bias_mps2)
    tilt = tilt + sigmas.tilt_rad**2 * (np.eye(3) - np.outer(up, up))
    off_rad, axis = tilt_of(up)
    if off_rad <= _LEVEL_SIGMAS * np.sqrt(axis @ tilt @ axis):
        return None, np.zeros((3, 3)), ""
    return up, tilt, f"; truth's z axis is {np.rad2deg(off_rad):.1f} deg from up: gravity measured from the IMU"


def make_filter(
    flight: Flight, start: Start, gravity: Array | None, batch: int, options: FuseOptions
) -> ErrorStateFilter:
    """A filter of ``batch`` equal members at the start."""
    imu = flight.imu
    return ErrorStateFilter(
        each(start.nominal, lambda values: np.repeat(values, batch, axis=0)),
        start.covariance,
        T_imu_cam=flight.T_imu_cam,
        imu_noise=None if imu is None else imu.noise or DEFAULT_IMU_NOISE,
        motion_noise=None if imu is not None else constant_velocity_noise(flight.records),
        gravity_world=gravity,
    )


@dataclass(frozen=True)
class _Kept:
    """What is kept of the steps at N records: all of them would take 20 kB a record."""

    pose: Array  # (N, 3, 4)
    upper: Array  # (N, 45)
    innovation: Array  # (N, 13): residual, its standard deviation, NIS
    outcomes: list[str]

    @classmethod
    def empty(cls, n: int) -> _Kept:
        """Before the first step."""
        return cls(np.empty((n, 3, 4)), np.empty((n, 45)), np.full((n, 13), np.nan), [""] * n)

    def take(self, k: int, step: Step) -> None:
        """The step of record k; a later one, of the same record put in its place again, replaces it."""
        self.pose[k, :, :3], self.pose[k, :, 3] = step.nominal.R_world_imu[0], step.nominal.position[0]
        covariance = step.covariance[0]
        self.upper[k] = upper(covariance[: TH.stop, : TH.stop]) if np.isfinite(covariance).all() else np.nan
        self.outcomes[k], self.innovation[k] = step.outcome, np.nan
        if (found := step.innovation) is not None:
            self.innovation[k] = [*found.residual[0], *np.sqrt(np.diagonal(found.S[0])), found.nis[0]]


def fuse_flight(
    flight: Flight, policy: Policy, options: FuseOptions | None = None, *, progress: Progress = no_progress
) -> FusedRun:
    """Filter one run under one policy of a single noise."""
    kept = _Kept.empty(len(flight.records))
    timeline, start, rows = _fly(flight, policy, options or FuseOptions(), 1, kept.take, progress)
    # Views, where all records made a step in their order, as nearly always.
    of = slice(None) if np.array_equal(rows, np.arange(len(flight.records))) else rows
    pose, innovation, outcomes = kept.pose[of], kept.innovation[of], [kept.outcomes[k] for k in rows.tolist()]
    nis, failed = innovation[:, 12], outcomes.count("rejected")
    run = FusedRun(
        name=flight.name,
        policy=policy.name,
        t_ns=VoLog(flight.records).t_ns[rows],
        R_world_imu=pose[:, :, :3],
        position=pose[:, :, 3],
        covariance_upper=kept.upper[of],
        T_imu_cam=np.eye(4) if flight.T_imu_cam is None else flight.T_imu_cam,
        outcomes=outcomes,
        residual=innovation[:, :6],
        residual_sigma=innovation[:, 6:12],
        nis=nis,
        counts={**timeline.counts, "rejected": failed},
        scores=metrics.without_truth(nis, failed),
    )
    return replace(run, scores=_score(flight, run, rows, start.world_tilt)) if flight.has_truth else run


def ate_of_members(
    flight: Flight, policy: Policy, options: FuseOptions, *, batch: int, progress: Progress = no_progress
) -> Array:
    """(batch,) ATE [m] of the members of one filter, by the flight's truth. Their positions are all that is kept."""
    mount = np.eye(4) if flight.T_imu_cam is None else flight.T_imu_cam
    estimate = np.empty((len(flight.records), batch, 3))

    def keep(k: int, step: Step) -> None:
        T_world_imu = se3.from_rt(step.nominal.R_world_imu, step.nominal.position)
        estimate[k] = (T_world_imu @ mount)[:, :3, 3]

    rows = _fly(flight, policy, options, batch, keep, progress)[2]
    rows = rows if flight.truth_valid is None else rows[flight.truth_valid[rows]]
    assert flight.T_world_cam is not None
    truth = flight.T_world_cam[rows, :3, 3]
    return np.array([metrics.ate_rmse(np.ascontiguousarray(estimate[rows, b]), truth) for b in range(batch)])


def _fly(
    flight: Flight,
    policy: Policy,
    options: FuseOptions,
    batch: int,
    keep: Callable[[int, Step], None],
    progress: Progress,
) -> tuple[Timeline, Start, NDArray[np.int64]]:
    """The filter at the end, its start, and the records (n,) that made a step, by stamp; ``keep`` is given each with
    its step, again where it is put in its place later."""
    start, gravity = begin(flight, options)
    rows = np.flatnonzero(flight.covered)
    rows = rows[rows >= flight.first]
    filter = make_filter(flight, start, gravity, batch, options)
    timeline = Timeline(
        filter,
        flight.records[int(rows[0])].t_ns,
        policy,
        gate=options.gate,
        with_imu=flight.imu is not None,
        history_s=options.history_s,
    )
    index = {t: i for i, t in enumerate(VoLog(flight.records).t_ns.tolist())}
    done: dict[int, int] = {}
    imu = flight.imu
    heard = slice(0) if imu is None else ~saturated(imu)
    samples = iter(()) if imu is None else zip(imu.t_ns[heard], imu.gyro_radps[heard], imu.acc_mps2[heard])
    for k, record in enumerate(map(flight.records.__getitem__, rows.tolist())):
        if k % _TOLD_EACH == 0:
            progress(f"{flight.name}: frame {k} of {len(rows)}")
        while not timeline.reaches(record.t_ns) and (sample := next(samples, None)):
            timeline.add_imu(int(sample[0]), *sample[1:])
        for step in timeline.add_vo(record, flight.predictions.get(record.t_ns)):
            done[step.t_ns] = index[step.t_ns]
            keep(done[step.t_ns], step)
    return timeline, start, np.array([done[t] for t in sorted(done)], dtype=np.int64)


def _score(flight: Flight, run: FusedRun, rows: NDArray[np.int64], world_tilt: Array) -> metrics.Scores:
    """The run's, and what the truth tells of its ``rows`` (n,); ``world_tilt`` (3, 3), of the filter's vertical, turns
    all attitudes alike, and positions about the start."""
    valid = np.ones(len(rows), bool) if flight.truth_valid is None else flight.truth_valid[rows]
    assert flight.T_world_cam is not None
    truth_cam, truth_imu = flight.T_world_cam[rows][valid], flight.T_world_imu[rows][valid]
    est, imu, covariance = run.T_world_cam[valid], run.T_world_imu[valid], run.covariance[valid]
    error = np.linalg.norm(est[:, :3, 3] - truth_cam[:, :3, 3], axis=1)
    path = float(se3.path_length_m(truth_cam[:, :3, 3])[-1])
    finite = np.isfinite(covariance).all(axis=(1, 2)) & (run.t_ns > run.t_ns[0])[valid]
    finite &= np.isfinite(imu).all(axis=(1, 2))
    own = [np.eye(3) * sigma**2 for sigma in flight.truth_sigma]
    lever, R = se3.skew(imu[finite, :3, 3] - run.T_world_imu[0, :3, 3]), imu[finite, :3, :3]
    own[0] = own[0] + lever @ world_tilt @ np.swapaxes(lever, 1, 2)
    own[1] = own[1] + np.swapaxes(R, 1, 2) @ world_tilt @ R
    of_position, of_attitude = (covariance[finite, block, block] for block in (P, TH))
    position = metrics.position_nees(imu[finite, :3, 3], truth_imu[finite, :3, 3], of_position + own[0])
    attitude = metrics.attitude_nees(imu[finite, :3, :3], truth_imu[finite, :3, :3], of_attitude + own[1])
    return replace(
        run.scores,
        ate_rmse_m=metrics.ate_rmse(est[:, :3, 3], truth_cam[:, :3, 3]),
        final_error_m=float(error[-1]),
        drift_percent=float(100.0 * error[-1] / path) if path > _SHORTEST_PATH_M else float("nan"),
        nees_position=float(position.mean()) if len(position) else float("nan"),
        nees_attitude=float(attitude.mean()) if len(attitude) else float("nan"),
        diverged=metrics.diverged(error, path),
        frames=int(valid.sum()),
    )
