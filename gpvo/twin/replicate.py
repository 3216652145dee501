"""Twins of a run: its structure, that is the path, the landmarks and the pixel noise that twins are made of; its flight
seen again with new noise by a rig that its calibration allows; and odometry over that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.rig import RIG_ERRORS, TOLERANCES, Tolerance, TrueRig
from gpvo.errors import GpvoError, SourceError
from gpvo.files import digest_of_file, read_toml
from gpvo.geometry import se3
from gpvo.io.run import Run, is_finished, read_run, read_tracks
from gpvo.io.run_folder import OWN
from gpvo.io.snapshot import digest_of
from gpvo.io.source import SourceReport
from gpvo.parallel import map_jobs
from gpvo.runner import config_of
from gpvo.runner import run as run_odometry
from gpvo.twin.bundle import Observations
from gpvo.twin.common import CommonField, drawn_signs
from gpvo.twin.gap import Gap, restated
from gpvo.twin.noise import Neighbours, Structure, adjust, draw_signs, restored, without_loose_frames
from gpvo.types import Array, ImuLog, Mounting, StereoCamera, TrackFrame, TruthLog, VoRecord
from gpvo.vo.config import VoConfig
from gpvo.vo.rig_error import N_TERMS, RigError, RigState, terms
from gpvo.vo.rig_findings import STATE_FILE, read_start, read_state

MIN_POINTS = 12
"""A run whose median motion has fewer inliers is refused: path, landmarks and noise cannot be told apart."""
_SHOWN_BY_IMAGES = ("n_detected", "n_stereo", "brightness", "contrast", "sharpness", "noise_level")


@dataclass(frozen=True)
class Original:
    """A run with its structure. ``noise_px`` (M, 3): residuals of the observations as large as the noise was;
    ``neighbours``: which tracks may err alike; ``common``: how all err alike; ``first`` (M,) the first observation of
    each track; ``repeats`` (F,) frames that repeat the one before. ``rig``: what odometry found of its calibration's
    errors; measurements are ``seen`` without them. ``start``: what was known of these before, None if nothing."""

    run: Run
    config: VoConfig
    rig: RigState
    seen: Observations
    structure: Structure
    noise_px: Array
    neighbours: Neighbours
    common: CommonField
    first: NDArray[np.bool_]
    repeats: NDArray[np.bool_]
    start: RigState | None = None


def estimate(path: Path) -> Original:
    """The structure of a run.

    Raises SourceError where the run holds no tracks, no camera, or too few points to tell path, landmarks and noise
    apart.
    """
    run = read_run(path)
    tracks = read_tracks(path)
    if run.log.camera is None:
        raise SourceError("does not know its camera", where=path, cure="run the sequence with 'gpvo run --keep-tracks'")
    t_ns = run.log.t_ns
    frame = np.searchsorted(t_ns, tracks.t_ns)
    if len(frame) == 0 or frame.max() >= len(t_ns) or not (t_ns[frame] == tracks.t_ns).all():
        raise SourceError("its tracks do not match its frames", where=path / "tracks.parquet", cure="run it again")
    _, begins, track = np.unique(tracks.track, return_index=True, return_inverse=True)
    first = np.isin(np.arange(len(track)), begins)
    _refuse_too_few(frame[tracks.is_inlier & ~first], path)
    repeats = np.array(["frozen" in r.reason for r in run.log])
    camera = run.log.camera
    rig = read_state(path, camera) if (path / STATE_FILE).is_file() else RigState.exact()
    uvd = RigError(camera, rig, learn=False).correct(tracks.uvd, _twists(run.log.trajectory(), t_ns)[frame].T)
    seen = Observations(camera, frame, track, uvd, tracks.is_inlier & ~repeats[frame])
    structure = without_loose_frames(adjust(seen, run.log.trajectory()), seen, t_ns)
    if not np.isfinite(structure.residual_px).all():
        raise SourceError("its structure cannot be estimated: the fit fails", where=path, cure="look at the run")
    neighbours = Neighbours.of(seen, structure)
    noise = restored(seen, structure)
    common = CommonField.of(seen, structure, noise, drawn_signs(len(structure.points_world), neighbours), t_ns)
    start = read_start(path, camera)
    return Original(run, config_of(path), rig, seen, structure, noise, neighbours, common, first, repeats, start)


def _twists(T_world_cam: Array, t_ns: NDArray[np.int64]) -> Array:
    """(F, 6) velocity per second in each frame: the mean of that before and that after it."""
    before = se3.log(se3.inverse(T_world_cam[:-1]) @ T_world_cam[1:]) / (np.diff(t_ns)[:, None] * 1e-9)
    return 0.5 * (np.concatenate([before[:1], before]) + np.concatenate([before, before[-1:]]))


def _refuse_too_few(frame: NDArray[np.int64], path: Path) -> None:
    counts = np.bincount(frame)
    usual = float(np.median(counts[counts > 0])) if len(frame) else 0.0
    if usual < MIN_POINTS:
        raise SourceError(
            f"its structure cannot be estimated: {usual:.0f} points per motion, {MIN_POINTS} are needed",
            where=path,
            cure="run it with more features, or train on runs with ground truth",
        )


@dataclass(frozen=True)
class TwinSettings:
    """``replicates`` of each run; ``tolerance`` of the rig, drawn for each replicate, by the ``tolerance_name``;
    ``gap``: by how much real errors exceed those of twins, drawn for each replicate too."""

    replicates: int = 8
    tolerance: Tolerance = field(default_factory=Tolerance)
    tolerance_name: str = "none"
    seed: int = 0
    gap: Gap | None = None


@dataclass
class TwinSource:
    """A twin as a sequence of tracks: a :class:`gpvo.io.source.Source` in memory, with exact truth."""

    name: str
    path: Path
    camera: StereoCamera
    mounting: Mounting
    imu: ImuLog | None
    truth: TruthLog | None
    frames: list[TrackFrame]
    span_ns: tuple[int, int]
    kind: Literal["images", "tracks"] = "tracks"
    format: str = "twin"
    mask: NDArray[np.bool_] | None = None
    calibration: dict[str, Any] | None = None
    report: SourceReport = field(default_factory=SourceReport)

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[TrackFrame]:
        self.report = SourceReport(frames=len(self.frames))
        return iter(self.frames)


def twin_source(original: Original, settings: TwinSettings, replicate: int) -> TwinSource:
    """One twin. Equal settings and replicate give equal twins."""
    run, seen = original.run, original.seen
    rng = np.random.default_rng([settings.seed, replicate, 29])
    pixels = _projected(original, settings, replicate)
    # The residuals of each track, as a whole, with its sign; but an outlier is an event, and happens again as it was.
    signs = draw_signs(len(original.structure.points_world), original.neighbours, rng)[seen.track]
    noise = original.noise_px * np.where(original.structure.weight > 0, signs, 1.0)[:, None]
    if original.common:
        drawn = original.common.draw(seen, np.random.default_rng([settings.seed, replicate, 37]))
        noise += np.where(original.structure.weight[:, None] > 0, drawn, 0.0)
    uv_left, uv_right = pixels[0] + noise[:, :2], pixels[1] + noise[:, :2] - noise[:, 2:] * [1.0, 0.0]
    # An outlier's landmark may lie behind a camera that saw something else there.
    size = np.array([seen.camera.width, seen.camera.height])
    off = np.stack([uv_left, uv_right], axis=1) / size - 0.5
    in_view = np.abs(off).reshape(-1, 4).max(axis=1) < 1.5
    t_ns = run.log.t_ns
    starts = np.searchsorted(seen.frame, np.arange(len(t_ns) + 1))
    frames: list[TrackFrame] = []
    for k, t in enumerate(t_ns):
        rows = starts[k] + np.flatnonzero(in_view[starts[k] : starts[k + 1]])
        if original.repeats[k] and frames:
            frames.append(replace(frames[-1], t_ns=int(t)))
            continue
        frames.append(TrackFrame(int(t), seen.track[rows], uv_left[rows], uv_right[rows]))
    name = f"{run.name}-twin{replicate}"
    truth = TruthLog(t_ns, original.structure.T_world_cam)
    return TwinSource(name, run.path, seen.camera, run.mounting, run.imu, truth, frames, (int(t_ns[0]), int(t_ns[-1])))


def rig_errors(settings: TwinSettings) -> Array:
    """(replicates, 8) how wrong the rig of each twin is, in sigma: baseline, focal length, and what turns the right
    image, the largest effects first.

    Drawn at random; then the first five are made uncorrelated and of unit size over the replicates (moment matching),
    as a handful of draws would show a covariance of five numbers wrongly by chance; of five or fewer that cannot be.
    """
    n = settings.replicates
    drawn = np.random.default_rng([settings.seed, 29]).standard_normal((n, 2 + N_TERMS))
    matched = drawn[:, :RIG_ERRORS]
    if n > RIG_ERRORS:
        drawn[:, :RIG_ERRORS] = matched @ np.linalg.inv(np.linalg.cholesky(matched.T @ matched / n)).T
    return drawn


def _principal_errors(state: RigState, camera: StereoCamera) -> Array:
    """(15, 15) columns whose sum, each times a standard normal number, is a draw of dx; those that displace the image
    most come first."""
    values, vectors = np.linalg.eigh(state.covariance[:N_TERMS, :N_TERMS])
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    y, x = (f.ravel() for f in np.mgrid[-1:1:7j, -1:1:9j])
    over = terms(0.5 * camera.width / camera.fx_px * x, 0.5 * camera.height / camera.fy_px * y)
    return np.asarray(root @ np.linalg.svd(over.T @ root)[2].T, np.float64)


def _projected(original: Original, settings: TwinSettings, replicate: int) -> tuple[Array, Array]:
    """Left and right pixels (M, 2) of the landmarks in the rig of a twin, without noise: its baseline and focal length
    are drawn from the tolerance, what displaces its right image from what odometry found, or if that looked for nothing
    (without self-calibration), as a turn from the tolerance."""
    seen, known = original.seen, original.rig
    e, camera = rig_errors(settings)[replicate], seen.camera
    tolerance = replace(settings.tolerance, rotation_rad=0.0) if known.covariance.any() else settings.tolerance
    left, right = TrueRig.of(camera, tolerance, e[:RIG_ERRORS]).pixels(original.structure.in_camera(seen))
    mean = known.mean.copy()
    mean[:N_TERMS] += _principal_errors(known, camera) @ e[2:]
    drawn = replace(known, mean=mean)
    displaced_d, displaced_row = RigError(camera, drawn, learn=False).errors(
        np.stack([left[:, 0], left[:, 1], left[:, 0] - right[:, 0]], axis=1),
        _twists(original.structure.T_world_cam, original.run.log.t_ns)[seen.frame].T,
    )
    return left, right + np.stack([-displaced_d, displaced_row], axis=1)


def make_twins(
    path: Path, out: Path, settings: TwinSettings, *, jobs: int = 1, on_twin: Callable[[], None] = lambda: None
) -> list[Path]:
    """Twins of one run as run folders ``out/NAME-twinK``, by the odometry and the settings of the run; finished ones of
    the same run and settings are left as they are.

    Raises SourceError as :func:`estimate`, and where the folder holds twins that these would not replace.
    """
    made = range(settings.replicates)
    # One that begins with a dot was to replace a finished twin when the process was killed; the new one clears it.
    others = (p for p in sorted(out.glob("[!.]*-twin*/")) if p.name.rpartition("-twin")[2] not in map(str, made))
    if (other := next(others, None)) is not None:
        cure = "remove it, make as many as before, or give another folder"
        raise SourceError(f"is a twin that {settings.replicates} replicates would not replace", where=other, cure=cure)
    # What decides the twins of a run.
    of = digest_of({p.name: digest_of_file(p) for name in OWN if (p := path / name).is_file()}, asdict(settings))
    name = read_run(path).name
    folders = [out / f"{name}-twin{k}" for k in made]
    left = [k for k in made if not _is_made(folders[k], of, k)]
    for _ in range(len(made) - len(left)):
        on_twin()
    if left:
        original = estimate(path)
        map_jobs(_make_twin, [(original, settings, k, out, of) for k in left], jobs=jobs, on_done=on_twin)
    return folders


def _is_made(folder: Path, of: str, replicate: int) -> bool:
    try:
        about = read_run(folder).meta.get("twin") if is_finished(folder) else None
    except SourceError:  # damaged
        return False
    return about is not None and (about.get("digest"), about.get("replicate")) == (of, replicate)


def _make_twin(original: Original, settings: TwinSettings, replicate: int, out: Path, of: str) -> Path:
    source = twin_source(original, settings, replicate)
    about = {**asdict(settings), "of": original.run.name, "replicate": replicate, "digest": of}
    about["common_variance_px2"] = original.common.about()
    truth, log = source.truth, original.run.log
    factor = np.ones(6) if settings.gap is None else settings.gap.factors(settings.replicates)[replicate]
    matched = np.bincount(original.seen.frame[~original.first], minlength=len(log))
    as_seen = {r.t_ns: (r, max(r.n_tracked - int(n), 0)) for r, n in zip(log, matched)}

    def amend(record: VoRecord) -> VoRecord:
        """With what points alone cannot show, as the run saw it: its images, and points without a match."""
        assert truth is not None
        own, unmatched = as_seen[record.t_ns]
        shown: dict[str, Any] = {name: getattr(own, name) for name in _SHOWN_BY_IMAGES}
        if record.n_tracked >= 0:
            shown["n_tracked"] = record.n_tracked + unmatched
        return restated(replace(record, **shown), truth, factor)

    run_odometry(
        source, out / source.name, original.config, calibration_state=original.start, amend=amend, meta={"twin": about}
    )
    return out / source.name


def read_tolerance(text: str) -> tuple[str, Tolerance]:
    """A named tolerance, or that of a TOML file, with its name. Raises GpvoError where it is neither."""
    if text in TOLERANCES:
        return text, TOLERANCES[text]
    path = Path(text)
    known = {f.name for f in fields(Tolerance)} - {"distortion"}
    cure = f"give one of {', '.join(TOLERANCES)}, or a TOML file with {', '.join(sorted(known))}"
    if not path.is_file():
        raise GpvoError(f"unknown tolerance '{text}'", cure=cure)
    values = read_toml(path)
    small = all(type(v) in (int, float) and 0 <= v <= 0.2 for v in values.values())
    if not values or set(values) - known or not small:
        raise GpvoError("does not describe a tolerance: numbers from 0 to 0.2", where=path, cure=cure)
    return path.stem, Tolerance(**{k: float(v) for k, v in values.items()})
