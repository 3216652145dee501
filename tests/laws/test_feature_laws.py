"""Laws of the features: causal, the same in flight and in training, independent of the camera's pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from gpvo.dataset.build import observe
from gpvo.geometry import se3
from gpvo.online.features import FeatureStream, resolve
from gpvo.online.observer import MOST_MOTIONS, Window
from gpvo.types import Status, VoLog, VoRecord
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_runs import CAMERA, make_run

FULL = (*resolve("full"), *resolve("imu_axes"))


def _damage(record, rng):
    """Any other record with the same stamps."""
    status = [Status.OK, Status.DEGRADED, Status.LOST][rng.integers(3)]
    T = se3.exp(rng.normal(size=6) * 10.0 ** rng.uniform(-3, 2))
    return replace(record, status=status, T_prev_cur=T, n_inliers=int(rng.integers(0, 1000)), brightness=rng.random())


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10**6), cut=st.integers(1, 39), target=st.sampled_from(["frame", "window:0.2s", "length:0.1m"])
)
def test_the_future_never_changes_the_past(seed, cut, target):
    log, _ = make_run(seed % 7, n=40)
    rng = np.random.default_rng(seed)
    other = VoLog([r if k < cut else _damage(r, rng) for k, r in enumerate(log)], log.camera)
    before, X = observe(log, FULL, target)
    after, Z = observe(other, FULL, target)
    t_cut = log.records[cut].t_ns
    past = [r.t_ns < t_cut for r in before]
    n = sum(past)
    np.testing.assert_array_equal(X[:n], Z[:n])
    assert [r.status for r in before[:n]] == [r.status for r in after[:n]]
    assert [r.t_ns for r in before[:n]] == [r.t_ns for r in after[:n] if r.t_ns < t_cut]


@settings(max_examples=20, deadline=None)
@given(zoom=st.floats(0.2, 5.0), seed=st.integers(0, 5))
def test_image_lengths_scale_with_the_focal_length(zoom, seed):
    log, _ = make_run(seed, n=10)
    zoomed = replace(CAMERA, fx_px=CAMERA.fx_px * zoom, fy_px=CAMERA.fy_px * zoom)
    record = replace(
        log.records[3], reproj_rms_px=0.4, disparity_p10_px=3.0, disparity_p50_px=9.0, disparity_p90_px=20.0
    )
    closer = replace(
        record,
        **{
            n: getattr(record, n) * zoom
            for n in ("reproj_rms_px", "disparity_p10_px", "disparity_p50_px", "disparity_p90_px")
        },
    )
    names = resolve("geometry")
    a, b = FeatureStream(names, CAMERA).step(record), FeatureStream(names, zoomed).step(closer)
    np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_a_window_of_seconds_holds_as_many_motions_as_a_fast_camera_makes():
    window, n = Window.of("window:10s"), MOST_MOTIONS + 20
    step_ns = round(10.0 / n * 1e9)
    records = [VoRecord(k * step_ns, (k - 1) * step_ns, Status.OK, np.eye(4)) for k in range(1, n + 3)]
    assert [window.step(r) is not None for r in records].count(True) > 0


def test_a_vehicle_that_stands_does_not_make_a_window_grow():
    """Each motion of imported odometry starts from the frame before, at rest too: after an hour, a metre held 100,000
    motions, all joined anew with each frame."""
    window, speeds = Window.of("length:1m"), [*5 * [0.1], *(MOST_MOTIONS + 20) * [0.0], *12 * [0.1]]
    out = []
    for k, dx in enumerate(speeds, start=1):
        T = se3.exp(np.array([dx, 0.0, 0.0, 0.0, 0.0, 0.0]))
        out.append(window.step(VoRecord(k * 10**8, (k - 1) * 10**8, Status.OK, T)))
    full = [k for k, joint in enumerate(out) if joint is not None]
    assert full == [len(speeds) - 3, len(speeds) - 2, len(speeds) - 1]
    assert out[-1].dt_s == 1.0
