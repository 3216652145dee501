"""What odometry saw, as pictures: a run in progress in the rerun viewer, and the matches behind single motions.

rerun (Apache-2.0 or MIT) is optional: ``pip install gpvo[viz]``.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gpvo.accumulation import PoseError
from gpvo.errors import GpvoError
from gpvo.files import make_folder, refuse_foreign
from gpvo.geometry import se3
from gpvo.io.source import Source
from gpvo.runner import Step, steps
from gpvo.types import Array, MotionError, Prediction, Status, StereoCamera, StereoFrame, VoLog, VoRecord
from gpvo.vo.config import VoConfig

_GOOD, _BAD, _PATH, _DOUBT = (40, 200, 80), (230, 60, 50), (90, 150, 240), (240, 190, 60)
_CURE = "give the sequence that the run was made from"
_GOOD_BGR, _BAD_BGR = (60, 200, 60), (40, 40, 230)


class LiveView:
    """Shows the steps of one run, in a viewer of its own or, where ``file`` is given, in a file for later.

    The world is the first camera. Ellipsoids are 3 sigma of the position: by the model where there is one, else
    by the geometric covariance, motions taken as independent. Raises GpvoError where rerun is not installed.
    """

    def __init__(self, camera: StereoCamera, name: str, file: Path | None = None) -> None:
        try:
            import rerun
        except ImportError:
            raise GpvoError(
                "the live view needs rerun, which is not installed", cure="pip install 'gpvo[viz]'"
            ) from None
        self._rr: Any = rerun
        rerun.init(f"gpvo {name}", spawn=file is None)
        if file is not None:
            refuse_foreign(file, rb"\ARRF", "recording")
            make_folder(file.parent)
            rerun.save(str(file))
        size = [camera.width, camera.height]
        rerun.log("world/camera/left", rerun.Pinhole(image_from_camera=camera.K, resolution=size), static=True)
        self._reference = (np.eye(4), PoseError())
        self._path: list[Array] = [np.zeros(3)]
        self._t_first_ns: int | None = None

    def show(self, step: Step, prediction: Prediction | None) -> None:
        """Add one step of the run, in order."""
        rr, record = self._rr, step.record
        self._t_first_ns = record.t_ns if self._t_first_ns is None else self._t_first_ns
        rr.set_time("time", duration=(record.t_ns - self._t_first_ns) * 1e-9)
        if isinstance(step.frame, StereoFrame):
            rr.log("world/camera/left", rr.Image(step.frame.left))
        uv, good = step.followed.matches.uvd_cur[:, :2], step.followed.inliers
        colours = np.where(good[:, None], _GOOD, _BAD).astype(np.uint8)
        rr.log("world/camera/left/points", rr.Points2D(uv, colors=colours, radii=2.0))
        rr.log("plots/inliers", rr.Scalars(record.n_inliers))
        if prediction is not None:
            rr.log("plots/sigma_mm", rr.Scalars(1e3 * np.sqrt(np.trace(prediction.covariance[:3, :3]))))
        if record.status is not Status.START:
            self._move(record, prediction)

    def _move(self, record: VoRecord, prediction: Prediction | None) -> None:
        """Go on from the reference. A lost frame's motion is a guess: not drawn, but what follows may build on it."""
        T_world_ref, error = self._reference
        stated = MotionError.independent(next(iter(record.covariances.values()))) if prediction is None else prediction
        T_world_cam, error = T_world_ref @ record.T_prev_cur, error.after(record.T_prev_cur, stated)
        if record.usable:
            self._draw(T_world_cam, error.covariance)
        if record.is_reference:
            self._reference = (T_world_cam, error)

    def _draw(self, T_world_cam: Array, C: Array) -> None:
        """The camera, the path up to it, and three sigma of its position by its covariance ``C`` (6, 6)."""
        rr = self._rr
        self._path.append(T_world_cam[:3, 3])
        variances, axes = np.linalg.eigh(T_world_cam[:3, :3] @ C[:3, :3] @ T_world_cam[:3, :3].T)
        axes = axes * np.linalg.det(axes)  # a rotation, not a reflection
        rr.log("world/camera", rr.Transform3D(translation=T_world_cam[:3, 3], mat3x3=T_world_cam[:3, :3]))
        rr.log("world/path", rr.LineStrips3D([np.array(self._path)], colors=[_PATH]))
        rr.log(
            "world/sigma3",
            rr.Ellipsoids3D(
                centers=[T_world_cam[:3, 3]],
                half_sizes=[3 * np.sqrt(np.maximum(variances, 0.0))],
                quaternions=[rr.Quaternion(xyzw=se3.rotation_to_quaternion_xyzw(axes))],
                colors=[_DOUBT],
            ),
        )


@dataclass(frozen=True)
class MatchPicture:
    """One frame's left image with its points; ``uri`` is a JPEG as a data URI."""

    frame: int
    caption: str
    uri: str


def match_pictures(source: Source, config: VoConfig, frames: Sequence[int], log: VoLog) -> list[MatchPicture]:
    """Figures of the frames of these indices. A run folder holds no images, so the sequence is opened again, and
    odometry repeated with the run's own settings. Raises GpvoError for a frame that the sequence does not have, and
    where ``log``, the run's own, is of another sequence."""
    if log.camera is None or not np.allclose(astuple(source.camera), astuple(log.camera), rtol=1e-6):
        raise GpvoError("its camera or calibration is not that of the run", where=source.path, cure=_CURE)
    if min(frames) < 0:
        raise GpvoError(f"there is no frame {min(frames)}", where=source.path, cure="frames are numbered from 0")
    wanted, last, found = set(frames), max(frames), []
    for k, step in enumerate(steps(source, config)):
        if k < len(log) and step.record.t_ns != log.records[k].t_ns:
            raise GpvoError("its stamps are not those of the run", where=source.path, cure=_CURE)
        if k in wanted:
            found.append(_picture(k, step, source))
        if k == last:
            return found
    raise GpvoError(f"there is no frame {last}", where=source.path, cure="name frames that the sequence has")


def _picture(k: int, step: Step, source: Source) -> MatchPicture:
    record, matches, inliers = step.record, step.followed.matches, step.followed.inliers
    image = getattr(step.frame, "left", None)
    grey = np.full((source.camera.height, source.camera.width), 40, np.uint8) if image is None else image
    canvas = cv2.cvtColor(np.ascontiguousarray(grey), cv2.COLOR_GRAY2BGR)
    for before, now, good in zip(matches.uvd_prev, matches.uvd_cur, inliers, strict=True):
        a, b = (tuple(int(v) for v in np.round(16 * p[:2])) for p in (before, now))
        cv2.line(canvas, a, b, _GOOD_BGR if good else _BAD_BGR, 1, cv2.LINE_AA, shift=4)
        cv2.circle(canvas, b, 32, _GOOD_BGR if good else _BAD_BGR, 1, cv2.LINE_AA, shift=4)
    done, packed = cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, 80])
    assert done
    reason = f" ({record.reason})" if record.reason else ""
    caption = (
        f"frame {k}: {record.status.value}{reason}; {int(inliers.sum())} of {len(inliers)} matches agree,"
        f" {record.reproj_rms_px:.2f} px rms"
    )
    return MatchPicture(k, caption, "data:image/jpeg;base64," + base64.b64encode(packed.tobytes()).decode("ascii"))
