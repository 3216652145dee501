"""What odometry saw, as the run folder keeps it."""

from dataclasses import replace

import numpy as np
import pytest
from gpvo.errors import SourceError
from gpvo.io import open_source
from gpvo.io.run import read_run, read_tracks
from gpvo.runner import run
from gpvo.sim.points import simulate_points


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    drawn = simulate_points("tunnel-clean", seed=5, duration_s=3.0, dark=(1.0, 1.3))
    source = open_source(drawn.save(folder / "flight.npz"))
    run(source, folder / "run", keep_tracks=True)
    run(source, folder / "bare")
    return drawn, folder


def test_every_kept_track_is_a_piece_of_one_track_of_the_source(flight):
    drawn, folder = flight
    kept = read_tracks(folder / "run")
    frame = np.searchsorted(np.rint(drawn.t_s * 1e9).astype(int), kept.t_ns)
    left, right = drawn.uv_left.astype(float), drawn.uv_right.astype(float)
    uvd = np.stack([left[:, 0], left[:, 1] / 2 + right[:, 1] / 2, left[:, 0] - right[:, 0]], 1)
    source = {(f, *np.round(m, 2)): t for f, m, t in zip(drawn.frame, uvd, drawn.track)}
    owner = np.array([source.get((f, *np.round(m, 2)), -1) for f, m in zip(frame, kept.uvd)])
    known = owner >= 0  # rounding to float32 moves a few across a boundary
    assert known.mean() > 0.97
    for track in np.unique(kept.track[known]):
        assert len(set(owner[known & (kept.track == track)])) == 1


def test_no_track_is_seen_twice_in_a_frame_of_whole_pixels(tmp_path):
    """Corners of whole pixels fall upon each other: of 300 tracks, in about every frame two."""
    drawn = simulate_points("tunnel-clean", seed=11, duration_s=3.0, tracks=300, rest_s=0.0)
    whole = replace(drawn, uv_left=np.round(drawn.uv_left), uv_right=np.round(drawn.uv_right))
    run(open_source(whole.save(tmp_path / "flight.npz")), tmp_path / "run", keep_tracks=True)
    kept = read_tracks(tmp_path / "run")
    assert np.unique(np.stack([kept.t_ns, kept.track]), axis=1).shape[1] == len(kept)
    assert len(np.unique(np.c_[kept.t_ns, kept.uvd], axis=0)) < len(kept)


def test_counts_agree_with_the_log(flight):
    _, folder = flight
    log, kept = read_run(folder / "run").log, read_tracks(folder / "run")
    assert (np.diff(kept.t_ns) >= 0).all()
    lengths = np.bincount(kept.track)
    assert lengths[lengths > 0].min() >= 2
    first = np.unique(kept.track, return_index=True)[1]
    later = np.setdiff1d(np.arange(len(kept)), first)
    for record in log.records[1:]:
        here = later[kept.t_ns[later] == record.t_ns]
        if record.usable:
            assert len(here) == record.n_tracked
            assert kept.is_inlier[here].sum() == record.n_inliers


def test_a_minute_of_vga_takes_less_than_20_mb_and_leaves_the_rest_as_it_is(flight):
    _, folder = flight
    assert (folder / "run" / "tracks.parquet").stat().st_size * 60 / 3 < 20e6
    for name in ("trajectory.tum", "truth.parquet", "imu.parquet", "rig.json"):
        assert (folder / "run" / name).read_bytes() == (folder / "bare" / name).read_bytes()
    with pytest.raises(SourceError, match="--keep-tracks"):
        read_tracks(folder / "bare")


def test_a_damaged_table_is_refused_in_one_line(flight, tmp_path):
    _, folder = flight
    content = bytearray((folder / "run" / "tracks.parquet").read_bytes())
    content[len(content) // 2] ^= 0xFF
    (tmp_path / "tracks.parquet").write_bytes(content)
    with pytest.raises(SourceError, match="tracks.parquet"):
        read_tracks(tmp_path)
