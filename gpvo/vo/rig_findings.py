"""What was found wrong with a calibration: in words, as a file, and as a corrected camera chain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gpvo.cameras.kalibr import make_lens
from gpvo.cameras.models import CameraModel
from gpvo.cameras.rectify import rectifying_rotations
from gpvo.cameras.rig import StereoRig, check_pose
from gpvo.errors import CalibrationError, SourceError
from gpvo.files import plain, read_json
from gpvo.geometry import se3
from gpvo.types import Array, StereoCamera
from gpvo.vo.rig_error import LATE, N_TERMS, ORDER, POWERS, RigState, terms

STATE_FILE = "calibration_state.json"
_WORTH_PX = 0.2  # somewhere in the image; below, no one would calibrate anew
_SIGMAS = 4.0
_STEP = 1e-5  # of numeric derivatives [rad, -]


def _power(name: str, n: int) -> str:
    return "" if n == 0 else name if n == 1 else f"{name}^{n}"


_TERMS = [_power("x", i) + _power("y", j) or "1" for i, j in POWERS.tolist()]


_NAMES = [*(f"{d}:{t}" for d in ("dx", "dy") for t in _TERMS), "dt"]
"""Of the coefficients in a file, in the order of a state."""


def lateness(state: RigState, camera: StereoCamera) -> list[str]:
    """What the state says of the times of both images; empty if they are one."""
    late_s, sigma_s = float(state.mean[LATE]), math.sqrt(state.covariance[LATE, LATE])
    # A turn by 1 rad/s displaces by so much.
    if not (abs(late_s) * camera.fx_px > _WORTH_PX and abs(late_s) > _SIGMAS * sigma_s):
        return []
    side = "right" if late_s > 0 else "left"
    return [
        f"the {side} image is {1e3 * abs(late_s):.1f} ms late: trigger both cameras together; until then, what is known"
        " of it is taken off"
    ]


def findings(state: RigState, camera: StereoCamera) -> list[str]:
    """What the state says, one line each; empty for a calibration that fits."""
    return lateness(state, camera) + displacements(state, camera)


def displacements(state: RigState, camera: StereoCamera) -> list[str]:
    """What the state says of the calibration."""
    half, half_high = 0.5 * camera.width / camera.fx_px, 0.5 * camera.height / camera.fy_px
    sigma = np.sqrt(np.diagonal(state.covariance))
    fx, fy = camera.fx_px, camera.fy_px

    def shown(k: int, reach_px: float) -> bool:
        return bool(abs(state.mean[k]) * reach_px > _WORTH_PX and abs(state.mean[k]) > _SIGMAS * sigma[k])

    c, lines = state.mean, []
    degrees = np.rad2deg(np.abs(c))
    row, roll, row_focal = N_TERMS, N_TERMS + 1, N_TERMS + 2
    if shown(row, fy):
        side = "higher" if c[row] < 0 else "lower"
        lines.append(
            f"the right image sits {abs(c[row]) * fy:.1f} px {side} than the left: consistent with a rotation of"
            f" {degrees[row]:.2f} deg between the cameras about the horizontal axis"
        )
    if shown(roll, fy * half):
        lines.append(
            f"rows tilt: consistent with a rotation of {degrees[roll]:.2f} deg between the cameras about the optical"
            " axis"
        )
    if shown(row_focal, fy * half_high):
        one_time = _SIGMAS * sigma[LATE] * fx < _WORTH_PX
        lines.append(
            f"rows spread: consistent with focal lengths that differ by {100 * abs(c[row_focal]):.2f} %"
            + ", or, if the camera moves ahead, with left and right images that were not taken at one time"
            * (not one_time)
        )
    if state.probability > 0.95:
        if shown(0, fx):
            lines.append(
                f"disparities are off by {-c[0] * fx:+.2f} px: consistent with a rotation of {degrees[0]:.2f} deg"
                " between the cameras about the vertical axis, or a shift of the principal point"
            )
        lines += _bend(state, camera)
    return lines


def _bend(state: RigState, camera: StereoCamera) -> list[str]:
    """How far the polynomial of the disparities, without its constant, goes somewhere in the image: a wide image does
    not reach where y is large. Said where a term is beyond doubt."""
    some = slice(1, N_TERMS)
    c, sigma = state.mean[some], np.sqrt(np.diagonal(state.covariance)[some])
    over_px = camera.fx_px * terms(*_places(camera))[some]
    by_term_px = np.abs(c) * np.abs(over_px).max(axis=1)
    if not ((by_term_px > _WORTH_PX) & (np.abs(c) > _SIGMAS * sigma)).any():
        return []
    most = _TERMS[1 + int(np.argmax(by_term_px))]
    return [f"disparities bend over the image by up to {np.abs(c @ over_px).max():.1f} px, most in {most}"]


def _places(camera: StereoCamera) -> tuple[Array, Array]:
    """Normalised x and y of a grid over the image, each (n,)."""
    v, u = np.mgrid[0 : camera.height : 9j, 0 : camera.width : 13j]
    return ((u - camera.cx_px) / camera.fx_px).ravel(), ((v - camera.cy_px) / camera.fy_px).ravel()


def document(state: RigState, camera: StereoCamera, start: RigState | None = None) -> dict[str, Any]:
    """The state in plain numbers, for the file beside a run, with that of an earlier run from which it started."""
    return {
        "schema": 1,
        "terms": _NAMES,
        "mean": state.mean,
        "covariance": state.covariance,
        "probability": state.probability,
        "camera_px": _camera_px(camera),
        "findings": findings(state, camera),
    } | ({} if start is None else {"start": document(start, camera)})


def _camera_px(camera: StereoCamera) -> list[float]:
    return [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width, camera.height]


def read_state(path: Path, camera: StereoCamera) -> RigState:
    """The state of a file, or of a run folder. Raises SourceError where it is damaged, or of another camera."""
    if path.is_dir() and not (path / STATE_FILE).is_file():
        cure = "gpvo run estimates one, except with --no-self-calibration or --preset thesis"
        raise SourceError("holds no calibration state", where=path, cure=cure)
    path = path / STATE_FILE if path.is_dir() else path
    return _state_of(read_json(path), path, camera)


def read_start(path: Path, camera: StereoCamera) -> RigState | None:
    """The state that the run of a folder started from, None from nothing. Raises SourceError as :func:`read_state`."""
    path = path / STATE_FILE
    start = read_json(path).get("start") if path.is_file() else None
    return None if start is None else _state_of(start, path, camera)


def _state_of(read: dict[str, Any], path: Path, camera: StereoCamera) -> RigState:
    try:
        place = np.array([_NAMES.index(name) for name in read["terms"]])
        read_mean, read_covariance = np.array(read["mean"], np.float64), np.array(read["covariance"], np.float64)
        probability, of = float(read["probability"]), np.array(read["camera_px"], np.float64)
    except (KeyError, TypeError, ValueError):
        raise SourceError("is not a calibration state", where=path, cure=f"give the {STATE_FILE} of a run") from None
    n = len(np.unique(place))
    if not (0 < n == len(place) and read_mean.shape == (n,) and read_covariance.shape == (n, n)):
        raise SourceError("is not a calibration state", where=path, cure=f"give the {STATE_FILE} of a run")
    if of.shape != (6,) or not np.allclose(of, _camera_px(camera), rtol=1e-3):
        raise SourceError("belongs to another camera, size or calibration", where=path, cure="use it with its own rig")
    # Of terms that a file does not name, nothing is known.
    state = RigState.prior(camera)
    mean, covariance = state.mean.copy(), state.covariance.copy()
    if not read_covariance.any():  # a calibration that is right beyond doubt
        covariance[:] = 0.0
    covariance[place], covariance[:, place] = 0.0, 0.0
    # At half the width of the image all terms displace alike, however narrow the view.
    reach = np.append(np.tile((0.5 * camera.width / camera.fx_px) ** ORDER, 2), 1.0)
    with np.errstate(over="ignore", invalid="ignore"):  # Comparisons with NaN are false.
        mean[place], covariance[np.ix_(place, place)] = read_mean, 0.5 * (read_covariance + read_covariance.T)
        uncertain = bool(covariance.any())  # else the calibration is right beyond doubt
        covariance += 1e-14 * uncertain * np.eye(len(mean))
        at_border = covariance * np.outer(reach, reach)
        is_usual = np.abs(mean * reach).max() <= 0.2 and np.abs(at_border).max() <= 1e3
    if not (is_usual and 0 <= probability <= 1):
        raise SourceError("holds impossible numbers", where=path, cure=f"give the {STATE_FILE} of a run")
    if uncertain and np.linalg.eigvalsh(at_border)[0] <= 0:
        raise SourceError("its covariance is not positive definite", where=path)
    return RigState(mean, covariance, probability)


def corrected(rig: StereoRig, state: RigState, camera: StereoCamera) -> StereoRig:
    """The rig with rotation, focal length and centre of the right camera changed to explain the displacements best.

    What none of them explains (lens distortion) remains: :func:`explained_px`.
    """
    turn, right = _changed(rig, _explanation(rig, state, camera)[0])
    R_rect, T = _rectifying(rig), rig.T_right_left.copy()
    T[:3] = R_rect.T @ turn @ R_rect @ T[:3]
    return replace(rig, right=right, T_right_left=T)


def _rectifying(rig: StereoRig) -> Array:
    """(3, 3) axes of the right camera to rectified ones."""
    return np.eye(3) if rig.is_rectified else rectifying_rotations(rig.T_right_left)[1]


def _changed(rig: StereoRig, p: Array) -> tuple[Array, CameraModel]:
    """The turn (3, 3) of the right camera, in rectified axes, and its lens, for ``p`` (6,): rotation, focal length and
    centre."""
    r, scale = rig.right, 1.0 + p[3]
    lens = replace(
        r,
        fx_px=r.fx_px * scale,
        fy_px=r.fy_px * scale,
        cx_px=r.cx_px + p[4] * r.fx_px,
        cy_px=r.cy_px + p[5] * r.fy_px,
    )
    return se3.so3_exp(p[:3]), lens


def _lens(
    kind: str, intrinsics_px: list[float], distortion: list[float], size: Sequence[int], where: str | None
) -> CameraModel:
    """Of a kind as :attr:`CameraModel.kind` names it."""
    width, height = size
    model = "radtan" if "radtan" in kind else "equidistant"
    return make_lens(model, intrinsics_px, distortion, (width, height), where)


def explained_px(rig: StereoRig, state: RigState, camera: StereoCamera) -> tuple[float, float]:
    """Displacement that was found, and what of it :func:`corrected` leaves: rms over the image [px]."""
    _, *displacements = _explanation(rig, state, camera)
    found_px, left_px = (camera.fx_px * math.sqrt(2 * np.mean(d**2)) for d in displacements)
    return found_px, left_px


def _explanation(rig: StereoRig, state: RigState, camera: StereoCamera) -> tuple[Array, Array, Array]:
    """(6,) rotation, focal length and centre that fit best; displacements dx, then dy, over the image, and what is left
    of them.

    To first order, by what each does to the raw image: the focal length of a fisheye does not scale the rectified one.
    """
    x, y = _places(camera)
    R_rect = _rectifying(rig)
    raw, seen = rig.right.project(np.column_stack([x, y, np.ones_like(x)]) @ R_rect)

    def meant(p: Array) -> Array:
        """(2, n) places in a rectified image of what is seen at the raw pixels."""
        turn, lens = _changed(rig, p)
        X, Y, Z = (lens.unproject(raw[seen]) @ R_rect.T @ turn).T
        return np.stack([X / Z, Y / Z])

    by = np.stack([(meant(-e) - meant(e)).ravel() for e in _STEP * np.eye(6)], axis=1) / (2 * _STEP)
    found = (state.mean[:LATE].reshape(2, N_TERMS) @ terms(x[seen], y[seen])).ravel()
    known = np.isfinite(by).all(axis=1)
    by, found = by[known], found[known]
    p = np.asarray(np.linalg.lstsq(by, found, rcond=None)[0], np.float64)
    return p, found, found - by @ p


def rig_of(calibration: dict[str, Any] | None, camera: StereoCamera) -> StereoRig:
    """The rig that a run folder describes; a rectified pair where it describes none."""
    if calibration is None:
        lens = _lens("radtan", _camera_px(camera)[:4], [], (camera.width, camera.height), "rig.json")
        return StereoRig(lens, lens, se3.from_rt(np.eye(3), np.array([-camera.baseline_m, 0.0, 0.0])))
    try:
        left, right = (
            _lens(c["model"], c["intrinsics_px"], c["distortion"], c["resolution_px"], "rig.json")
            for c in (calibration["left"], calibration["right"])
        )
        T_imu_left = calibration.get("T_imu_left")
        return StereoRig(
            left,
            right,
            np.array(calibration["T_right_left"], np.float64),
            T_imu_left=None if T_imu_left is None else check_pose(T_imu_left, "T_imu_left", "rig.json"),
            timeshift_cam_imu_s=float(calibration.get("timeshift_cam_imu_s", 0.0)),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(f"is malformed: {error}", where="rig.json") from None


CAMCHAIN = (b"^# written by gpvo calibration", "corrected calibration")


def camchain(rig: StereoRig) -> str:
    """The rig as Kalibr's ``camchain.yaml``, with the place and the clock of the IMU where they are known. Its first
    line tells it from Kalibr's own."""
    chain: dict[str, dict[str, Any]] = {}
    for name, lens, T_cam_left in (("cam0", rig.left, np.eye(4)), ("cam1", rig.right, rig.T_right_left)):
        chain[name] = {
            "camera_model": "pinhole",
            "intrinsics": lens.intrinsics_px,
            "distortion_model": lens.distortion_model,
            "distortion_coeffs": lens.coefficients,
            "resolution": [lens.width, lens.height],
        }
        if rig.T_imu_left is not None:
            chain[name]["T_cam_imu"] = T_cam_left @ se3.inverse(rig.T_imu_left)
        if rig.timeshift_cam_imu_s:
            chain[name]["timeshift_cam_imu"] = rig.timeshift_cam_imu_s
    chain["cam1"]["T_cn_cnm1"] = rig.T_right_left
    text = yaml.safe_dump(plain(chain), sort_keys=False, default_flow_style=None, width=math.inf)
    return f"# written by gpvo calibration\n{text}"
