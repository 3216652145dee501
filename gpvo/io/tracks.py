"""Stereo tracks: pixel tracks of a rectified pair instead of images ("bring your own front end").

An ``.npz`` with one row per observation: ``frame`` (M,), ``track`` (M,), ``uv_left``, ``uv_right`` (M, 2) [px]; per
frame ``t_s`` (N,); ``fx fy cx cy`` [px] and ``baseline_m``. Optional: ``T_world_cam`` (N, 4, 4) truth of the left
camera, NaN in frames without; ``gyro_body_radps`` and ``acc_body_mps2`` (N, 3) in body axes with ``R_cam_body``
(3, 3) and ``p_body_cam_in_body_m`` (3,), ``vel_body_mps`` (N, 3) of the body as the truth measures it beside its
positions (with the gyroscope), ``width``, ``height`` [px], ``sigma_translation_m``, ``sigma_rotation_rad``;
an IMU at its own rate in body axes as ``imu_t_ns`` (K,), ``imu_gyro_radps``, ``imu_acc_mps2`` (K, 3) and
``imu_noise`` (4,), the fields of :class:`gpvo.types.ImuNoise`.
"""

from __future__ import annotations

import math
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.imagesize import MAX_SIDE_PX
from gpvo.cameras.models import PinholeRadtan
from gpvo.cameras.rig import StereoRig, check_pose
from gpvo.errors import SourceError
from gpvo.geometry import se3
from gpvo.io.source import SourceReport
from gpvo.io.stamps import UNITS_NS, check_interval, growing, in_order, likely_unit
from gpvo.io.trajectory import GPS_INS
from gpvo.types import Array, ImuLog, ImuNoise, Mounting, StereoCamera, TrackFrame, TruthLog

_REQUIRED = ("t_s", "frame", "track", "uv_left", "uv_right", "fx", "fy", "cx", "cy", "baseline_m")
_OPTIONAL = (
    "T_world_cam", "gyro_body_radps", "acc_body_mps2", "R_cam_body", "p_body_cam_in_body_m", "vel_body_mps", "width",
    "height", "sigma_translation_m", "sigma_rotation_rad", "imu_t_ns", "imu_gyro_radps", "imu_acc_mps2", "imu_noise",
)  # fmt: skip
_MAX_UNPACKED_BYTES = 1_000_000_000
# Tracks pack to a fifth; zeros to a thousandth.
_PLAIN_BYTES, _MAX_RATIO = 50_000_000, 50
_MAX_STAMP_S = 9.2e9
_MAX_PX = 1e6


class TracksSource:
    """Frames of tracks from one ``.npz`` file.

    The gyroscope, sampled once per frame, becomes an :class:`ImuLog` in body axes; without an accelerometer in the
    file its ``acc_mps2`` is NaN throughout, which says "none", never zero.
    """

    kind: Literal["images", "tracks"] = "tracks"
    format = "tracks"

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, path.stem
        self._data, self.report = load_arrays(path, _REQUIRED, _OPTIONAL), SourceReport()
        self._t_ns = self._stamps()
        self._observations()
        self.camera = self._make_camera()
        self.mask: NDArray[np.bool_] | None = None
        T_body_cam = self._body_cam()
        self.mounting = Mounting(T_body_cam=T_body_cam, T_imu_cam=T_body_cam)
        self.imu = self._make_imu()
        self.truth = self._make_truth()
        self.calibration: dict[str, Any] | None = None
        self.span_ns = (int(self._t_ns.min()), int(self._t_ns.max()))

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """An ``.npz`` file."""
        return path.is_file() and path.suffix.lower() == ".npz"

    def __len__(self) -> int:
        return len(self._t_ns)

    def __iter__(self) -> Iterator[TrackFrame]:
        self.report = report = SourceReport()
        for frame in in_order(self._frames(), report):
            report.frames += 1
            yield frame

    def _frames(self) -> Iterator[TrackFrame]:
        for k, t in enumerate(self._t_ns):
            rows = self._rows[self._starts[k] : self._starts[k + 1]]
            yield TrackFrame(int(t), self._track[rows], self._uv_left[rows], self._uv_right[rows])

    def _stamps(self) -> NDArray[np.int64]:
        t_s = self._array("t_s", None, most=1e19)

        def cure(unit: str) -> str:
            return f"'t_s' holds seconds: divide it by {UNITS_NS['s'] // UNITS_NS[unit]:,}"

        most = float(np.abs(t_s).max(initial=0.0))
        if most > _MAX_STAMP_S:
            what = f"'t_s' holds {most:.3g}, the limit is {_MAX_STAMP_S:.3g}"
            raise SourceError(what, where=self.path, cure=cure(likely_unit(str(most)) or "ns"))
        t_ns = np.rint(t_s * 1e9).astype(np.int64)
        check_interval(t_ns, self.path, cure, is_stated=True)
        return t_ns

    def _observations(self) -> None:
        path, n = self.path, len(self._t_ns)
        frame = self._array("frame", None, most=2.0**53).astype(np.int64)
        m = len(frame)
        self._track = self._array("track", m, most=2.0**62).astype(np.int64)
        self._uv_left = self._array("uv_left", m, 2, most=_MAX_PX)
        self._uv_right = self._array("uv_right", m, 2, most=_MAX_PX)
        if n == 0 or m == 0:
            raise SourceError("holds no observations", where=path)
        if frame.min() < 0 or frame.max() >= n:
            raise SourceError(f"'frame' goes up to {frame.max()}, but 't_s' has {n} stamps", where=path)
        self._rows = np.argsort(frame, kind="stable")
        self._starts = np.searchsorted(frame[self._rows], np.arange(n + 1))

    def _make_camera(self) -> StereoCamera:
        fx, fy, cx, cy, b = (float(self._array(k)) for k in ("fx", "fy", "cx", "cy", "baseline_m"))
        both = np.concatenate([self._uv_left, self._uv_right])
        if "width" in self._data and "height" in self._data:
            width, height = (int(self._array(k, most=MAX_SIDE_PX)) for k in ("width", "height"))
        else:
            # Not stated: large enough for every observation and for a principal point in the middle.
            width = max(int(np.ceil(both[:, 0].max())) + 1, round(2 * cx) + 1)
            height = max(int(np.ceil(both[:, 1].max())) + 1, round(2 * cy) + 1)
        lens = PinholeRadtan(fx, fy, cx, cy, width, height)
        # Refuses what cannot be a pair.
        StereoRig(lens, lens, se3.from_rt(np.eye(3), np.array([-b, 0.0, 0.0])), where=str(self.path))
        return StereoCamera(fx, fy, cx, cy, b, width, height)

    def _body_cam(self) -> Array | None:
        if "R_cam_body" not in self._data:
            return None
        R_cam_body = self._array("R_cam_body", 3, 3)
        p = self._array("p_body_cam_in_body_m", 3, absent=np.zeros(3))
        return check_pose(se3.from_rt(R_cam_body.T, p), "R_cam_body", self.path)

    def _make_imu(self) -> ImuLog | None:
        """At its own rate, else once per frame."""
        names, noise, t_ns = ("gyro_body_radps", "acc_body_mps2"), None, self._t_ns
        if "imu_t_ns" in self._data:
            names, t_ns = ("imu_gyro_radps", "imu_acc_mps2"), self._data["imu_t_ns"]
            if t_ns.ndim != 1 or t_ns.dtype.kind not in "iu" or (t_ns > _MAX_STAMP_S * 1e9).any():
                what = f"'imu_t_ns' is {t_ns.dtype} {t_ns.shape}, expected nanoseconds (N,)"
                raise SourceError(what, where=self.path)
            if absent := [a for a in names if a not in self._data]:
                raise SourceError(f"has 'imu_t_ns' but not {', '.join(absent)}", where=self.path)
            noise = ImuNoise(*self._array("imu_noise", 4)) if "imu_noise" in self._data else None
        elif names[0] not in self._data:
            return None
        gyro = self._array(names[0], len(t_ns), 3)
        acc = self._array(names[1], len(t_ns), 3, absent=np.full(gyro.shape, np.nan))
        keep = growing(t_ns)
        return ImuLog(t_ns[keep].astype(np.int64), gyro[keep], acc[keep], noise)

    def _make_truth(self) -> TruthLog | None:
        if "T_world_cam" not in self._data:
            return None
        T = self._array("T_world_cam", len(self._t_ns), 4, 4, finite=False)
        keep = growing(self._t_ns) & ~np.isnan(T[:, :3]).all(axis=(1, 2))
        if not keep.any():
            raise SourceError("'T_world_cam' is NaN throughout", where=self.path, cure="without truth, leave it out")
        poses = [check_pose(T[k], f"'T_world_cam' row {k}", self.path) for k in np.flatnonzero(keep)]
        stated, (sigma_t, sigma_r) = ("sigma_translation_m", "sigma_rotation_rad"), GPS_INS
        if all(k in self._data for k in stated):
            sigma_t, sigma_r = (abs(float(self._array(k, most=1e3))) for k in stated)
        return TruthLog(self._t_ns[keep], np.stack(poses), sigma_t, sigma_r, self._velocity(np.stack(poses), keep))

    def _velocity(self, T_world_cam: Array, keep: NDArray[np.bool_]) -> Array | None:
        """(K, 3) velocity of the camera, from the body's and its turning; None where the file does not have all."""
        T_body_cam = self.mounting.T_body_cam
        if T_body_cam is None or not {"vel_body_mps", "gyro_body_radps"} <= set(self._data):
            return None
        v, gyro = (self._array(a, len(self._t_ns), 3)[keep] for a in ("vel_body_mps", "gyro_body_radps"))
        v_cam = (v + np.cross(gyro, T_body_cam[:3, 3])) @ T_body_cam[:3, :3]
        return np.asarray(np.einsum("nij,nj->ni", T_world_cam[:, :3, :3], v_cam))

    def _array(
        self, key: str, *shape: int | None, finite: bool = True, most: float = 1e12, absent: Array | None = None
    ) -> Array:
        """An array of the file as float64 of the given shape, no value beyond ``most``; None matches any length.
        ``absent``: what stands for it where the file has none."""
        if absent is not None and key not in self._data:
            return absent
        array = self._data[key]
        fits = array.ndim == len(shape) and all(s is None or s == n for s, n in zip(shape, array.shape))
        if not fits:
            wanted = tuple("N" if s is None else s for s in shape)
            raise SourceError(f"'{key}' has shape {array.shape}, expected {wanted}", where=self.path)
        if array.dtype.kind not in "fiu":
            raise SourceError(f"'{key}' holds {array.dtype}, not numbers", where=self.path)
        out = array.astype(np.float64)
        if finite and not np.isfinite(out).all():
            first = int(np.argwhere(~np.isfinite(np.atleast_1d(out)))[0][0])
            raise SourceError(f"'{key}' is NaN or infinite at row {first}", where=self.path, cure="drop that row")
        if (np.abs(out) > most).any():
            raise SourceError(f"'{key}' holds {np.nanmax(np.abs(out)):.3g}, the limit is {most:.3g}", where=self.path)
        return out


def load_arrays(path: Path, required: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, NDArray[Any]]:
    """Those arrays of an ``.npz`` that are asked for, sizes checked before anything is unpacked, nothing unpickled.

    Raises SourceError where the file is damaged, too large, or lacks a required array.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            named = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            wanted = {name: named[name] for name in (*required, *optional) if name in named}
            n_bytes = sum(entry.file_size for entry in wanted.values())
            packed = sum(entry.compress_size for entry in wanted.values())
            if n_bytes > _MAX_UNPACKED_BYTES or n_bytes > _PLAIN_BYTES + _MAX_RATIO * packed:
                raise SourceError(f"unpacks {packed} bytes to {n_bytes}: too large for tracks", where=path)
            data = {name: _read_array(archive, entry) for name, entry in wanted.items()}
    except SourceError:
        raise
    except OSError as error:
        raise SourceError(f"cannot be read: {error.strerror or error}", where=path) from None
    # Each layer has its own errors: zip, deflate, unknown compressions, passwords, and NumPy's headers.
    except (ArithmeticError, EOFError, LookupError, MemoryError, RuntimeError, SyntaxError, TypeError, ValueError,
            tokenize.TokenError, zipfile.BadZipFile, zlib.error) as error:  # fmt: skip
        reason = (str(error).splitlines() or [repr(error)])[0][:160]
        raise SourceError(f"not readable as .npz: {reason}", where=path) from None
    absent = [k for k in required if k not in data]
    if absent:
        raise SourceError(f"lacks {', '.join(absent)}", where=path, cure=f"tracks need {', '.join(required)}")
    return data


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    """One array, whose shape is held against the bytes there are before it is made."""
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(file)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize > entry.file_size:
        raise ValueError(f"'{entry.filename}' of {dtype} {shape} does not fit its {entry.file_size} bytes")
    with archive.open(entry) as file:
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
