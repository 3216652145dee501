"""One call for a calibration file of any known kind."""

from __future__ import annotations

from pathlib import Path

from gpvo.cameras.camera_info import read_camera_infos
from gpvo.cameras.kalibr import read_camchain
from gpvo.cameras.kitti_calib import read_kitti_calib
from gpvo.cameras.opencv_yaml import read_opencv_stereo
from gpvo.cameras.rig import StereoRig
from gpvo.cameras.yamlfile import read_yaml
from gpvo.errors import CalibrationError

# Names under which a calibration lies beside images or a bag, the most telling first.
CALIBRATION_NAMES = (
    "camchain-imucam.yaml",
    "camchain.yaml",
    "kalibr_imucam_chain.yaml",
    "dso/camchain.yaml",
    "*camchain*.yaml",
    "*camchain*.yml",
    "*imucam*.yaml",
    "stereo*.yaml",
    "stereo*.yml",
    "calib*.yaml",
    "calib*.yml",
)


def read_stereo_yaml(path: Path, *, size: tuple[int, int] | None = None) -> StereoRig:
    """A Kalibr camera chain, an OpenCV stereo file, ROS camera_info YAML or KITTI's ``calib.txt``, told apart by keys.

    ``size`` (width, height) of the images, for files that do not state it.

    Raises
    ------
    CalibrationError
        Where it is none of them.
    """
    if path.suffix.lower() == ".txt":
        if size is None:
            raise CalibrationError("states no size of the images", where=path, cure="convert it to a camchain.yaml")
        return read_kitti_calib(path, left=0, right=1, size=size)
    document = read_yaml(path)
    if "cam0" in document or "cam1" in document:
        return read_camchain(path)
    if "K1" in document:
        return read_opencv_stereo(path, size=size)
    if "camera_matrix" in document:
        return read_camera_infos(path)
    raise CalibrationError(
        "is neither a Kalibr camera chain (cam0, cam1), nor an OpenCV stereo file (K1, D1, K2, D2, R, T), nor ROS"
        " camera_info (camera_matrix, projection_matrix)",
        where=path,
    )


def find_calibration(folder: Path) -> Path | None:
    """The calibration file in a folder, None where there is none."""
    for pattern in CALIBRATION_NAMES:
        for path in sorted(folder.glob(pattern)):
            if path.is_file():
                return path
    return None
