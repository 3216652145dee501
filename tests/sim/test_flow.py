"""Flow is exact: images warped by it agree with the image before, for pinhole and fisheye."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from gpvo.sim.eye import optical_flow
from gpvo.sim.scenario import load_scenario
from gpvo.sim.sequence import simulate

pytest.importorskip("numba", reason="images need the extra gpvo[sim]")


def test_a_point_of_a_plane_moves_by_the_pinhole_equation():
    from gpvo.cameras.models import PinholeRadtan

    model = PinholeRadtan(100.0, 100.0, 31.5, 23.5, 64, 48)
    depth = np.full((48, 64), 4.0, np.float32)
    depth[10, 10] = np.nan
    aside = np.eye(4)
    aside[0, 3] = 0.08
    flow = optical_flow(model, depth, np.full((48, 64), 4.0, np.float32), np.eye(4), aside)
    assert np.isnan(flow[10, 10]).all()
    assert np.isnan(flow[:, :2]).all()  # two pixels leave the image
    inside = np.delete(flow[:, 2:].reshape(-1, 2), 10 * 62 + 8, axis=0)
    np.testing.assert_allclose(inside, np.tile([-2.0, 0.0], (len(inside), 1)), atol=1e-5)
    nearer = np.full((48, 64), 2.0, np.float32)
    assert np.isnan(optical_flow(model, depth, nearer, np.eye(4), aside)).all()  # something stands before it


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["pinhole", "t265"])
def test_pictures_follow_the_written_flow(tmp_path, camera):
    values = {"duration_s": 4.0, "rest_s": 1.0, "rate_hz": 5.0, "depth": True, "flow": True, "camera": camera}
    sequence = simulate(load_scenario("tunnel-clean", values), 0, tmp_path / "seq").path
    stamps = [p.stem for p in sorted((sequence / "mav0" / "cam0" / "data").glob("*.png"))]
    flows = sorted((sequence / "mav0" / "flow0").glob("*.npy"))
    assert [p.stem for p in flows] == stamps[:-1]
    flow = np.load(flows[-1])
    here, there = (
        cv2.imread(str(sequence / "mav0" / "cam0" / "data" / f"{s}.png"), 0).astype(np.float32) for s in stamps[-2:]
    )
    v, u = np.mgrid[: here.shape[0], : here.shape[1]].astype(np.float32)
    warped = cv2.remap(there, u + flow[..., 0], v + flow[..., 1], cv2.INTER_LINEAR)
    known = np.isfinite(flow).all(-1)
    assert known.mean() > 0.4
    assert np.median(np.abs(flow[known])) > 0.5
    still = np.median(np.abs(there - here)[known])
    assert np.median(np.abs(warped - here)[known]) < 0.5 * still
