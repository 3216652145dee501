"""The files of a sequence in EuRoC's layout, with Kalibr's calibration; and a contact sheet of its images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from gpvo.cameras.models import CameraModel
from gpvo.cameras.rig import StereoRig
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.io.images import read_grey8
from gpvo.sim.imu import Motion
from gpvo.types import Array, ImuLog

_WIDTH_PX = 320  # of an image on the contact sheet
_CAMERA_HEAD = "#timestamp [ns],filename"
_IMU_HEAD = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
_TRUTH_HEAD = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
    "v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],b_w_RS_S_x [rad s^-1],b_w_RS_S_y [rad s^-1],"
    "b_w_RS_S_z [rad s^-1],b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],b_a_RS_S_z [m s^-2]"
)


def write_calibration(folder: Path, rig: StereoRig, rate_hz: float, offset_s: float) -> None:
    """``body.yaml``, ``cam0`` and ``cam1/sensor.yaml``, and ``dso/camchain.yaml``."""
    assert rig.T_body_left is not None
    _yaml(folder / "mav0" / "body.yaml", {"comment": "gpvo simulator", "axes": "FLU"})
    T_body_right = rig.T_body_left @ se3.inverse(rig.T_right_left)
    chain: dict[str, Any] = {}
    for i, (lens, T) in enumerate(((rig.left, rig.T_body_left), (rig.right, T_body_right))):
        _sensor(folder / "mav0" / f"cam{i}", "camera", T, rate_hz=rate_hz, **_lens(lens, "distortion_coefficients"))
        chain[f"cam{i}"] = {
            "T_cam_imu": se3.inverse(T).tolist(),
            **_lens(lens, "distortion_coeffs"),
            "rostopic": f"/cam{i}/image_raw",
            "timeshift_cam_imu": offset_s,
        }
    chain["cam1"]["T_cn_cnm1"] = rig.T_right_left.tolist()
    _yaml(folder / "dso" / "camchain.yaml", chain)


def write_imu(folder: Path, log: ImuLog, rate_hz: float, gravity_mps2: float) -> None:
    """``imu0`` and ``dso/imu_config.yaml``."""
    noise = log.noise
    assert noise is not None
    densities = {
        "gyroscope_noise_density": noise.gyro_density_radps_sqrthz,
        "gyroscope_random_walk": noise.gyro_walk_radps2_sqrthz,
        "accelerometer_noise_density": noise.acc_density_mps2_sqrthz,
        "accelerometer_random_walk": noise.acc_walk_mps3_sqrthz,
    }
    _sensor(folder / "mav0" / "imu0", "imu", np.eye(4), rate_hz=rate_hz, **densities, gravity_mps2=gravity_mps2)
    _yaml(folder / "dso" / "imu_config.yaml", {**densities, "update_rate": rate_hz, "rostopic": "/imu0"})
    rows = np.concatenate([log.gyro_radps, log.acc_mps2], axis=1)
    _csv(folder / "mav0" / "imu0" / "data.csv", _IMU_HEAD, log.t_ns, rows)


def write_truth(folder: Path, t_ns: NDArray[np.int64], motion: Motion, bias_gyro: Array, bias_acc: Array) -> None:
    """``state_groundtruth_estimate0``: the body's exact states and the IMU's true biases."""
    base = folder / "mav0" / "state_groundtruth_estimate0"
    _sensor(base, "visual-inertial", np.eye(4), sigma_translation_m=0.0, sigma_rotation_rad=0.0)
    q_wxyz = np.roll(se3.rotation_to_quaternion_xyzw(motion.R_world_body), 1, axis=1)
    rows = np.concatenate([motion.position_m, q_wxyz, motion.velocity_mps, bias_gyro, bias_acc], axis=1)
    _csv(base / "data.csv", _TRUTH_HEAD, t_ns, rows)


def write_image_list(folder: Path, camera: str, stamps: list[int]) -> None:
    """``data.csv`` of one camera."""
    lines = [_CAMERA_HEAD, *(f"{t},{t}.png" for t in stamps)]
    (folder / "mav0" / camera / "data.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _lens(lens: CameraModel, distortion_key: str) -> dict[str, Any]:
    fisheye = lens.kind == "kannala-brandt"
    return {
        "camera_model": "pinhole",
        "intrinsics": lens.intrinsics_px,
        "distortion_model": "equidistant" if fisheye else "radial-tangential",
        distortion_key: [float(k) for k in lens.distortion[:4]],
        "resolution": [lens.width, lens.height],
    }


def _sensor(folder: Path, kind: str, T_body_sensor: Array, **values: Any) -> None:
    pose = {"cols": 4, "rows": 4, "data": T_body_sensor.ravel().tolist()}
    _yaml(folder / "sensor.yaml", {"sensor_type": kind, "T_BS": pose, **values})


def _yaml(path: Path, document: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120)
    path.write_text(text, encoding="utf-8")


def _csv(path: Path, head: str, t_ns: NDArray[np.int64], rows: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8") as file:
        file.write(head + "\n")
        for t, row in zip(t_ns.tolist(), rows.tolist()):
            file.write(f"{t}," + ",".join(f"{v:.12g}" for v in row) + "\n")


def contact_sheet(sequence: str | Path, out: str | Path, rows: int = 3, columns: int = 2) -> Path:
    """Write ``rows * columns`` pairs, left and right side by side and spread evenly over the sequence, as a PNG."""
    mav = Path(sequence) / "mav0"
    files = [sorted((mav / camera / "data").glob("*.png")) for camera in ("cam0", "cam1")]
    if not files[0]:
        raise GpvoError("holds no images", where=sequence)
    tiles = []
    for k in np.linspace(0, len(files[0]) - 1, rows * columns).astype(int):
        small = []
        for file in (side[k] for side in files):
            if (image := read_grey8(file)) is None:
                raise GpvoError("is not an image", where=file)
            small.append(cv2.resize(image, (_WIDTH_PX, round(image.shape[0] * _WIDTH_PX / image.shape[1]))))
        tiles.append(np.pad(np.hstack(small), 2, constant_values=255))
    sheet = np.vstack([np.hstack(tiles[r * columns : (r + 1) * columns]) for r in range(rows)])
    target = Path(out)
    data = cv2.imencode(".png", sheet)[1].tobytes()
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(data)
    return target
