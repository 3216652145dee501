"""Stereo visual odometry, one frame at a time: ``StereoOdometry(camera).step(frame) -> VoRecord``."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import CalibrationError
from gpvo.geometry import se3
from gpvo.geometry.covariance import lost_covariance
from gpvo.types import CALIBRATION, Array, ImuLog, ImuMoments, Status, StereoCamera, StereoFrame, TrackFrame, VoRecord
from gpvo.vo import opencv
from gpvo.vo.config import KNOWN_DEPTH_PX, TELLING_PX, VoConfig
from gpvo.vo.covariance import NoiseEstimator, SigmaEstimator, covariances_by_method
from gpvo.vo.frontend import EMPTY, DescriptorFrontend, Followed, Frontend, Matches, TrackFrontend
from gpvo.vo.klt import KltFrontend
from gpvo.vo.motion import Motion, refine, whitened
from gpvo.vo.points import ResidualMoments, triangulate
from gpvo.vo.quality import (
    PairWatch,
    Verdict,
    agrees,
    disparities_px,
    judge,
    lateness_covariance,
    median_parallax_px,
    motion_fields,
    stats_fields,
)
from gpvo.vo.rig_error import RigError, RigState
from gpvo.vo.rivals import Choice, areas, choose, explained, unexplained, untangled
from gpvo.vo.state import State, Stopwatch, own_frame
from gpvo.vo.window import Window

_NEAR = 3.0  # standard deviations of the noise that the last motions had
_SAME = 0.01  # of the noise: what displaces all points alike by less is less than their mean is known to


class StereoOdometry:
    """Motion from frame to frame, with its covariance by each geometric method.

    Parameters
    ----------
    camera : the rectified pair.
    config : settings; default the preset ``fast``.
    mask : (H, W) bool, True where the left image may be used. CalibrationError for one of another size.
    known : what is known about errors of the calibration; by default nothing, or, with ``self_calibration`` off, that
        there are none.
    T_imu_cam : (4, 4) where the left camera sits on the IMU; None where that is unknown: then a velocity that leaps is
        told by what the vehicle can do, not by what the IMU felt.

    Frames must be rectified, of the camera's size, and in time order. ``last``: the points behind the last motion, for
    drawing. ``pair``: what is wrong with the pairs of images; ``rig_error``: what is wrong with the calibration.
    """

    def __init__(
        self,
        camera: StereoCamera,
        config: VoConfig | None = None,
        mask: NDArray[np.bool_] | None = None,
        known: RigState | None = None,
        T_imu_cam: Array | None = None,
    ) -> None:
        self.camera, self._T_imu_cam = camera, T_imu_cam
        self.config = config or VoConfig()
        self._mask = None if mask is None else np.array(mask, bool)
        if self._mask is not None and self._mask.shape != (camera.height, camera.width):
            size = f"{self._mask.shape}, the camera's images {(camera.height, camera.width)}"
            raise CalibrationError(f"the mask is {size}", cure="rows before columns: give one of the image's size")
        if self.config.self_calibration:
            self.rig_error = RigError(camera, known)
        else:
            self.rig_error = RigError(camera, known or RigState.exact(), learn=False)
        self._window = Window(camera, self.config.window, self.rig_error)
        self._frontend: Frontend | None = None
        self._sigmas = SigmaEstimator(self.config.sigma_p_px, self.config.sigma_m_px)
        self._noise = NoiseEstimator()
        self._state: State | None = None
        self._t_last_ns: tuple[int, ...] = ()
        self._imu = ImuMoments.of(None)  # since the reference
        self.pair = PairWatch(camera)
        self._raw = EMPTY  # the last matches as measured
        self.last: Followed = Followed(EMPTY, np.zeros(0, bool))

    def place_imu(self, T_imu_cam: Array) -> None:
        """From here on, the left camera sits at ``T_imu_cam`` (4, 4) on the IMU, of which nothing was known before."""
        self._T_imu_cam = T_imu_cam
        if self._state is not None:
            self._state.place_imu(T_imu_cam)

    def step(self, frame: StereoFrame | TrackFrame, imu: ImuLog | None = None) -> VoRecord:
        """Process one frame: how the camera moved since the reference frame.

        ``imu`` holds the samples since the last frame, if any. The record gets the mean and spread of all samples since
        the reference, so that they cover the same interval as its motion. Raises SourceError if the frame is not later
        than the last one, its stamp no whole number of nanoseconds, or its images not of the camera's size. The images
        are copied.
        """
        clock = Stopwatch()
        frame = own_frame(frame, self.camera, self._t_last_ns)
        self._t_last_ns = (*self._t_last_ns[-1:], frame.t_ns)
        frontend = self._frontend = self._frontend or self._new_frontend(frame)
        seen = frontend.observe(frame, stays=self._state is not None and self._state.stays(self.config))
        clock.lap("observe")
        if self._state is None:
            counts = frontend.promote(None)
            self._state = State.begin(frame.t_ns, counts[1], self._T_imu_cam)
            record = VoRecord(frame.t_ns, frame.t_ns, Status.START, np.eye(4), n_detected=counts[0], n_stereo=counts[1])
            return replace(record, stage_ms=clock.stages, **stats_fields(seen.stats), **ImuMoments.of(imu).fields())
        piece = ImuMoments.of(imu)
        self._state.feel(frame.t_ns, piece)
        guess = self._state.guess(frame.t_ns)
        matches, motion = self._solve(guess, clock)
        doubts = self.pair.step(seen, matches.right)
        frozen, choice = self._state.frozen(seen), Choice()
        self.pair.note("partly", bool(frozen) and seen.partly)
        if not frozen:  # what stands still in a repeated image says nothing of the vehicle
            motion, choice = self._choose(matches, motion, frame.t_ns, doubts)
        matches, motion = self._freed(matches, motion, frame.t_ns)
        clock.lap("motion")
        self.last = Followed(self._raw, np.zeros(len(self._raw.uvd_cur), bool) if motion is None else motion.inliers)
        verdict = judge(
            matches,
            motion,
            self.camera,
            self.config,
            frozen=frozen,
            usual_inliers=self._state.usual_inliers,
            doubts=doubts,
        )
        moved = self.rig_error.moved
        parallax_px = 0.0 if motion is None else median_parallax_px(matches, motion.inliers)
        record = self._record(frame.t_ns, guess, matches, motion, verdict, choice.otherwise, parallax_px)
        if self.rig_error.moved > moved:
            self.pair.note("moved", seen=True)
            reason = "; ".join(filter(None, [record.reason, "the cameras have moved against one another"]))
            status = Status.DEGRADED if record.status is Status.OK else record.status
            record = replace(record, status=status, reason=reason)
        clock.lap("covariance")
        is_reference, counts = self._advance(record, matches, motion, choice, parallax_px)
        self._window.advance(is_reference)
        clock.lap("reference")
        sensed = self._imu.with_later(piece)
        self._imu = ImuMoments.of(None) if is_reference else sensed
        return replace(
            record,
            is_reference=is_reference,
            n_detected=counts[0],
            n_stereo=counts[1],
            stage_ms=clock.stages,
            **stats_fields(seen.stats),
            **sensed.fields(),
        )

    def _new_frontend(self, frame: StereoFrame | TrackFrame) -> Frontend:
        """The front end for this kind of frame and preset."""
        if isinstance(frame, TrackFrame):
            return TrackFrontend(self.rig_error, self.config)
        kind = DescriptorFrontend if self.config.preset == "thesis" else KltFrontend
        return kind(self.camera, self.rig_error, self.config, self._mask)

    def _solve(self, guess: Array, clock: Stopwatch) -> tuple[Matches, Motion | None]:
        """Match near the guess; if too little agrees, match without it and keep the better."""
        assert self._frontend is not None
        config = self.config
        matches = self._match(guess)
        clock.lap("match")
        motion = self._estimate(matches)
        clock.lap("motion")
        agreeing = 0 if motion is None else int(motion.inliers.sum())
        if config.preset != "fast" or agreeing >= max(config.weak_inliers, 0.5 * matches.n_tracked):
            return matches, motion
        again = self._match(guess, from_scratch=True)
        second = self._estimate(again)
        if second is not None and second.inliers.sum() > agreeing:
            matches, motion = again, second
        elif motion is not None:
            matches = self._match(guess)  # the first result stands: the front end must hold its points again
        clock.lap("rematch")
        return matches, motion

    @property
    def _near_px(self) -> float:
        """How far a point of the scene may be from where a motion puts it."""
        return max(self.config.ransac_threshold_px, _NEAR * self._noise.scale_px)

    def _match(self, guess: Array, *, from_scratch: bool = False) -> Matches:
        """Matches of the front end, freed from what is known of the rig's errors."""
        assert self._frontend is not None
        assert self._state is not None
        self._raw = self._frontend.match(guess, from_scratch=from_scratch)
        return self._corrected((self._state.twists[0], self._state.twist))

    def _corrected(self, twists: tuple[Array, Array]) -> Matches:
        """The last matches as measured by cameras that moved with these velocities, at the reference and now."""
        raw, correct = self._raw, self.rig_error.correct
        return replace(raw, uvd_prev=correct(raw.uvd_prev, twists[0]), uvd_cur=correct(raw.uvd_cur, twists[1]))

    def _freed(self, matches: Matches, motion: Motion | None, t_ns: int) -> tuple[Matches, Motion | None]:
        """What images that were not taken at one time displace depends on the motion itself: once more, as it is now
        known, where that displaces anything otherwise."""
        assert self._state is not None
        if motion is None or not self.rig_error.is_late:
            return matches, motion
        again, among = self._corrected(self._state.moving(t_ns, motion.T_prev_cur)), motion.inliers
        (before, now), scale_px = ((m.uvd_prev[among], m.uvd_cur[among]) for m in (matches, again)), motion.scale_px
        off_px = np.abs(np.concatenate([b - a for a, b in zip(before, now, strict=True)])).mean(axis=0)
        if off_px.max() < _SAME * scale_px:
            return matches, motion
        refined = self._refined(motion.T_prev_cur, again, among, noise=motion.noise, chosen_px=scale_px)
        return (matches, motion) if refined is None else (again, refined)

    def _choose(
        self, matches: Matches, motion: Motion | None, t_ns: int, doubts: list[str]
    ) -> tuple[Motion | None, Choice]:
        """The motion freed from points that do not move with the scene, or its rival among the points that disagree: a
        second one is added to the doubts, and so is a motion that the vehicle cannot make."""
        assert self._state is not None
        state = self._state
        state.rival = None
        if motion is None:
            return None, Choice()
        motion, held = untangled(motion, matches, self.camera, self._estimate)
        self.pair.note("held", held)
        near_px, margin_px = self._near_px, self.config.klt_window_px
        shares = [explained(motion, matches, self.camera, near_px, margin_px)]
        free = unexplained(motion, shares[0], matches, self.camera, near_px, self._noise.scale_px)
        second = None if free is None else self._estimate(matches, free)
        covered = (1, 0) if second is None else areas(motion, second, matches, self.camera, near_px)
        state.meet(t_ns, float(disparities_px(matches, motion.inliers, 10)[0]), rival=covered[1] > 0)
        motions = [motion]
        if second is not None and covered[1] > 0:
            state.rival = motion.inliers | second.inliers
            motions.append(second)
            shares.append(explained(second, matches, self.camera, near_px, margin_px))
            doubts.append(f"two motions, over {covered[0]} and {covered[1]} parts of the image")
        elif state.remembers_rival:
            doubts.append("two motions in the frames before")
        expected = state.expected(t_ns, most_mps2 := self.config.max_acceleration_mps2)
        chosen = choose(motions, covered, expected, lambda i, on: state.unseen(shares[i], expected, goes_on=on))
        if len(motions) == 1 and chosen.plausible:  # a rival that is not found in one frame has not gone
            chosen = replace(chosen, otherwise=state.rival_stays * state.in_doubt)
        state.odds, chosen = chosen.odds, replace(chosen, lasting=chosen.otherwise)
        T_ref_cur = motions[chosen.index].T_prev_cur
        state.clock(t_ns, T_ref_cur)
        if not chosen.plausible:
            state.refuse(t_ns, T_ref_cur)
            is_felt = expected is not None and expected.felt
            says = "the IMU felt no such change of velocity", "no vehicle changes its velocity like this"
            doubts.append(says[0] if is_felt else says[1])
        elif chosen.tells and not chosen.goes_on:
            state.leap(t_ns, T_ref_cur, most_mps2)
        elif chosen.tells:
            state.compare(t_ns, T_ref_cur, motions[chosen.index].worst_translation_sigma_m)
        if chosen.plausible:
            unseen = state.follow(t_ns, T_ref_cur, shares[chosen.index], expected, most_mps2, goes_on=chosen.goes_on)
            chosen = replace(chosen, otherwise=chosen.otherwise + unseen)
        left = state.otherwise(t_ns, T_ref_cur, most_mps2)
        if left is not None:
            doubts.append(state.leaps.reason)
            chosen = replace(chosen, otherwise=chosen.otherwise + left)
        return motions[chosen.index], chosen

    def _estimate(self, matches: Matches, among: NDArray[np.bool_] | None = None) -> Motion | None:
        """P3P in RANSAC on the left image, then the weighted refinement over both; of the points ``among``, (N,)."""
        camera, config, near_px = self.camera, self.config, self._near_px
        among = matches.strong if among is None else among
        near = among & (matches.uvd_prev[:, 2] > TELLING_PX)
        if near.sum() < config.min_inliers:
            return None
        found = opencv.pose_from_points(
            triangulate(matches.uvd_prev[near], camera),
            matches.uvd_cur[near, :2],
            camera.K,
            near_px,
            config.ransac_iterations,
            config.seed,
        )
        if found is None:
            return None
        T_prev_cur, tolerance_px = se3.inverse(found), 2 * near_px
        if (among & agrees(T_prev_cur, matches, camera, tolerance_px)).sum() < config.min_inliers:
            return None
        return self._refined(T_prev_cur, matches, among, noise=self._noise.value, tolerance_px=tolerance_px)

    def _refined(self, T_start: Array, matches: Matches, among: NDArray[np.bool_], **how: Any) -> Motion | None:
        """The motion of the points ``among`` (N,), as of :func:`refine`; its inliers are of all (N,)."""
        motion = refine(T_start, matches.uvd_prev[among], matches.uvd_cur[among], self.camera, **how)
        if motion is None:
            return None
        inliers = np.zeros(len(among), bool)
        inliers[among] = motion.inliers
        return replace(motion, inliers=inliers)

    def _record(
        self, t_ns: int, guess: Array, matches: Matches, motion: Motion | None, verdict: Verdict, otherwise: Array,
        parallax_px: float,
    ) -> VoRecord:  # fmt: skip
        """The record of this motion, over which the image moved by ``parallax_px``, still without counts and image
        statistics of the new reference. ``otherwise``: covariance (6, 6) of being the wrong one of several motions."""
        assert self._state is not None
        state, config = self._state, self.config
        record = VoRecord(t_ns, state.t_ref_ns, verdict.status, guess, reason=verdict.reason)
        if motion is not None:
            white = whitened(motion, self.camera)
            moments = ResidualMoments.of(motion.residuals, white.moved.G)
            record = replace(record, **motion_fields(matches, motion, self.camera, moments))
        if motion is None or verdict.status is Status.LOST:
            self.rig_error.update_rows(None if self.pair.late or self.pair.unsharp else matches.displaced)
            known = None if state.t_twist_ns is None else state.twist
            C = lost_covariance((t_ns - state.t_believed_ns) * 1e-9, known)
            return replace(
                record,
                n_tracked=matches.n_tracked,
                covariances=dict.fromkeys(config.stated, C),
                v_t=dict.fromkeys(config.stated, C[:3, :3]),
            )
        if self.config.persistent_noise:
            self._noise.update(motion, white)
        self._sigmas.update(moments)
        if self._sigmas.estimates:
            self._sigmas.design.update(motion, white, self.camera, state.t_ref_ns)
        twists = state.moving(t_ns, motion.T_prev_cur)
        adjusted = self._window.adjust(self._raw, motion, twists)
        T_prev_cur = motion.T_prev_cur if adjusted is None else adjusted.T_ref[-1]
        by_method = covariances_by_method(
            config,
            self._sigmas.values,
            T_prev_cur,
            motion.uvd_prev,
            matches.uvd_cur[motion.inliers],
            self.camera,
            moved=white.moved,
            information=None if adjusted is None else adjusted.information,
        )
        shared = dict[str, Array]()
        if self.pair.late:
            otherwise = otherwise + lateness_covariance(self.pair.late, T_prev_cur)
        elif config.self_calibration:
            row_error, least_px = matches.row_error[motion.inliers], max(config.min_disparity_px, KNOWN_DEPTH_PX)
            # An image at rest says nothing of depth, but with a wrong rig, what begins to move slowly fits one motion
            # with what stays. Other doubts may come from the rig's own errors, which only learning ends.
            moves = parallax_px >= config.keyframe_parallax_px
            common, of_bodies = self.rig_error.update(
                motion,
                white,
                row_error,
                least_px,
                displaced=matches.displaced,
                disputed=state.is_disputed,
                of_depth=moves and not self.pair.unsharp,
                twists=twists,
            )
            shared = {CALIBRATION: common} if common.any() else {}
            otherwise = otherwise + common + of_bodies
        return replace(
            record,
            T_prev_cur=T_prev_cur,
            covariances={m: c.full + otherwise for m, c in by_method.items()},
            v_t={m: c.v_t for m, c in by_method.items()},
            shared=shared,
        )

    def _advance(
        self, record: VoRecord, matches: Matches, motion: Motion | None, choice: Choice, parallax_px: float
    ) -> tuple[bool, tuple[int, int]]:
        """Choose the reference of the next motion; whether it is this frame, and the counts of points."""
        assert self._frontend is not None
        assert self._state is not None
        state, config = self._state, self.config
        if motion is None or not record.usable:
            state.t_last_ns = record.t_ns
            if "frozen" in record.reason:
                return False, (matches.n_tracked, matches.n_tracked)
            # A good image that fits nothing known is a new beginning; a bad one leaves the old reference standing
            # while it may be found again.
            enough = config.weak_inliers if state.is_fresh(record.t_ns, config.weak_inliers) else config.min_inliers
            counts = self._frontend.promote(None, at_least=enough)
            if counts[1] < enough:
                return False, counts
            state.restart(record.t_ns, counts[1])
            return True, counts
        inliers = motion.inliers
        sigma_m = motion.worst_translation_sigma_m
        state.believe(record.t_ns, record.T_prev_cur, parallax_px, int(inliers.sum()), choice, sigma_m)
        if record.status is Status.OK:
            state.horizon.see(record.disparity_p10_px)
        self.rig_error.twist = state.twist
        if state.suffices(parallax_px, config) and inliers.sum() > 0.6 * state.reference_points:
            return False, (state.reference_points, state.reference_points)
        counts = self._frontend.promote(inliers if state.rival is None else state.rival, config.min_inliers)
        if counts[1] < config.min_inliers:
            return False, counts
        state.restart(record.t_ns, counts[1])
        return True, counts
