"""Neighbours that err alike have their signs in common; others, and tracks of independent noise, do not."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.twin import noise
from gpvo.twin.bundle import WHITEN, Observations, projection_jacobian
from gpvo.twin.noise import Neighbours, Structure, _sums_of, draw_signs, restored
from gpvo.types import StereoCamera

CAMERA = StereoCamera(400.0, 400.0, 319.5, 239.5, 0.1, 640, 480)
N_FRAMES, N_TRACKS, LIFE = 100, 1500, 8


def flight(rng: np.random.Generator, length_px: float) -> tuple[Observations, Structure]:
    """Tracks that live for eight frames; their errors last as long, and are smooth over ``length_px``."""
    at = rng.uniform([0, 0], [640, 480], (N_TRACKS, 2))
    begin = rng.integers(0, N_FRAMES - LIFE, N_TRACKS)
    error = rng.standard_normal((N_TRACKS, 3))
    if length_px > 0:
        # White noise of the image, of each span of frames its own, smoothed by its neighbours.
        off = np.linalg.norm(at[:, None] - at[None], axis=2)
        near = np.exp(-0.5 * (off / length_px) ** 2) * (np.abs(begin[:, None] - begin[None]) < LIFE)
        error = near @ error / np.sqrt((near**2).sum(axis=1))[:, None]
    frame = (begin[:, None] + np.arange(LIFE)).ravel()
    track = np.repeat(np.arange(N_TRACKS), LIFE)
    order = np.argsort(frame, kind="stable")
    frame, track = frame[order], track[order]
    seen = Observations(CAMERA, frame, track, np.c_[at[track], np.full(len(track), 5.0)], np.ones(len(track), bool))
    T = np.tile(np.eye(4), (N_FRAMES, 1, 1))
    ones = np.ones(len(track))
    return seen, Structure(T, np.zeros((N_TRACKS, 3)), error[track], ones, np.ones(N_FRAMES), True)


@pytest.mark.parametrize(("length_px", "low", "high"), [(0.0, 0.0, 0.0), (6.0, 10.0, 20.0), (25.0, 40.0, 40.0)])
def test_how_far_residuals_agree(length_px, low, high):
    neighbours = Neighbours.of(*flight(np.random.default_rng(1), length_px))
    assert low <= neighbours.reach_px <= high


def test_a_long_run_is_taken_in_parts(monkeypatch):
    """An hour has a hundred million pairs, ten gigabytes; how many are held at once makes no difference."""
    seen, structure = flight(np.random.default_rng(4), 6.0)
    held = []

    def sums_of(pairs, *others):
        held.append(len(pairs))
        return _sums_of(pairs, *others)

    whole = Neighbours.of(seen, structure)
    monkeypatch.setattr(noise, "_PAIRS", 2000)
    monkeypatch.setattr(noise, "_sums_of", sums_of)
    parts = Neighbours.of(seen, structure)
    assert len(held) > 5
    assert max(held) < 4000
    for name in ("first", "second", "distance_px", "product", "square"):
        assert np.allclose(getattr(parts, name), getattr(whole, name), rtol=1e-12, atol=1e-12)


def test_signs_are_common_within_the_reach_and_free_beyond():
    neighbours = Neighbours.of(*flight(np.random.default_rng(2), 6.0))
    rng = np.random.default_rng(3)
    signs = np.stack([draw_signs(N_TRACKS, neighbours, rng) for _ in range(40)])
    agree = (signs[:, neighbours.first] * signs[:, neighbours.second]).mean(axis=0)
    assert agree[neighbours.distance_px < 5].mean() > 0.6
    assert abs(agree[neighbours.distance_px > 50].mean()) < 0.05
    assert abs(signs.mean()) < 0.03


def test_a_mean_of_noise_scatters_as_much_as_the_noise_does():
    """Twenty points within a patch: with signs of their own their mean would be too sure by three in sigma."""
    found, alone, real = [], [], []
    for seed in range(12):
        seen, structure = flight(np.random.default_rng(seed), 25.0)
        neighbours, rng = Neighbours.of(seen, structure), np.random.default_rng(99)
        error = np.zeros((N_TRACKS, 3))
        error[seen.track] = structure.residual_px
        begin, at = np.zeros(N_TRACKS, int), np.zeros((N_TRACKS, 2))
        begin[seen.track[::-1]], at[seen.track] = seen.frame[::-1], seen.uvd[:, :2]
        for frame in range(10, 90, 20):
            there = (np.abs(begin + LIFE / 2 - frame) < LIFE / 2) & (np.abs(at - [320, 240]) < 60).all(axis=1)
            if there.sum() < 3:
                continue
            real.append(error[there].mean(axis=0))
            found += [(draw_signs(N_TRACKS, neighbours, rng)[:, None] * error)[there].mean(axis=0) for _ in range(4)]
            alone += [(rng.choice([-1, 1], N_TRACKS)[:, None] * error)[there].mean(axis=0) for _ in range(4)]
    real_rms, found_rms, alone_rms = (np.sqrt(np.mean(np.square(x))) for x in (real, found, alone))
    assert found_rms > 0.8 * real_rms
    assert alone_rms < 0.75 * real_rms


def test_what_a_pose_took_is_given_back_where_it_took_it():
    """Five near points decide how far the camera went: given back evenly, 0.64 of its squared error is left."""
    rng = np.random.default_rng(4)
    frames, points = 200, 30
    depth = np.where(np.arange(points) < 5, 1.5, 20.0)
    P = np.c_[rng.uniform([-0.7, -0.5], [0.7, 0.5], (points, 2)) * depth[:, None], depth]
    by_pose = np.concatenate([-np.broadcast_to(np.eye(3), (points, 3, 3)), se3.skew(P)], axis=2)
    A = (WHITEN @ projection_jacobian(P, CAMERA) @ by_pose).reshape(-1, 6)
    solve = np.linalg.pinv(A)
    true = 0.2 * rng.standard_normal((frames, 3 * points))
    left = true - true @ solve.T @ A.T

    def pixels(z):
        return z.reshape(-1, 3) @ np.linalg.inv(WHITEN).T

    def energy(noise):
        by_point = solve.reshape(6, points, 3) * (noise @ WHITEN.T).reshape(frames, 1, points, 3)
        return (by_point.sum(axis=3) ** 2).sum(axis=(0, 2))

    frame, track = (i.ravel() for i in np.meshgrid(np.arange(frames), np.arange(points), indexing="ij"))
    used = np.ones(len(frame))
    seen = Observations(CAMERA, frame, track, np.tile(CAMERA.project(P), (frames, 1)), used > 0)
    T = np.tile(np.eye(4), (frames, 1, 1))
    found = restored(seen, Structure(T, P, pixels(left), used, np.full(frames, 0.2), True))
    assert energy(found) / energy(pixels(true)) == pytest.approx(1.0, abs=0.1)
    evenly = pixels(left) * np.sqrt(points / (points - 2))
    assert (energy(evenly) / energy(pixels(true)))[2] < 0.75
