"""Pieces of recorded paths, one per flight: a file of minutes holds many flights of seconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gpvo.io.trajectory import read_euroc_csv, read_tum, tum_line
from gpvo.reproduce.store import Store, digest_of, digest_of_file, write_text


def cut(recording: Path, seed: int, duration_s: float, store: Store) -> Path:
    """A piece of at least ``duration_s`` (all there is, if it is shorter) from a place that follows from the seed."""
    target = store.folder("paths") / f"{recording.stem}-{digest_of(digest_of_file(recording), seed, duration_s)}.txt"
    if target.is_file():
        return target
    path = read_euroc_csv(recording) if recording.suffix.lower() == ".csv" else read_tum(recording)
    clock = (path.t_ns - path.t_ns[0]) * 1e-9
    begin = np.random.default_rng([seed, 4]).uniform(0.0, max(clock[-1] - duration_s, 0.0))
    keep = np.flatnonzero((clock >= begin - 1e-9) & (clock <= begin + duration_s + 0.5))
    write_text(target, "".join(f"{tum_line(int(path.t_ns[k]), path.T_world_body[k])}\n" for k in keep))
    return target
