"""Is what goes into the filter what it claims to be? Units, axes, clocks, gaps and covariances, one line each."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gpvo.errors import GpvoError
from gpvo.filters.imu_sanity import Finding, units_and_axes
from gpvo.filters.plausible import on_one_clock, usable
from gpvo.filters.run import Flight
from gpvo.geometry.covariance import is_positive_definite
from gpvo.types import Array, ImuLog


def check_flight(flight: Flight) -> list[Finding]:
    """Everything that looks wrong with a flight's inputs, the worst first."""
    found = list(_covariances(flight))
    if flight.T_world_cam is not None and not flight.has_truth:
        text = "no frame that the IMU reaches has ground truth; the run is not scored"
        found.append(Finding("truth", text, fatal=False))
    if flight.imu is not None:
        clocks = list(_clocks(flight, flight.imu))
        found += clocks
        found += _samples(flight.imu)
        if not any(f.kind == "clock" and f.fatal for f in clocks):
            found += units_and_axes(flight, flight.imu)
    return sorted(found, key=lambda f: not f.fatal)


def require_sane(flight: Flight) -> list[Finding]:
    """Raise ``GpvoError`` with the first fatal finding; return the others."""
    found = check_flight(flight)
    for finding in found:
        if finding.fatal:
            raise GpvoError(finding.text, where=flight.name, cure=finding.cure or None)
    return found


# -- clocks and samples ---------------------------------------------------------------------------------------------


def _clocks(flight: Flight, imu: ImuLog) -> Iterator[Finding]:
    if len(imu.t_ns) < 2:
        yield Finding("imu", f"the IMU log holds {len(imu.t_ns)} samples", "run without it: --no-imu")
        return
    first, last = flight.records[0].t_ns, flight.records[-1].t_ns
    on_clock = imu.t_ns[on_one_clock(imu.t_ns, np.ones(len(imu.t_ns), bool))]
    begin, end = int(on_clock[0]), int(on_clock[-1])
    overlap = (min(last, end) - max(first, begin)) * 1e-9
    span = (last - first) * 1e-9
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
    if (step <= 0).any():
        n = int((step <= 0).sum())
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


# -- covariances ----------------------------------------------------------------------------------------------------


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
