"""Is what goes into the filter what it claims to be? Clocks, gaps, covariances, one line each; and an IMU's units and
axes, judged by gravity and by the motion of VO.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate, permutations, product

import numpy as np

from gpvo.errors import GpvoError, counted
from gpvo.filters.imu_motion import (
    MIN_ROTATION_RAD,
    MIN_ROTATIONS,
    ClockShift,
    Rotations,
    about_their_means,
    clock_shift,
    jerks,
)
from gpvo.filters.plausible import on_one_clock, saturated, usable
from gpvo.filters.run import Flight
from gpvo.filters.start import StartSigmas
from gpvo.geometry import se3
from gpvo.geometry.covariance import is_positive_definite
from gpvo.types import MOST_MPS2, MOST_RADPS, STANDARD_GRAVITY_MPS2, Array, ImuLog

# The 48 ways to call three axes by the wrong names and signs; the right one is the first.
_RELABELLINGS = sorted(
    (np.eye(3)[list(p)] * np.array(s)[:, None] for p in permutations(range(3)) for s in product((1.0, -1.0), repeat=3)),
    key=lambda M: -np.trace(M),
)
_AXES_WINDOW_S = 10.0
_TOGETHER = 0.7  # correlation of all rotations from which names of axes are not chance
_APART_DEG, _EXPLAINED, _TWO_AXES = 10.0, 0.25, 0.05
_AS_WELL = 0.1  # correlations that differ by less say the same
_MOST_BIAS = 4.0  # of the sigma that a filter starts with
_WINDOWS_S, _MIN_WINDOWS = (2.0, 1.4, 1.0, 0.7), 5  # the first lengths of which a flight holds so many


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
        text = "no frame covered by the IMU has ground truth; the run is not scored"
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
        yield Finding("imu", f"the IMU log holds {counted(len(imu.t_ns), 'sample')}", "run without it: --no-imu")
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
            text = f"{counted(len(gaps), 'gap')} in the IMU, the longest {gaps.max():.2f} s"
            yield Finding("gap", f"{text} where {usual * 1e3:.1f} ms is usual", fatal=False)


def _samples(imu: ImuLog) -> Iterator[Finding]:
    bad = ~np.isfinite(np.concatenate([imu.gyro_radps, imu.acc_mps2], axis=1)).all(axis=1)
    if bad.any():
        every = bool(bad.mean() > 0.5)
        text = f"{int(bad.sum())} of {len(imu.t_ns)} IMU samples are not finite and are dropped"
        yield Finding("imu", text, "run without it: --no-imu" if every else "", fatal=every)
    good = usable(imu)
    if n := int((saturated(imu) & good).sum()):
        text = f"{counted(n, 'IMU sample')} of {len(imu.t_ns)} at the end of the sensor's range, counted as missing"
        yield Finding("saturated", text, "set a wider range", fatal=False)
    beyond = int((~bad & ~good).sum())
    if 0 < beyond <= 0.5 * len(imu.t_ns):  # More than that are in another unit.
        text = f"IMU samples out of range or out of order, counted as missing: {beyond} of {len(imu.t_ns)}"
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
    if acc_unit or any(f.kind != "clock" for f in gyro):
        return acc_unit + gyro
    return gyro + (list(_accelerometer_axes(clean)) or list(_accelerometer_sign(flight, clean)))


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
    turning = float(np.median(np.linalg.norm(imu.gyro_radps, axis=1)))
    if ratio < 0.5 and 0.7 < turning / STANDARD_GRAVITY_MPS2 < 1.4:
        text = f"the gyroscope's median reading is {turning:.3g} and the accelerometer's {g:.3g}: they are exchanged"
        yield Finding("acc_unit", text, "the order is gyroscope, accelerometer; or give raw specific force")
        return
    # The two last are 2 % apart.
    units = {"g": 1.0, "mg": 1e3, "cm/s^2": 100 * STANDARD_GRAVITY_MPS2}
    unit, factor = min(units.items(), key=lambda known: abs(g - known[1]) / known[1])
    if 0.7 < g / factor < 1.4 and steady > 0.8:
        to_si = STANDARD_GRAVITY_MPS2 / factor
        text = f"the accelerometer's median reading is {g:.4g} where gravity is 9.81 m/s^2: it is in {unit}"
        yield Finding("acc_unit", text, f"multiply it by {to_si:.6g}")
        return
    if ratio < 0.5:
        text = f"the accelerometer's median reading is {g:.3g} m/s^2: gravity has been removed from it"
        yield Finding("acc_unit", text, "give raw specific force, or use --no-imu")
        return
    yield Finding("acc_unit", f"the accelerometer's median reading is {g:.4g} m/s^2 where gravity is 9.81 m/s^2")


def _late(clock: ClockShift) -> Finding:
    side = "late" if clock.shift_s > 0 else "early"
    by, cure = f"{abs(clock.shift_s) * 1e3:.0f} ms", f"add {clock.shift_s:.3f} to timeshift_cam_imu of the calibration"
    if clock.at_limit:
        by, cure = f"at least {by}", "bring both to one clock; no larger shift is tried"
    text = (
        f"the IMU's stamps seem {by} too {side}: gyroscope and VO then turn together"
        f" (correlation {clock.shifted:.2f}, as given {clock.given:.2f})"
    )
    return Finding("clock", text, cure, fatal=False)


def _gyroscope(flight: Flight, imu: ImuLog) -> Iterator[Finding]:
    late = clock_shift(flight, imu)
    if late is not None:
        yield _late(late)
    turns = Rotations(flight, imu)
    vo, gyro = turns.vo, turns.gyro(0.0 if late is None else late.shift_s)
    bias = list(_gyro_bias(turns, gyro))
    if len(vo) >= MIN_ROTATIONS:
        vo, gyro = about_their_means(vo, gyro)
    energy_vo, energy_gyro = (vo**2).sum(), (gyro**2).sum()
    turned = len(vo) >= MIN_ROTATIONS and bool(energy_vo >= MIN_ROTATION_RAD**2)
    if not imu.gyro_radps.any():
        # Of a noiseless simulation that never turns this is true.
        text = "the gyroscope reads exactly zero throughout: nothing measures the rates"
        yield Finding("gyro_zero", text, "give the gyroscope's topic or columns, or use --no-imu", fatal=turned)
        return
    if not turned or energy_gyro == 0:
        rms = float(np.sqrt((imu.gyro_radps**2).sum(axis=1).mean()))
        if rms > 8.0:
            text = f"the gyroscope reads {rms:.0f} rad/s on average: it is in degrees per second"
            yield Finding("gyro_unit", text, "multiply it by pi / 180")
        return
    # Axis by axis, so that much yaw does not outvote little roll and pitch.
    correlation = vo.T @ gyro / (np.linalg.norm(vo, axis=0)[:, None] * np.linalg.norm(gyro, axis=0) + 1e-300)
    agreement = [float((M * correlation).sum() / 3.0) for M in _RELABELLINGS]
    best = int(np.argmax(agreement))
    # Axes that a vehicle hardly turns about correlate by chance, with either sign: one that says so must do it clearly.
    M = _RELABELLINGS[best]
    told = float((M * correlation).sum(axis=1)[(np.eye(3) != M).any(axis=1)].max(initial=0.0))
    renamed = best != 0 and agreement[best] - agreement[0] > 0.2 and told > 0.5
    together = float((vo * (gyro @ M.T)).sum() / np.sqrt(energy_vo * energy_gyro))
    if np.abs(correlation).max() < 0.5 or (renamed and together < _TOGETHER):
        text = f"gyroscope and VO do not turn together (correlation {agreement[0]:.2f} as given)"
        yield Finding("gyro_axes", text, "check clock offset and T_imu_cam; is it the IMU of this flight?", fatal=False)
        return
    scale = float(np.sqrt(energy_gyro / energy_vo))
    if 30 < scale < 110:
        text = f"the gyroscope turns {scale:.0f} times as fast as VO: it is in degrees per second"
        yield Finding("gyro_unit", text, "multiply it by pi / 180")
    elif not 0.4 < scale < 2.5:
        yield Finding("gyro_unit", f"the gyroscope turns {scale:.3g} times as fast as VO: its unit is wrong")
    if renamed:
        text = (
            f"gyroscope and VO agree only with its axes renamed to {_describe(_RELABELLINGS[best])} "
            f"(correlation {agreement[best]:.2f}, as given {agreement[0]:.2f})"
        )
        yield Finding("gyro_axes", text, "the IMU's axes are swapped, or T_imu_cam is wrong")
    elif late is None and (angle_deg := _apart_deg(vo, gyro)):
        text = f"gyroscope and VO turn about axes that are {angle_deg:.0f} degrees apart, always the same way"
        yield Finding("gyro_axes", text, "T_imu_cam is wrong by that rotation", fatal=False)
    elif not renamed and 0.4 < scale < 2.5:
        yield from bias


def _gyro_bias(turns: Rotations, gyro: Array) -> Iterator[Finding]:
    """What the gyroscope's rotations (M, 3) have over VO's in every stretch of the flight alike."""
    rates = (gyro - turns.vo) / np.maximum(turns.dt_s, 1e-9)[:, None]
    if len(rates) < 4 * MIN_ROTATIONS:
        return
    medians = np.array([np.median(part, axis=0) for part in np.array_split(rates, 4)])
    bias, spread = medians.mean(axis=0), np.ptp(medians, axis=0)
    if (np.abs(bias) > np.maximum(_MOST_BIAS * StartSigmas().gyro_bias_radps, spread)).any():
        told = ", ".join(f"{v:.2f}" for v in np.degrees(bias))
        text = f"the gyroscope reads ({told}) deg/s more than VO turns, throughout: more bias than filters expect"
        yield Finding("gyro_bias", text, "subtract it, as the mean of readings at rest", fatal=False)


def _apart_deg(vo: Array, gyro: Array) -> float:
    """Angle of the rotation that takes the gyroscope's rotations (M, 3) to VO's (W. Kabsch, 1976), where it explains
    most of their difference, else 0. They must turn about two axes."""
    U, S, Vt = np.linalg.svd(vo.T @ gyro)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    angle_deg = float(np.rad2deg(np.linalg.norm(se3.so3_log(R))))
    gyro = gyro * np.sqrt((vo**2).sum() / (gyro**2).sum())
    explains = ((vo - gyro @ R.T) ** 2).sum() < _EXPLAINED * ((vo - gyro) ** 2).sum()
    return angle_deg if explains and S[1] > _TWO_AXES * S[0] and angle_deg > _APART_DEG else 0.0


def _accelerometer_axes(imu: ImuLog) -> Iterator[Finding]:
    """Gravity stays put while the gyroscope says how the IMU turns; renamed axes let it wander."""
    t = (imu.t_ns - imu.t_ns[0]) * 1e-9
    stride = max(1, round(0.02 / max(float(np.median(np.diff(t))), 1e-6)))
    constancy = np.zeros(len(_RELABELLINGS))
    total = 0.0
    for begin in np.arange(0.0, max(t[-1] - 0.5 * _AXES_WINDOW_S, 1e-9), _AXES_WINDOW_S):
        rows = np.flatnonzero((t >= begin) & (t < begin + _AXES_WINDOW_S))[::stride]
        if len(rows) < 20:
            continue
        steps = se3.so3_exp(imu.gyro_radps[rows] * np.gradient(t[rows])[:, None])
        turned = np.array(list(accumulate(steps[:-1], np.matmul, initial=np.eye(3))))
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
    """With all axes turned around gravity stays put as well, and in a vehicle that accelerates it does not stay put
    anyway; but the force then does not rise and fall with VO's motion.

    Both are compared by their slopes, from which gravity and constant biases are gone. Of short windows, in which VO's
    noise weighs more, nothing fatal is said.
    """
    for window_s in _WINDOWS_S:
        jerk, slope = jerks(flight, imu, window_s)
        if len(jerk) >= _MIN_WINDOWS:
            break
    else:
        return
    correlation = _rises_together(jerk, slope, np.eye(3))
    # By chance the correlation of n pairs of values deviates from zero by 1 / sqrt(n).
    chance = max(0.3, 3.0 / np.sqrt(jerk.size))
    if correlation > 1.0 - chance:
        return
    renamed = [_rises_together(jerk, slope, M) for M in _RELABELLINGS]
    best = int(np.argmax(renamed))
    is_clear = 1.0 - renamed[best] ** 2 < _EXPLAINED * (1.0 - correlation**2)
    if is_clear and renamed[best] > max(correlation + chance, renamed[-1] + _AS_WELL):  # the last: all turned around
        text = (
            f"the accelerometer rises and falls with VO's motion only with its axes renamed to"
            f" {_describe(_RELABELLINGS[best])} (correlation {renamed[best]:.2f}, as given {correlation:.2f})"
        )
        cure = "accelerometer and gyroscope axes differ: swapped axes"
        yield Finding("acc_axes", text, cure, fatal=window_s == _WINDOWS_S[0])
    elif correlation < -chance:
        flipped = (np.diag(1 - 2 * axis) for axis in np.eye(3))
        shows = [name for name, M in zip("xyz", flipped) if _rises_together(jerk, slope, M) > 0.3]
        text = f"the accelerometer falls where VO's motion rises (correlation {correlation:.2f}): its sign is wrong"
        cure = "multiply its three axes by -1"
        if shows:  # along gravity, which hides the others
            text += f", as axis {' and '.join(shows)} shows"
            cure = "multiply by -1 what is wrong: all three axes, or y and z if they are FRD and the gyroscope's FLU"
        yield Finding("acc_sign", text, cure, fatal=window_s == _WINDOWS_S[0])


def _rises_together(jerk: Array, slope: Array, M: Array) -> float:
    """Correlation of VO's jerk with the slope of the force whose axes M renames."""
    # No window counts for more than three usual ones: in some VO may have failed.
    both = jerk, np.einsum("mcij,ij->mc", slope, M)
    sizes = [np.linalg.norm(v, axis=1) for v in both]
    a, b = (v / np.maximum(n, 3 * (np.median(n) + 1e-300))[:, None] for v, n in zip(both, sizes, strict=True))
    return float((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum() + 1e-300))


def _describe(M: Array) -> str:
    """Signed axis names: ``(y, x, -z)`` means that the true x is what the log calls y."""
    return "(" + ", ".join(("-" if row.sum() < 0 else "") + "xyz"[int(np.argmax(np.abs(row)))] for row in M) + ")"
