"""A run in progress, in the rerun viewer: the left image with its points, the path, and the stated uncertainty.

rerun (Apache-2.0 or MIT) is optional: ``pip install gpvo[viz]``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gpvo.accumulation import PoseError
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.runner import Step
from gpvo.types import Array, MotionError, Prediction, Status, StereoCamera, StereoFrame, VoRecord

_GOOD, _BAD, _PATH, _DOUBT = (40, 200, 80), (230, 60, 50), (90, 150, 240), (240, 190, 60)


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
