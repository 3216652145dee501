"""Sequences of public data sets: EuRoC MAV ("ASL") folders, and TUM-VI, which adds a Kalibr camera chain; and KITTI
odometry, rectified pairs by index with ``calib.txt``, ``times.txt`` and poses of the left camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gpvo.cameras.kalibr import calibration_text, read_imu_noise, read_sensor_pair, read_yaml, sensor_pose
from gpvo.cameras.readers import find_calibration, left_camera_offset, read_kitti_calib, read_stereo_yaml
from gpvo.cameras.rig import StereoRig
from gpvo.errors import CalibrationError, SourceError, counted
from gpvo.geometry import se3
from gpvo.io.images import IMAGE_SUFFIXES, FileSource, PairFiles, first_size
from gpvo.io.source import SourceReport
from gpvo.io.stamps import PAIR_TOLERANCE_S, Stamps, growing, integer_ns, match_nearest, text_lines, tolerance_ns
from gpvo.io.trajectory import (
    BATCH_ESTIMATE,
    GPS_INS,
    MOTION_CAPTURE,
    Trajectory,
    TruthNoise,
    carry,
    check_overlap,
    read_euroc_csv,
    read_imu_csv,
    read_kitti_poses,
    read_times,
)
from gpvo.types import Array, TruthLog

# Folders with poses, the best first. A laser tracker (leica0) gives positions alone and is no truth of motions.
_EUROC_TRUTH = (
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
        **options: Any,
    ) -> None:
        mav = _mav_folder(path)
        rig = _euroc_rig(path, mav, None if calibration is None else Path(calibration))
        known, cameras = SourceReport(), (mav / "cam0", mav / "cam1")
        left, right = (_read_image_list(camera / "data.csv", known) for camera in cameras)
        matched = match_nearest(left, right, tolerance_ns(tolerance_s), known, mav)
        pairs = [PairFiles(t, *(c / "data" / name for c, name in zip(cameras, names))) for t, *names in matched]
        super().__init__(path, path.resolve().name, rig, pairs, known, **options)
        if (samples := mav / "imu0" / "data.csv").is_file():
            stated = (mav / "imu0" / "sensor.yaml", path / "dso" / "imu_config.yaml", path / "imu.yaml")
            known_of = (p for p in stated if p.is_file() and "gyroscope_noise_density" in calibration_text(p))
            noise = next(map(read_imu_noise, known_of), None)
            self.imu = read_imu_csv(samples, shift_s=rig.timeshift_cam_imu_s, noise=noise, remark=self.remark)
        self.truth = self._read_truth(mav)
        if self.truth is None and (mav / "leica0").is_dir():
            self.remark("leica0 gives positions only: not used as truth of motions")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A folder with ``mav0/cam0/data.csv``, or that folder."""
        return path.is_dir() and any((p / "cam0" / "data.csv").is_file() for p in (path / "mav0", path))

    def _read_truth(self, mav: Path) -> TruthLog | None:
        for folder, usual in _EUROC_TRUTH:
            file = mav / folder / "data.csv"
            if not file.is_file():
                continue
            if self.mounting.T_imu_cam is None:
                self.remark("ground truth not used: the calibration does not say where the IMU sits")
                return None
            noise = _stated_noise(mav / folder / "sensor.yaml") or usual
            truth = carry(read_euroc_csv(file), _marker_to_imu(mav, folder) @ self.mounting.T_imu_cam, noise)
            check_overlap(truth, self.span_ns, file)
            return truth
        return None


def _mav_folder(path: Path) -> Path:
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    for camera in ("cam0", "cam1"):
        if not (mav / camera / "data.csv").is_file():
            cure = "a line 'stamp_ns,file' per image"
            raise SourceError("no list of images", where=mav / camera / "data.csv", cure=cure)
    return mav


def _euroc_rig(path: Path, mav: Path, given: Path | None) -> StereoRig:
    sensors = [mav / camera / "sensor.yaml" for camera in ("cam0", "cam1")]
    if given is None and all(s.is_file() for s in sensors):
        imu, body = mav / "imu0" / "sensor.yaml", mav / "body.yaml"
        is_flu = body.is_file() and str(read_yaml(body).get("axes", "")).upper() == "FLU"
        return read_sensor_pair(*sensors, imu=imu if imu.is_file() else None, body_is_flu=is_flu)
    chain = given or find_calibration(path, mav, path / "dso", mav.parent)
    if chain is None:
        text = "no calibration: neither cam0/sensor.yaml and cam1/sensor.yaml nor dso/camchain.yaml"
        cure = "put Kalibr's camchain.yaml into the folder or name one with --calibration"
        raise CalibrationError(text, where=mav, cure=cure)
    return read_stereo_yaml(chain)


def _read_image_list(path: Path, known: SourceReport) -> list[tuple[int, str]]:
    """(stamp, file name) of each line, in order of time; a line that is neither is counted and skipped."""
    out = []
    for number, text in text_lines(path):
        if text.startswith("#"):
            continue
        stamp, _, name = (part.strip() for part in text.partition(","))
        name = name or f"{stamp}.png"
        try:
            if not 0 < len(name.encode()) <= 255 or name in (".", "..") or set(name) & set("/\\\0"):
                raise ValueError  # it would lead out of its folder
            out.append((integer_ns(stamp), name))
        except ValueError:
            known.count("unreadable", f"{path.parent.name}/{path.name} line {number} is not 'stamp_ns,file'")
    if not out:
        raise SourceError("lists no images", where=path, cure="a line 'stamp_ns,file' per image")
    in_time = sorted(out, key=lambda line: line[0])
    if in_time != out:
        known.note(f"{path.parent.name}/{path.name} is not in time order: sorted by stamp")
    return in_time


def _marker_to_imu(mav: Path, folder: str) -> Array:
    """(4, 4) IMU to the frame whose poses the truth folder holds, identity where nothing else is said."""
    T = []
    for sensor in (folder, "imu0"):
        file = mav / sensor / "sensor.yaml"
        document = read_yaml(file) if file.is_file() else {}
        T.append(sensor_pose(document, file) if "T_BS" in document else np.eye(4))
    T_body_marker, T_body_imu = T
    return se3.inverse(T_body_marker) @ T_body_imu


def _stated_noise(sensor: Path) -> TruthNoise | None:
    """Noise that the truth's own ``sensor.yaml`` states, as gpvo's simulator writes it."""
    document = read_yaml(sensor) if sensor.is_file() else {}
    stated = [document.get(k) for k in ("sigma_translation_m", "sigma_rotation_rad")]
    values = [float(v) for v in stated if isinstance(v, (int, float)) and 0 <= v < 10]
    return (values[0], values[1]) if len(values) == 2 else None


def _folder(path: Path, camera: int) -> Path:
    """Where the images of a KITTI camera lie: in raw drives, in a folder below that of their stamps."""
    raw = path / f"image_{camera:02d}" / "data"
    return raw if raw.is_dir() else path / f"image_{camera}"


class KittiSource(FileSource):
    """A sequence folder with ``image_0 image_1`` (or ``image_2 image_3``), ``calib.txt`` and ``times.txt``; or a raw
    drive with ``image_00/data`` and so on, rectified (``_sync``), and ``calib_cam_to_cam.txt`` there or one up.

    The grey pair is taken where it is there. Poses are read from ``poses.txt`` in the folder or
    ``../../poses/NN.txt``. ``calibration``: another ``calib.txt``, or a stereo YAML.
    """

    format = "kitti"

    def __init__(self, path: Path, *, calibration: str | Path | None = None, **options: Any) -> None:
        raw = (folder / "calib_cam_to_cam.txt" for folder in (path, path.resolve().parent))
        own = next((c for c in (path / "calib.txt", *raw) if c.is_file()), path / "calib.txt")
        calib = own if calibration is None else Path(calibration)
        if not calib.is_file():
            raise CalibrationError("no calibration", where=calib, cure="copy the sequence's calib.txt there")
        left, right = self._cameras(path)
        times = path / f"image_{left:02d}" / "timestamps.txt"
        if not times.is_file():
            times = path / "times.txt"
        if not times.is_file():
            raise SourceError("no time stamps", where=times, cure="one line of seconds per frame")
        stamps, known = read_times(times), SourceReport()
        pairs = self._list_pairs(path, stamps, left, right, known)
        first = first_size(pairs, "left")  # the calibration does not say it
        if first is None:
            raise SourceError("no readable left image", where=path)
        is_yaml, size = calib.suffix.lower() in (".yaml", ".yml"), first[1]
        rig = read_stereo_yaml(calib, size=size) if is_yaml else read_kitti_calib(calib, left, right, size)
        super().__init__(path, path.resolve().name, rig, pairs, known, **options)
        # Poses are of camera 0, whose place only KITTI's own file tells.
        T_cam0_left = left_camera_offset(own if own.is_file() else calib, left)
        self.truth = self._read_truth(path, stamps, T_cam0_left @ self.rectifier.T_left_cam)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A folder with KITTI's image folders."""
        return (
            path.is_dir()
            and any(map(Path.is_dir, (_folder(path, camera) for camera in (0, 2))))
            and any(f for name in ("times.txt", "calib.txt", "image_0[02]/timestamps.txt") for f in path.glob(name))
        )

    @staticmethod
    def _cameras(path: Path) -> tuple[int, int]:
        for left, right in ((0, 1), (2, 3)):
            if _folder(path, left).is_dir() and _folder(path, right).is_dir():
                return left, right
        cure = "image_0 and image_1 (grey) or image_2 and image_3, of raw drives image_00/data and so on"
        raise SourceError("has no pair of image folders", where=path, cure=cure)

    @staticmethod
    def _list_pairs(path: Path, stamps: Stamps, left: int, right: int, known: SourceReport) -> list[PairFiles]:
        """One pair per line of ``times.txt``, named by index; a file without a line is counted, not guessed."""
        folders = (_folder(path, left), _folder(path, right))
        names: list[dict[int, Path]] = []
        for folder in folders:
            files = (f for f in folder.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES and f.stem.isdecimal())
            names.append({int(f.stem): f for f in files})
            if not names[-1]:
                raise SourceError("holds no images", where=folder, cure="expected names like 000000.png")
        surplus = {i for found in names for i in found if i >= len(stamps)}
        if surplus:
            known.count("missing", f"{counted(len(surplus), 'frame')} without a line in times.txt", len(surplus))
        suffix = next(iter(names[0].values())).suffix
        return [
            PairFiles(int(t), *(found.get(i, folder / f"{i:06d}{suffix}") for found, folder in zip(names, folders)))
            for i, t in enumerate(stamps)
        ]

    @staticmethod
    def _read_truth(path: Path, stamps: Stamps, T_cam0_cam: Array) -> TruthLog | None:
        candidates = (path / "poses.txt", path.resolve().parent.parent / "poses" / f"{path.resolve().name}.txt")
        file = next((c for c in candidates if c.is_file()), None)
        if file is None:
            return None
        T_world_cam0 = read_kitti_poses(file)
        if len(T_world_cam0) != len(stamps):
            text = f"holds {counted(len(T_world_cam0), 'pose')} for the {len(stamps)} lines of times.txt"
            cure = "KITTI poses have no stamps: both files must have one line per frame"
            raise SourceError(text, where=file, cure=cure)
        grows = growing(stamps)
        return carry(Trajectory(stamps[grows], T_world_cam0[grows]), T_cam0_cam, GPS_INS)
