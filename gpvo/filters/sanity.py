"""Is what goes into the filter what it claims to be? Clocks, gaps, covariances, one line each; and an IMU's units and
axes, judged by gravity and by the motion of VO.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from gpvo.errors import GpvoError
from gpvo.filters.plausible import MOST_MPS2, MOST_RADPS, on_one_clock, usable
from gpvo.filters.run import Flight
from gpvo.geometry import se3
from gpvo.geometry.covariance import is_positive_definite
from gpvo.types import STANDARD_GRAVITY_MPS2, Array, ImuLog, VoRecord

# The 48 ways to call three axes by the wrong names and signs; the right one is the first.
_RELABELLINGS = sorted(
    (np.eye(3)[list(p)] * np.array(s)[:, None] for p in permutations(range(3)) for s in product((1.0, -1.0), repeat=3)),
    key=lambda M: -np.trace(M),
)
_MIN_ROTATION_RAD = 0.02  # rms rotation of all motions together below which rotation says nothing about axes
_WINDOW_S, _MIN_WINDOWS = 2.0, 5  # over which VO's motion is taken to be a cubic


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong; ``fatal`` where filtering on would give nonsense."""

    kind: str
    text: str
    cure: str = ""
    fatal: bool = True

    def __str__(self) -> str:
        return self.text + (f" ({self.cure})" if self.cure else "")


def check_flight(flight: Flight) -> list[Finding]:
    """Everything that looks wrong with a flight's inputs, the worst first."""
    found = list(_covariances(flight))
    if flight.T_world_cam is not None and not flight.has_truth:
        text = "no frame that the IMU reaches has ground truth; the run is not scored"
        found.append(Finding("truth", text, fatal=False))
    if flight.imu is not None:
        clocks = list(_clocks(flight, flight.imu))
        found += [*clocks, *_samples(flight.imu)]
        if not any(f.kind == "clock" and f.fatal for f in clocks):
            found += _units_and_axes(flight, flight.imu)
    return sorted(found, key=lambda f: not f.fatal)


def require_sane(flight: Flight) -> list[Finding]:
    """Raise ``GpvoError`` with the first fatal finding; return the others."""
    found = check_flight(flight)
    for finding in found:
        if finding.fatal:
            raise GpvoError(finding.text, where=flight.name, cure=finding.cure or None)
    return found


def _clocks(flight: Flight, imu: ImuLog) -> Iterator[Finding]:
    if len(imu.t_ns) < 2:
        yield Finding("imu", f"the IMU log holds {len(imu.t_ns)} samples", "run without it: --no-imu")
        return
    first, last = flight.records[0].t_ns, flight.records[-1].t_ns
    on_clock = imu.t_ns[on_one_clock(imu.t_ns, np.ones(len(imu.t_ns), bool))]
    begin, end = int(on_clock[0]), int(on_clock[-1])
    overlap, span = (min(last, end) - max(first, begin)) * 1e-9, (last - first) * 1e-9
    if overlap <= 0:
        yield Finding(
            "clock",
            f"IMU and camera clocks do not overlap: camera {first * 1e-9:.3f} to {last * 1e-9:.3f} s, "
            f"IMU {begin * 1e-9:.3f} to {end * 1e-9:.3f} s",
            "bring both to one clock, or use --no-imu",
        )
    elif overlap < 0.9 * span:
        text = f"the IMU covers {overlap:.1f} of the camera's {span:.1f} s; the frames outside are left out"
        yield Finding("clock", text, fatal=False)
    step = np.diff(imu.t_ns)
    if n := int((step <= 0).sum()):
        yield Finding("clock", f"{n} IMU stamps repeat or run backwards; those samples are dropped", fatal=False)
    forward = step[step > 0]
    if len(forward):
        usual = float(np.median(forward)) * 1e-9
        gaps = forward[forward * 1e-9 > max(5 * usual, 0.05)] * 1e-9
        if len(gaps):
            text = f"{len(gaps)} gaps in the IMU, the longest {gaps.max():.2f} s where {usual * 1e3:.1f} ms is usual"
            yield Finding("gap", text, fatal=False)


def _samples(imu: ImuLog) -> Iterator[Finding]:
    bad = ~np.isfinite(np.concatenate([imu.gyro_radps, imu.acc_mps2], axis=1)).all(axis=1)
    if bad.any():
        every = bool(bad.mean() > 0.5)
        text = f"{int(bad.sum())} of {len(imu.t_ns)} IMU samples are not finite and are dropped"
        yield Finding("imu", text, "run without it: --no-imu" if every else "", fatal=every)
    beyond = int((~bad & ~usable(imu)).sum())
    if 0 < beyond <= 0.5 * len(imu.t_ns):  # More than that are in another unit.
        text = f"{beyond} of {len(imu.t_ns)} IMU samples are out of range or out of order and count as missing"
        yield Finding("imu", text, fatal=False)


def _covariances(flight: Flight) -> Iterator[Finding]:
    usable = [r for r in flight.records if r.usable]
    broken = [r.t_ns for r in usable if not np.isfinite(r.T_prev_cur).all()]
    if broken:
        yield Finding("motion", f"{_count(broken, len(usable))} hold a motion that is not finite", fatal=False)
    for method in dict.fromkeys(m for r in usable for m in r.covariances):
        have = {r.t_ns: r.covariances[method] for r in usable if method in r.covariances}
        if lacking := [r.t_ns for r in usable if method not in r.covariances]:
            text = f"{_count(lacking, len(usable))} have no finite {method} covariance; that policy does not fuse them"
            yield Finding("covariance", text, fatal=False)
        yield from _bad(f"{method} covariances", have)
    yield from _bad("predicted covariances", {t: p.covariance for t, p in flight.predictions.items()})


def _bad(what: str, covariances: dict[int, Array]) -> Iterator[Finding]:
    infinite = [t for t, C in covariances.items() if not np.isfinite(C).all()]
    skewed = [t for t, C in covariances.items() if np.isfinite(C).all() and not is_positive_definite(C)]
    for stamps, fault in ((infinite, "not finite"), (skewed, "not symmetric positive definite")):
        if stamps:
            text = f"{_count(stamps, len(covariances))} of the {what} are {fault}; those frames are not fused"
            yield Finding("covariance", text, fatal=len(stamps) == len(covariances))


def _count(stamps: list[int], of: int) -> str:
    return f"{len(stamps)} of {of} (first at t_ns {min(stamps)})"


def _units_and_axes(flight: Flight, imu: ImuLog) -> list[Finding]:
    """What an IMU shows of wrong units or axes; nothing from fewer than 20 samples."""
    clean = _in_time(imu)
    if len(clean.t_ns) < 20:
        return []
    acc_unit = list(_accelerometer_unit(clean))
    gyro = list(_gyroscope(flight, clean))
    if acc_unit or gyro:
        return acc_unit + gyro
    return list(_accelerometer_axes(clean)) or list(_accelerometer_sign(flight, clean))


def _in_time(imu: ImuLog) -> ImuLog:
    """The samples by which units are told: finite, in order of time, without the single ones that stand out.

    What is out of range may be so in another unit: only what is also far above the usual reading is a fault.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        size = [np.linalg.norm(v, axis=1) for v in (imu.gyro_radps, imu.acc_mps2)]
    good = np.isfinite(size[0]) & np.isfinite(size[1])
    if good.any():
        for v, most in zip(size, (MOST_RADPS, MOST_MPS2), strict=True):
            good = good & (v <= max(most, 30.0 * float(np.quantile(v[good], 0.9))))
    kept = on_one_clock(imu.t_ns, good)
    return ImuLog(imu.t_ns[kept], imu.gyro_radps[kept], imu.acc_mps2[kept])


def _accelerometer_unit(imu: ImuLog) -> Iterator[Finding]:
    g = float(np.median(np.linalg.norm(imu.acc_mps2, axis=1)))
    ratio = g / STANDARD_GRAVITY_MPS2
    # Gravity dominates and keeps its side of the vehicle; bare linear acceleration points everywhere.
    steady = float(np.linalg.norm(imu.acc_mps2.mean(axis=0)) / np.linalg.norm(imu.acc_mps2, axis=1).mean())
    if 0.6 < ratio < 1.6:
        return
    for unit, factor in (("g", 1.0), ("mg", 1e3), ("cm/s^2", 100 * STANDARD_GRAVITY_MPS2)):
        if 0.7 < g / factor < 1.4 and steady > 0.8:
            to_si = STANDARD_GRAVITY_MPS2 / factor
            text = f"the accelerometer's median reading is {g:.4g} where gravity is 9.81 m/s^2: it is in {unit}"
            yield Finding("acc_unit", text, f"multiply it by {to_si:.6g}")
            return
    if ratio < 0.5:
        text = f"the accelerometer's median reading is {g:.3g} m/s^2: gravity has been taken out of it"
        yield Finding("acc_unit", text, "give raw specific force, or use --no-imu")
        return
    yield Finding("acc_unit", f"the accelerometer's median reading is {g:.4g} m/s^2 where gravity is 9.81 m/s^2")


def rotations(flight: Flight, imu: ImuLog) -> tuple[Array, Array]:
    """Rotation vectors (M, 3) of VO's motions and of the integrated gyroscope, both in IMU axes [rad]."""
    R_imu_cam = np.eye(3) if flight.T_imu_cam is None else flight.T_imu_cam[:3, :3]
    used = [r for r in flight.records if r.usable and np.isfinite(r.T_prev_cur).all() and 0 < r.dt_s < 1.0]
    used = [r for r in used if imu.t_ns[0] <= r.t_prev_ns and r.t_ns <= imu.t_ns[-1]]
    if not used:
        return np.zeros((0, 3)), np.zeros((0, 3))
    vo = se3.so3_log(np.array([r.T_prev_cur[:3, :3] for r in used])) @ R_imu_cam.T
    t = (imu.t_ns - imu.t_ns[0]) * 1e-9
    steps = 0.5 * (imu.gyro_radps[1:] + imu.gyro_radps[:-1]) * np.diff(t)[:, None]
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    ends = [np.array([(getattr(r, n) - imu.t_ns[0]) * 1e-9 for r in used]) for n in ("t_ns", "t_prev_ns")]
    at = [np.stack([np.interp(e, t, turned[:, i]) for i in range(3)], axis=1) for e in ends]
    return vo, at[0] - at[1]


def _gyroscope(flight: Flight, imu: ImuLog) -> Iterator[Finding]:
    vo, gyro = rotations(flight, imu)
    if len(vo) >= 10:
        # The largest twentieth of VO's rotations may be failures.
        size = np.linalg.norm(vo, axis=1)
        keep = size <= np.quantile(size, 0.95)
        vo, gyro = vo[keep] - vo[keep].mean(axis=0), gyro[keep] - gyro[keep].mean(axis=0)
    energy_vo, energy_gyro = (vo**2).sum(), (gyro**2).sum()
    turned = len(vo) >= 10 and bool(energy_vo >= _MIN_ROTATION_RAD**2)
    if not imu.gyro_radps.any():
        # Of a noiseless simulation that never turns this is true.
        text = "the gyroscope reads exactly zero throughout: nothing measures the rates"
        yield Finding("gyro_zero", text, "give the gyroscope's topic or columns, or use --no-imu", fatal=turned)
        return
    if not turned or energy_gyro == 0:
        rms = float(np.sqrt((imu.gyro_radps**2).sum(axis=1).mean()))
        if rms > 8.0:
            text = f"the gyroscope turns at {rms:.0f} rad/s on average: it is in degrees per second"
            yield Finding("gyro_unit", text, "multiply it by pi / 180")
        return
    # Axis by axis, so that much yaw does not outvote little roll and pitch.
    correlation = vo.T @ gyro / (np.linalg.norm(vo, axis=0)[:, None] * np.linalg.norm(gyro, axis=0) + 1e-300)
    agreement = [float((M * correlation).sum() / 3.0) for M in _RELABELLINGS]
    best = int(np.argmax(agreement))
    if np.abs(correlation).max() < 0.5:
        text = f"gyroscope and VO do not turn together (correlation {agreement[0]:.2f} as given)"
        yield Finding("gyro_axes", text, "check clock offset and T_imu_cam", fatal=False)
        return
    scale = float(np.sqrt(energy_gyro / energy_vo))
    if 30 < scale < 110:
        text = f"the gyroscope turns {scale:.0f} times as fast as VO: it is in degrees per second"
        yield Finding("gyro_unit", text, "multiply it by pi / 180")
    elif not 0.4 < scale < 2.5:
        yield Finding("gyro_unit", f"the gyroscope turns {scale:.3g} times as fast as VO: its unit is wrong")
    if best != 0 and agreement[best] - agreement[0] > 0.2:
        text = (
            f"gyroscope and VO agree only with its axes renamed to {_describe(_RELABELLINGS[best])} "
            f"(correlation {agreement[best]:.2f}, as given {agreement[0]:.2f})"
        )
        yield Finding("gyro_axes", text, "the IMU's axes are swapped, or T_imu_cam is wrong")


def _accelerometer_axes(imu: ImuLog, window_s: float = 10.0) -> Iterator[Finding]:
    """Gravity stays put while the gyroscope says how the IMU turns; renamed axes let it wander."""
    t = (imu.t_ns - imu.t_ns[0]) * 1e-9
    stride = max(1, round(0.02 / max(float(np.median(np.diff(t))), 1e-6)))
    constancy = np.zeros(len(_RELABELLINGS))
    total = 0.0
    for begin in np.arange(0.0, max(t[-1] - 0.5 * window_s, 1e-9), window_s):
        rows = np.flatnonzero((t >= begin) & (t < begin + window_s))[::stride]
        if len(rows) < 20:
            continue
        R = np.eye(3)
        turned = np.empty((len(rows), 3, 3))
        steps = se3.so3_exp(imu.gyro_radps[rows] * np.gradient(t[rows])[:, None])
        for k in range(len(rows)):
            turned[k] = R
            R = R @ steps[k]
        force = imu.acc_mps2[rows]
        constancy += [np.linalg.norm((turned @ (M @ force.T).T[:, :, None]).mean(axis=0)) for M in _RELABELLINGS]
        total += float(np.linalg.norm(force, axis=1).mean())
    if total == 0.0:
        return
    constancy /= total
    best = int(np.argmax(constancy))
    wander = np.maximum(1.0 - constancy**2, 1e-12)
    if constancy[best] > 0.9 and wander[0] > 0.01 and wander[0] > 4.0 * wander[best]:
        text = (
            f"gravity stays put only with the accelerometer's axes renamed to {_describe(_RELABELLINGS[best])} "
            f"({constancy[best]:.2f} of it, as given {constancy[0]:.2f})"
        )
        yield Finding("acc_axes", text, "accelerometer and gyroscope axes differ: swapped axes")


def _accelerometer_sign(flight: Flight, imu: ImuLog) -> Iterator[Finding]:
    """With all axes turned around gravity stays put as well; but the force then falls where VO's motion rises.

    Both are compared by their slopes, from which gravity and constant biases are gone.
    """
    jerk, slope = _jerks(flight, imu)
    if len(jerk) < _MIN_WINDOWS:
        return
    # No window counts for more than three usual ones: in some VO may have failed.
    pair = [v / np.maximum(np.linalg.norm(v, axis=1), 3 * _usual(v))[:, None] for v in (jerk, slope)]
    correlation = float((pair[0] * pair[1]).sum() / np.sqrt((pair[0] ** 2).sum() * (pair[1] ** 2).sum() + 1e-300))
    # By chance the correlation of n pairs of values deviates from zero by 1 / sqrt(n).
    if correlation < -max(0.3, 3.0 / np.sqrt(pair[0].size)):
        text = f"the accelerometer falls where VO's motion rises (correlation {correlation:.2f}): its sign is wrong"
        yield Finding("acc_sign", text, "multiply its three axes by -1")


def _usual(v: Array) -> float:
    return float(np.median(np.linalg.norm(v, axis=1))) + 1e-300


def _jerks(flight: Flight, imu: ImuLog) -> tuple[Array, Array]:
    """VO's jerk and the slope of the specific force (M, 3) [m/s^3], in camera axes at the start of each window."""
    R_cam_imu = np.eye(3) if flight.T_imu_cam is None else flight.T_imu_cam[:3, :3].T
    t_imu = (imu.t_ns - imu.t_ns[0]) * 1e-9
    areas = 0.5 * (imu.acc_mps2[1:] + imu.acc_mps2[:-1]) * np.diff(t_imu)[:, None]
    impulse = np.concatenate([np.zeros((1, 3)), np.cumsum(areas, axis=0)])
    found = []
    for window in _unbroken(flight.records, _WINDOW_S):
        t = np.array([(r.t_ns - imu.t_ns[0]) * 1e-9 for r in window])
        if t[0] < 0 or t[-1] > t_imu[-1] or len(t) < _MIN_WINDOWS:
            continue
        chain = [np.eye(4)]
        for record in window[1:]:
            chain.append(chain[-1] @ record.T_prev_cur)
        T = np.array(chain)
        middle = 0.5 * (t[1:] + t[:-1])
        felt = np.stack([np.diff(np.interp(t, t_imu, impulse[:, i])) for i in range(3)], axis=1) / np.diff(t)[:, None]
        force = (T[1:, :3, :3] @ (R_cam_imu @ felt.T).T[:, :, None])[:, :, 0]
        found.append((6.0 * np.polyfit(t - t[0], T[:, :3, 3], 3)[0], np.polyfit(middle - t[0], force, 1)[0]))
    jerk, slope = (np.array([f[i] for f in found]).reshape(-1, 3) for i in (0, 1))
    return jerk, slope


def _unbroken(records: Sequence[VoRecord], window_s: float) -> Iterator[list[VoRecord]]:
    """Windows of usable records each of which starts where the one before ended."""
    window: list[VoRecord] = []
    for record in records:
        good = record.usable and bool(np.isfinite(record.T_prev_cur).all())
        if window and not (good and record.t_prev_ns == window[-1].t_ns):
            window = []
        window.append(record)
        if (record.t_ns - window[0].t_ns) * 1e-9 >= window_s:
            yield window
            window = [record]


def _describe(M: Array) -> str:
    """Signed axis names: ``(y, x, -z)`` means that the true x is what the log calls y."""
    return "(" + ", ".join(("-" if row.sum() < 0 else "") + "xyz"[int(np.argmax(np.abs(row)))] for row in M) + ")"
