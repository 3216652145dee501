"""KITTI odometry: rectified pairs by index, ``calib.txt``, ``times.txt`` and poses of the left camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gpvo.cameras.projections import left_camera_offset, read_kitti_calib
from gpvo.errors import CalibrationError, SourceError
from gpvo.io.images import IMAGE_SUFFIXES, FileSource, PairFiles, first_size
from gpvo.io.source import SourceReport
from gpvo.io.stamps import growing
from gpvo.io.trajectory import GPS_INS, Trajectory, TruthNoise, carry, read_kitti_poses, read_times
from gpvo.types import TruthLog


class KittiSource(FileSource):
    """A sequence folder with ``image_0 image_1`` (or ``image_2 image_3``), ``calib.txt`` and ``times.txt``.

    Poses are read from ``poses.txt`` in the folder or ``../../poses/NN.txt``. ``colour`` chooses the colour pair;
    by default the grey one where it is there. ``truth_noise`` replaces the default of GPS/INS.
    """

    format = "kitti"

    def __init__(
        self,
        path: Path,
        *,
        colour: bool | None = None,
        calibration: str | Path | None = None,
        truth_noise: TruthNoise = GPS_INS,
        **options: Any,
    ) -> None:
        calib = Path(calibration) if calibration is not None else path / "calib.txt"
        if not calib.is_file():
            raise CalibrationError("no calibration", where=calib, cure="copy the sequence's calib.txt there")
        left, right = self._cameras(path, colour)
        known = SourceReport()
        pairs = self._list_pairs(path, left, right, known)
        first = first_size(pairs, "left")  # the calibration does not say it
        if first is None:
            raise SourceError("not one readable left image", where=path)
        rig = read_kitti_calib(calib, left=left, right=right, size=first[1])
        super().__init__(path, path.name, rig, pairs, known, **options)
        self.truth = self._read_truth(path, calib, left, truth_noise)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A folder with KITTI's image folders."""
        return (
            path.is_dir()
            and any((path / f"image_{a}").is_dir() for a in (0, 2))
            and ((path / "times.txt").is_file() or (path / "calib.txt").is_file())
        )

    @staticmethod
    def _cameras(path: Path, colour: bool | None) -> tuple[int, int]:
        for left, right in ((0, 1), (2, 3)):
            if colour is not None and colour != (left == 2):
                continue
            if (path / f"image_{left}").is_dir() and (path / f"image_{right}").is_dir():
                return left, right
        raise SourceError(
            "has no pair of image folders", where=path, cure="image_0 and image_1 (grey) or image_2 and image_3"
        )

    @staticmethod
    def _list_pairs(path: Path, left: int, right: int, known: SourceReport) -> list[PairFiles]:
        """One pair per line of ``times.txt``, named by index; a file without a line is counted, not guessed."""
        times = path / "times.txt"
        if not times.is_file():
            raise SourceError("no time stamps", where=times, cure="one line of seconds per frame")
        stamps = read_times(times)
        folders = (path / f"image_{left}", path / f"image_{right}")
        names: list[dict[int, Path]] = []
        for folder in folders:
            files = (f for f in folder.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES and f.stem.isdigit())
            names.append({int(f.stem): f for f in files})
        if not names[0] or not names[1]:
            empty = folders[0] if not names[0] else folders[1]
            raise SourceError("holds no images", where=empty, cure="expected names like 000000.png")
        surplus = {i for found in names for i in found if i >= len(stamps)}
        if surplus:
            known.missing += len(surplus)
            known.note(f"{len(surplus)} frames have no line in times.txt")
        suffix = next(iter(names[0].values())).suffix
        return [
            PairFiles(int(t), *(found.get(i, folder / f"{i:06d}{suffix}") for found, folder in zip(names, folders)))
            for i, t in enumerate(stamps)
        ]

    @staticmethod
    def _read_truth(path: Path, calib: Path, left: int, noise: TruthNoise) -> TruthLog | None:
        candidates = (path / "poses.txt", path.resolve().parent.parent / "poses" / f"{path.resolve().name}.txt")
        file = next((c for c in candidates if c.is_file()), None)
        if file is None:
            return None
        T_world_cam0 = read_kitti_poses(file)
        stamps = read_times(path / "times.txt")
        if len(T_world_cam0) != len(stamps):
            raise SourceError(
                f"holds {len(T_world_cam0)} poses for the {len(stamps)} lines of times.txt",
                where=file,
                cure="KITTI poses have no stamps: both files must have one line per frame",
            )
        grows = growing(stamps)
        return carry(Trajectory(stamps[grows], T_world_cam0[grows]), left_camera_offset(calib, left), noise)
