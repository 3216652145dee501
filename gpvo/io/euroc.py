"""EuRoC MAV ("ASL") folders, and TUM-VI, which adds a Kalibr camera chain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gpvo.cameras.kalibr import read_imu_noise, read_sensor_pair, read_sensor_pose
from gpvo.cameras.readers import find_calibration, read_stereo_yaml
from gpvo.cameras.rig import StereoRig
from gpvo.cameras.yamlfile import calibration_text, read_yaml
from gpvo.errors import CalibrationError, SourceError
from gpvo.geometry import se3
from gpvo.io.images import FileSource, PairFiles
from gpvo.io.source import SourceReport
from gpvo.io.stamps import PAIR_TOLERANCE_S, integer_ns, match_nearest, text_lines
from gpvo.io.trajectory import (
    BATCH_ESTIMATE,
    MOTION_CAPTURE,
    TruthNoise,
    carry,
    check_overlap,
    read_euroc_csv,
    read_imu_csv,
)
from gpvo.types import Array, ImuLog, ImuNoise, TruthLog

# Folders with poses, the best first. A laser tracker (leica0) gives positions alone and is no truth of motions.
_TRUTH = (
    ("state_groundtruth_estimate0", BATCH_ESTIMATE),
    ("mocap0", MOTION_CAPTURE),
    ("vicon0", MOTION_CAPTURE),
)


class EurocSource(FileSource):
    """A sequence folder that holds ``mav0/`` (or is it), with ``cam0 cam1`` and, where present, ``imu0`` and truth.

    The calibration is that of ``sensor.yaml`` in both camera folders, else a Kalibr chain in ``dso/`` or the folder
    itself (TUM-VI). Stamps of a pair may differ by ``tolerance_s``. ``body.yaml`` with the line ``axes: FLU`` says that
    the body is x forward, y left, z up.
    """

    format = "euroc"

    def __init__(
        self,
        path: Path,
        *,
        calibration: str | Path | None = None,
        tolerance_s: float = PAIR_TOLERANCE_S,
        truth_noise: TruthNoise | None = None,
        **options: Any,
    ) -> None:
        mav = _mav_folder(path)
        rig = _read_rig(path, mav, None if calibration is None else Path(calibration))
        known = SourceReport()
        super().__init__(path, path.resolve().name, rig, _list_pairs(mav, tolerance_s, known), known, **options)
        self.imu = self._read_imu(mav)
        self.truth = self._read_truth(mav, truth_noise)
        if self.truth is None and (mav / "leica0").is_dir():
            self.remark("leica0 gives positions only: not used as truth of motions")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A folder with ``mav0/cam0/data.csv``, or that folder."""
        return path.is_dir() and any((p / "cam0" / "data.csv").is_file() for p in (path / "mav0", path))

    def _read_imu(self, mav: Path) -> ImuLog | None:
        file = mav / "imu0" / "data.csv"
        if not file.is_file():
            return None
        noise = _imu_noise(self.path, mav)
        return read_imu_csv(file, shift_s=self.rig.timeshift_cam_imu_s, noise=noise, remark=self.remark)

    def _read_truth(self, mav: Path, noise: TruthNoise | None) -> TruthLog | None:
        if self.mounting.T_imu_cam is None:
            return None
        for folder, usual in _TRUTH:
            file = mav / folder / "data.csv"
            if not file.is_file():
                continue
            stated = _stated_noise(mav / folder / "sensor.yaml")
            T_marker_imu = _marker_to_imu(mav, folder)
            truth = carry(read_euroc_csv(file), T_marker_imu @ self.mounting.T_imu_cam, noise or stated or usual)
            check_overlap(truth, np.array([p.t_ns for p in self._pairs], dtype=np.int64), file)
            return truth
        return None


def _mav_folder(path: Path) -> Path:
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    for camera in ("cam0", "cam1"):
        if not (mav / camera / "data.csv").is_file():
            raise SourceError(
                "no list of images", where=mav / camera / "data.csv", cure="a line 'stamp_ns,file' per image"
            )
    return mav


def _read_rig(path: Path, mav: Path, given: Path | None) -> StereoRig:
    sensors = [mav / camera / "sensor.yaml" for camera in ("cam0", "cam1")]
    if given is None and all(s.is_file() for s in sensors):
        imu = mav / "imu0" / "sensor.yaml"
        return read_sensor_pair(*sensors, imu=imu if imu.is_file() else None, body_is_flu=_body_is_flu(mav))
    chain = given or next((c for c in map(find_calibration, (path, mav, path / "dso", mav.parent)) if c), None)
    if chain is None:
        raise CalibrationError(
            "no calibration: neither cam0/sensor.yaml and cam1/sensor.yaml nor dso/camchain.yaml",
            where=mav,
            cure="put Kalibr's camchain.yaml into the folder or name one with --calibration",
        )
    return read_stereo_yaml(chain)


def _body_is_flu(mav: Path) -> bool:
    body = mav / "body.yaml"
    return body.is_file() and str(read_yaml(body).get("axes", "")).upper() == "FLU"


def _list_pairs(mav: Path, tolerance_s: float, known: SourceReport) -> list[PairFiles]:
    left, right = (_read_image_list(mav / camera / "data.csv", known) for camera in ("cam0", "cam1"))
    folders = [mav / camera / "data" for camera in ("cam0", "cam1")]
    pairs = match_nearest(left, right, round(tolerance_s * 1e9), known, mav)
    return [PairFiles(t, folders[0] / a, folders[1] / b) for t, a, b in pairs]


def _read_image_list(path: Path, known: SourceReport) -> list[tuple[int, str]]:
    """(stamp, file name) of each line, in order of time; a line that is neither is counted and skipped."""
    out = []
    for number, text in text_lines(path):
        if text.startswith("#"):
            continue
        stamp, _, name = (part.strip() for part in text.partition(","))
        name = name or f"{stamp}.png"
        try:
            if not _is_plain_name(name):
                raise ValueError
            out.append((integer_ns(stamp), name))
        except ValueError:
            known.unreadable += 1
            known.note(f"{path.parent.name}/{path.name} line {number} is not 'stamp_ns,file'")
    if not out:
        raise SourceError("lists no images", where=path, cure="a line 'stamp_ns,file' per image")
    in_time = sorted(out, key=lambda line: line[0])
    if in_time != out:
        known.note(f"{path.parent.name}/{path.name} is not in order of time: sorted by stamp")
    return in_time


def _is_plain_name(name: str) -> bool:
    """Whether a name stays inside its folder."""
    return 0 < len(name.encode()) <= 255 and name not in (".", "..") and not any(c in name for c in ("/", "\\", "\0"))


def _imu_noise(path: Path, mav: Path) -> ImuNoise | None:
    for candidate in (mav / "imu0" / "sensor.yaml", path / "dso" / "imu_config.yaml", path / "imu.yaml"):
        if candidate.is_file() and "gyroscope_noise_density" in calibration_text(candidate):
            return read_imu_noise(candidate)
    return None


def _marker_to_imu(mav: Path, folder: str) -> Array:
    """(4, 4) IMU to the frame whose poses the truth folder holds, identity where nothing else is said."""
    T = []
    for sensor in (folder, "imu0"):
        file = mav / sensor / "sensor.yaml"
        has_pose = file.is_file() and "T_BS" in read_yaml(file)
        T.append(read_sensor_pose(file) if has_pose else np.eye(4))
    T_body_marker, T_body_imu = T
    return se3.inverse(T_body_marker) @ T_body_imu


def _stated_noise(sensor: Path) -> TruthNoise | None:
    """Noise that the truth's own ``sensor.yaml`` states, as gpvo's simulator writes it."""
    if not sensor.is_file():
        return None
    document = read_yaml(sensor)
    values = [document.get(k) for k in ("sigma_translation_m", "sigma_rotation_rad")]
    if not all(isinstance(v, (int, float)) and 0 <= v < 10 for v in values):
        return None
    return TruthNoise(float(values[0]), float(values[1]))  # type: ignore[arg-type]
