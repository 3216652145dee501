"""Calibrations in YAML, OpenCV's dialect included, no code ever run: Kalibr's ``camchain.yaml`` (also
``camchain-imucam.yaml`` and OpenVINS' variant) and ``imu.yaml``; and EuRoC's ``sensor.yaml``, one file per sensor, with
``T_BS`` from sensor to body.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gpvo.cameras.models import CameraModel, KannalaBrandt, PinholeRadtan
from gpvo.cameras.rig import StereoRig, check_pose
from gpvo.errors import CalibrationError
from gpvo.files import read_bounded
from gpvo.geometry import se3
from gpvo.types import Array, ImuNoise

_PAIR = ("cam0", "cam1")
NOISE_KEYS = {
    "gyroscope_noise_density": "gyro_density_radps_sqrthz",
    "gyroscope_random_walk": "gyro_walk_radps2_sqrthz",
    "accelerometer_noise_density": "acc_density_mps2_sqrthz",
    "accelerometer_random_walk": "acc_walk_mps3_sqrthz",
}
"""What Kalibr and EuRoC call the fields of :class:`gpvo.types.ImuNoise`."""
_MAX_BYTES = 100_000  # a calibration has a few thousand
# Chained and direct transforms of one calibration agree to the digits printed; a mistaken meaning does not.
_CHAIN_TOLERANCE_M, _CHAIN_TOLERANCE = 5e-3, 0.1  # the latter of the baseline: that of an endoscope is 4 mm
_CHAIN_TOLERANCE_RAD = np.deg2rad(0.5)


class _Loader(yaml.SafeLoader):
    """Safe loader that knows OpenCV's matrices, and no aliases: nested, a few of them stand for a billion nodes."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(
                None, None, f"the alias *{event.anchor}; write its value out", event.start_mark
            )
        return super().compose_node(parent, index)


def _opencv_matrix(loader: _Loader, node: yaml.Node) -> Array:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(None, None, "opencv-matrix must be a mapping", node.start_mark)
    fields = loader.construct_mapping(node, deep=True)
    data = np.asarray(fields["data"], dtype=np.float64)
    return data.reshape(int(fields["rows"]), int(fields["cols"]))


for _tag in ("tag:yaml.org,2002:opencv-matrix", "!opencv-matrix"):
    _Loader.add_constructor(_tag, _opencv_matrix)


def calibration_text(path: Path) -> str:
    """The text of a file. Raises CalibrationError where it cannot be read, or is too large for a calibration."""
    data = read_bounded(path, _MAX_BYTES, "too large for a calibration", CalibrationError)
    return data.decode("utf-8-sig", errors="replace").replace("\r\n", "\n")


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; ``!!opencv-matrix`` becomes an array (rows, cols).

    OpenCV's first line ``%YAML:1.0`` is no YAML and is dropped; tags that would build Python objects are refused.
    Raises CalibrationError where the file is missing, too large, not YAML or not a mapping.
    """
    text = calibration_text(path)
    # A leading directive without the document marker, and tabs, are what these files suffer from.
    text = re.sub(r"\A\s*%YAML[: ][^\n]*\n(---[^\n]*\n)?", "", text).expandtabs(4)
    try:
        document = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, KeyError, ValueError, TypeError, OverflowError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise CalibrationError(f"not readable as YAML{line}: {problem}", where=path) from None
    if not isinstance(document, dict):
        raise CalibrationError("holds no keys", where=path, cure="is this the calibration file?")
    return document


def get_numbers(block: dict[str, Any], key: str, count: int | tuple[int, ...], where: object) -> list[float]:
    """``block[key]``, or the ``data`` of the mapping that it is in OpenCV's JSON, as a list of finite numbers of one of
    the given lengths.

    Raises CalibrationError where the key is absent or holds something else.
    """
    allowed = (count,) if isinstance(count, int) else count
    if key not in block:
        raise CalibrationError(f"lacks the key '{key}'", where=where)
    held = block[key].get("data", "") if isinstance(block[key], dict) else block[key]
    try:
        values = np.asarray(held, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        raise CalibrationError(f"'{key}' is not a list of numbers", where=where) from None
    if len(values) not in allowed or not np.isfinite(values).all():
        wanted = " or ".join(str(n) for n in allowed)
        raise CalibrationError(f"'{key}' holds {len(values)} numbers, expected {wanted} finite ones", where=where)
    return [float(v) for v in values]


def read_camchain(path: Path) -> StereoRig:
    """The stereo pair ``cam0``, ``cam1`` of a camera chain.

    ``T_cn_cnm1`` (previous camera to this one) and ``T_cam_imu`` (or its inverse ``T_imu_cam``, never both) are read;
    where both give the baseline they must agree, since published files have put other things under ``T_cn_cnm1``.
    Raises CalibrationError where a key is missing, a model unknown, or the rig impossible.
    """
    document = read_yaml(path)
    for name in _PAIR:
        if not isinstance(document.get(name), dict):
            found = ", ".join(k for k in document if str(k).startswith("cam")) or "none"
            cure = "a stereo pair needs two cameras"
            raise CalibrationError(f"has no block '{name}' (cameras found: {found})", where=path, cure=cure)
    left, right = (document[name] for name in _PAIR)
    T_left_imu, T_right_imu = (_cam_imu(document[name], f"{path}: {name}") for name in _PAIR)
    shift_s = get_numbers({"timeshift_cam_imu": 0.0, **left}, "timeshift_cam_imu", 1, path)[0]
    return StereoRig(
        left=_lens(left, f"{path}: cam0"),
        right=_lens(right, f"{path}: cam1"),
        T_right_left=_right_left(right, T_left_imu, T_right_imu, path),
        T_imu_left=None if T_left_imu is None else se3.inverse(T_left_imu),
        timeshift_cam_imu_s=shift_s,
        where=str(path),
    )


def camchain_topics(path: Path) -> tuple[str | None, str | None]:
    """The ``rostopic`` of both cameras, None where not given."""
    document = read_yaml(path)
    topics = (document[n].get("rostopic") if isinstance(document.get(n), dict) else None for n in _PAIR)
    first, second = (t if isinstance(t, str) else None for t in topics)
    return first, second


def read_imu_noise(path: Path) -> ImuNoise:
    """Noise densities of Kalibr's ``imu.yaml``, flat or under ``imu0``; the keys are also those of EuRoC."""
    document = read_yaml(path)
    block = document["imu0"] if isinstance(document.get("imu0"), dict) else document

    def number(key: str) -> float:
        value = get_numbers(block, key, 1, path)[0]
        if value < 0:
            raise CalibrationError(f"'{key}' is negative", where=path)
        return value

    return ImuNoise(**{field: number(key) for key, field in NOISE_KEYS.items()})


def make_lens(
    distortion_model: str,
    intrinsics_px: Sequence[float],
    distortion: Sequence[float],
    resolution_px: tuple[int, int],
    where: object,
) -> CameraModel:
    """A lens from the names that Kalibr, EuRoC and ROS use for distortion; ``intrinsics_px``: fx, fy, cx, cy.

    Raises CalibrationError for a distortion other than radial-tangential or equidistant.
    """
    fx, fy, cx, cy = intrinsics_px
    width, height = resolution_px
    name = distortion_model.lower().replace("_", "-")
    if name in ("radtan", "radial-tangential", "plumb-bob", "rational-polynomial", "none", ""):
        if any(distortion[8:]):
            cure = "calibrate with eight (rational) or five (radtan), or rectify the images"
            text = "coefficients of a thin prism or a tilted sensor, the ninth and on, are not supported"
            raise CalibrationError(text, where=where, cure=cure)
        count = 8 if any(distortion[5:]) else 5  # the rational model with zeros beyond the fifth is the common one
        return PinholeRadtan(fx, fy, cx, cy, width, height, (*distortion, *[0.0] * 8)[:count])
    if name in ("equidistant", "fisheye", "kannala-brandt", "kannala-brandt4"):
        if len(distortion) < 4 or any(distortion[4:]):
            raise CalibrationError(f"a fisheye needs 4 distortion coefficients, not {len(distortion)}", where=where)
        return KannalaBrandt(fx, fy, cx, cy, width, height, tuple(distortion[:4]))
    cure = "use radtan or equidistant"
    raise CalibrationError(f"distortion model '{distortion_model}' is not supported", where=where, cure=cure)


def _lens(block: dict[str, Any], where: str) -> CameraModel:
    width, height = get_numbers(block, "resolution", 2, where)
    model = str(block.get("camera_model", "pinhole"))
    if model != "pinhole":
        cure = "calibrate as pinhole with radtan, or with equidistant distortion for a fisheye"
        raise CalibrationError(f"camera model '{model}' is not supported", where=where, cure=cure)
    distortion = []
    distortion_model = str(block.get("distortion_model", "none"))
    # As EuRoC spells it, or as Kalibr does.
    key = "distortion_coefficients" if "distortion_coefficients" in block else "distortion_coeffs"
    if distortion_model != "none":
        distortion = get_numbers(block, key, (4, 5, 8), where)
    elif key in block and "distortion_model" not in block:
        cure = "add 'distortion_model: radtan' or 'equidistant'"
        raise CalibrationError(f"holds '{key}' of no distortion_model", where=where, cure=cure)
    intrinsics = get_numbers(block, "intrinsics", 4, where)
    return make_lens(distortion_model, intrinsics, distortion, (int(width), int(height)), where)


def _cam_imu(block: dict[str, Any], where: str) -> Array | None:
    if "T_cam_imu" in block and "T_imu_cam" in block:
        raise CalibrationError("holds both T_cam_imu and T_imu_cam", where=where, cure="keep the one that is right")
    if "T_cam_imu" in block:
        return check_pose(block["T_cam_imu"], "T_cam_imu", where)
    if "T_imu_cam" in block:
        return se3.inverse(check_pose(block["T_imu_cam"], "T_imu_cam", where))
    return None


def _right_left(right: dict[str, Any], T_left_imu: Array | None, T_right_imu: Array | None, path: Path) -> Array:
    """Left to right camera by the chain, by the IMU, or by both where they agree."""
    chained = check_pose(right["T_cn_cnm1"], "T_cn_cnm1", f"{path}: cam1") if "T_cn_cnm1" in right else None
    if T_left_imu is not None and T_right_imu is not None:
        by_imu = T_right_imu @ se3.inverse(T_left_imu)
    elif chained is not None:
        return chained
    else:
        cure = "add T_cn_cnm1 to the second camera, or T_cam_imu to both"
        raise CalibrationError("does not say where 'cam1' sits relative to 'cam0'", where=path, cure=cure)
    if chained is None:
        return by_imu
    difference = se3.log(se3.inverse(by_imu) @ chained)
    shift_m, turn_rad = np.linalg.norm(difference[:3]), np.linalg.norm(difference[3:])
    tolerance_m = min(_CHAIN_TOLERANCE_M, _CHAIN_TOLERANCE * float(np.linalg.norm(chained[:3, 3])))
    if shift_m > tolerance_m or turn_rad > _CHAIN_TOLERANCE_RAD:
        raise CalibrationError(
            f"T_cn_cnm1 and the transforms to the IMU disagree by {shift_m * 1e3:.1f} mm and"
            f" {np.rad2deg(turn_rad):.2f} degrees",
            where=path,
            cure="T_cn_cnm1 maps points of the previous camera to this one; T_cam_imu those of the IMU",
        )
    return chained


def sensor_pose(document: dict[str, Any], where: Path) -> Array:
    """``T_BS`` (4, 4) of any sensor's ``sensor.yaml``: sensor to body. CalibrationError where there is none."""
    block = document.get("T_BS")
    if isinstance(block, dict):
        numbers = get_numbers(block, "data", 16, f"{where}: T_BS")
        return check_pose(np.reshape(numbers, (4, 4)), "T_BS", where)
    if block is None:
        raise CalibrationError("lacks the key 'T_BS'", where=where, cure="add the sensor's pose in the body")
    return check_pose(block, "T_BS", where)


def read_sensor_pair(left: Path, right: Path, *, imu: Path | None = None, body_is_flu: bool = False) -> StereoRig:
    """The rig of two camera ``sensor.yaml`` files; ``imu``: that of the IMU, else the IMU is the body's origin.

    ``body_is_flu`` says that the body's axes are x forward, y left, z up, so that it can serve as ``base_link``.
    """
    documents = [(read_yaml(path), path) for path in (left, right)]
    T_body_left, T_body_right = (sensor_pose(*d) for d in documents)
    T_body_imu = sensor_pose(read_yaml(imu), imu) if imu is not None else np.eye(4)
    lenses = [_lens(document, str(path)) for document, path in documents]
    return StereoRig(
        left=lenses[0],
        right=lenses[1],
        T_right_left=se3.inverse(T_body_right) @ T_body_left,
        T_imu_left=se3.inverse(T_body_imu) @ T_body_left,
        T_body_left=T_body_left if body_is_flu else None,
        where=str(left),
    )
