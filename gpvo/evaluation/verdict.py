"""What an evaluation amounts to, in words: which stated covariance is honest, over which distances, and what to do."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.check import ENOUGH_INSIDE
from gpvo.dataset.errors import (
    MAX_GAP_S,
    interpolated_between,
    steps_of_slow_truth,
    turn_without_truth_deg,
    without_held,
)
from gpvo.dataset.misread import GROSS_DEG, FixedRotation, Resemblance
from gpvo.dataset.truth_noise import made_from_odometry
from gpvo.evaluation.consistency import BY_MODEL, Consistency, Horizon
from gpvo.learning.methods import STATED
from gpvo.online.features import AXES
from gpvo.online.slip import flag_slips
from gpvo.stats.consistency import seen_axes
from gpvo.types import Array, Status, StereoCamera

if TYPE_CHECKING:
    from gpvo.evaluation.evaluate import Evaluation

HONEST = (0.5, 2.0)
"""NEES per degree of freedom that counts as honest: sigma right within a factor of 1.4."""
_FEW_WINDOWS = 5
_FEW_BARE = 0.01  # of the frames, without truth: its ends
_LEAST_PATH_M, _MOST_SCALE = 0.5, 1.5
_LEAST_DEG, _ROUNDING = 0.005, 1e-9  # that is not 0.00; of a truth [m or rad]
_FAR, _FEW_FAR, _OUTWEIGH = 20.0, 0.05, 0.5  # medians; share of the motions; of the sum of all squared errors

Colour = Literal["green", "amber", "red"]


@dataclass(frozen=True)
class Verdict:
    """``colour`` and ``headline`` of the best stated covariance, and what stands behind it line by line.

    ``judged``: whether a covariance could be judged at all.
    """

    colour: Colour
    headline: str
    lines: tuple[str, ...]
    judged: bool = True


def verdict(e: Evaluation) -> Verdict:
    """The verdict on one evaluated run."""
    if reason := _why_blind(e):
        return Verdict("amber", reason, tuple(_conditions(e)), judged=False)
    judged = {m: c for m, c in e.consistency.items() if c.nll_per_dim is not None}
    return _of_motions(e, judged) if judged else _of_others(e)


def _why_blind(e: Evaluation) -> str:
    """Why this truth can judge no covariance at all; empty where it can."""
    if not e.covered.any():
        return "There is no ground truth, so no covariance can be judged."
    if len(e.errors.xi) and not len(seen_axes(e.errors.xi)):
        return "Odometry and truth are the same throughout, so nothing can be judged: was the truth made from odometry?"
    if e.run.truth and (turn_deg := turn_without_truth_deg(e.run.log, e.run.truth)):
        return (
            f"The truth holds no attitude (it never turns, but odometry does, by up to {turn_deg:.0f} deg):"
            " only the ATE is valid."
        )
    if made_from_odometry(e.errors, e.run.log):
        return (
            "From one motion to the next, odometry and truth agree as no two measurements do, so nothing can be judged:"
            " was the truth made from odometry, as by closing loops, or is odometry propagated between corrections that"
            " come at a lower rate? Then give it at theirs."
        )
    if len(e.errors.index) < 2 and e.run.log.methods and e.poses is None:
        return "Fewer than two motions have ground truth at both ends, so no covariance can be judged."
    return ""


def _of_others(e: Evaluation) -> Verdict:
    """Where no covariance of a motion is stated: that of the poses, if there is one."""
    if e.poses is not None:
        joint = e.poses.nees_dof["joint"].mean
        colour: Colour = "green" if _word(joint) == "honest" else "red" if joint > HONEST[1] else "amber"
        line = (
            f"NEES/dof {joint:.3g} over {e.poses.count} poses, median {e.poses.nees_dof_median['joint']:.3g}, after one"
            " rigid alignment of all, which moves the first poses of a drifting odometry by more than they state."
        )
        return Verdict(colour, f"The covariance of the poses is {_word(joint)}.", (*_conditions(e), line))
    headline = "No covariance was stated, so nothing can be judged."
    cure = "gpvo train learns one from such runs; give the model with --model."
    return Verdict("red", headline, (cure, *_conditions(e)), judged=False)


def _of_motions(e: Evaluation, judged: Mapping[str, Consistency]) -> Verdict:
    found = {m: _Judgement.of(c, e) for m, c in judged.items()}
    best = min(found, key=lambda m: found[m].loss())
    # What a vehicle would be told is judged first; others only where it is wrong.
    told = found["learned" if "learned" in judged else best]
    if not told.of_motions and not told.spans:
        headline = "This truth is too noisy to judge any covariance of the run."
        return Verdict("amber", headline, tuple(_conditions(e)), judged=False)
    wrong = told.wrong()
    outside = e.in_domain is not None and e.in_domain < ENOUGH_INSIDE
    misfit = bool(e.misfits) and told.c.method == "learned"
    shown = dict.fromkeys((told.c.method, best, *(m for m in judged if m in STATED)))
    lines = [*_conditions(e), *(found[m].line() for m in shown)]
    if not wrong and not outside:
        where = "per motion; over a second or a distance, nothing can be judged"
        if told.spans:
            where = "per motion and " * told.of_motions + f"over {_listed([n for n, _ in told.spans])}"
        headline = f"The {told.c.method} covariance is honest here, {where}"
        if misfit or e.run.log.lost.mean() > 0.5:
            but = "the model does not fit this run" if misfit else "most motions are lost"
            return Verdict("amber", f"{headline}; but {but}.", tuple(lines))
        return Verdict("green", f"{headline}.", tuple(lines))
    # Of the others, gpvo publish sends those alone that the odometry states itself.
    stated = [m for m in found if m in e.run.log.methods and m != told.c.method and not found[m].wrong()]
    if stated:
        use = min(stated, key=lambda m: found[m].loss())
        likeliest = ", and has the best likelihood of all" * (told.of_motions and use == best)
        lines.append(f"Use {use} here (gpvo publish --method {use}): it is honest{likeliest}.")
    if outside:
        lines.append("Train on runs with this camera in these conditions, with ground truth or with twins.")
    headline = f"The {told.c.method} covariance is {told.words()}"
    if outside:
        headline += "; the model does not know these conditions"
    return Verdict("red" if outside or "overconfident" in headline else "amber", headline + ".", tuple(lines))


def _nees(c: Consistency, block: str = "joint") -> float:
    """Per motion; with the truth's own noise counted in, which nobody's odometry can know."""
    return c.nees_dof_truth_noise[block] or float("nan")


def _per_motion(c: Consistency, *, sized: bool = False) -> str:
    """What a motion's covariance is; ``sized``: and by how much. Where it seems honest as a whole, translation and
    rotation are judged apart: one may make up for the other."""
    blocks = ("joint",) if _word(_nees(c)) != "honest" else ("translation", "rotation")
    said = []
    for block, nees in ((b, _nees(c, b)) for b in blocks):
        if (word := _word(nees)) != "honest":
            by = f" by a factor of {max(nees, 1.0 / nees) ** 0.5:.1f} in sigma" if sized else ""
            said.append(word + by + ("" if block == "joint" else f" in {block}"))
    return " and ".join(said) or "honest"


def _word(nees: float, chance: float = 0.0) -> str:
    """``chance``: relative standard deviation of the mean of so few windows even where the statement is honest."""
    if nees > HONEST[1] * (1 + 2 * chance):
        return "overconfident"
    return "too cautious" if nees < HONEST[0] * (1 - 2 * chance) else "honest"


@dataclass(frozen=True)
class _Judgement:
    """What this truth tells of a statement: of single motions (``of_motions``), unless its noise outweighs their
    errors, and over the ``spans`` that are long enough for it and of which there are enough windows."""

    c: Consistency
    of_motions: bool
    spans: tuple[tuple[str, Horizon], ...]

    @classmethod
    def of(cls, c: Consistency, e: Evaluation) -> _Judgement:
        pace_mps = e.trajectory.path_length_m / max(float(np.ptp(e.t_s[e.covered])), 1e-9)
        spans = [("1 s", pace_mps, c.one_second), *((f"{h.span:g} m", h.span, h) for h in c.horizons)]
        enough = ((n, h) for n, m, h in spans if h and h.count >= _FEW_WINDOWS and m >= e.tells_from_m)
        return cls(c, e.tells_from_m == 0.0, tuple(enough))

    def loss(self) -> float:
        """What statements are ranked by: the likelihood of the motions, or how far the longest span is from honest."""
        if self.of_motions or not self.spans:
            return self.c.nll_per_dim or 0.0
        return abs(math.log(max(self.spans[-1][1].nees_dof_truth_noise, 1e-300)))

    def wrong(self) -> dict[str, str]:
        """Over what the statement is wrong, beyond chance, and how."""
        out = {"one motion": _per_motion(self.c)} if self.of_motions else {}
        for name, h in self.spans:
            # The mean of n chi-squared of so many dof.
            out[name] = _word(h.nees_dof_truth_noise, chance=math.sqrt(2 / (len(self.c.axes) * h.independent)))
        return {name: word for name, word in out.items() if word != "honest"}

    def words(self) -> str:
        """How it is wrong, for a headline."""
        wrong = self.wrong()
        if not self.of_motions:
            by_word = {word: [n for n, w in wrong.items() if w == word] for word in dict.fromkeys(wrong.values())}
            return " and ".join(f"{word} over {_listed(names)}" for word, names in by_word.items()) or "honest"
        per_motion = _per_motion(self.c)
        then = f", but not over {_listed(list(wrong))}" if wrong and per_motion == "honest" else ""
        return f"{per_motion} per motion{then}"

    def line(self) -> str:
        """The figures."""
        wrong = [name for name in self.wrong() if name != "one motion"]
        over = [f"{_figure(h.nees_dof_truth_noise)} over {name}" for name, h in self.spans]
        if not self.of_motions:
            return f"{self.c.method}: {self.words()}; NEES/dof {', '.join(over)}."
        then = f", not honest over {_listed(wrong)}" if wrong else ""
        figures = ", ".join((_figure(_nees(self.c)), *over))
        return f"{self.c.method}: {_per_motion(self.c, sized=True)} per motion{then}; NEES/dof {figures}."


def _figure(nees: float) -> str:
    """To two decimals; of what these do not show, the first digit."""
    return f"{nees:.1g}" if nees < 0.01 else f"{nees:.2f}"


def _listed(names: Sequence[str]) -> str:
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def _conditions(e: Evaluation) -> Iterator[str]:
    if e.in_domain is not None:
        yield f"{100 * e.in_domain:.0f} % of the frames lie in the model's training domain."
    for problem in e.misfits:
        yield f"The model does not fit: {problem}."
    reasons = [r.reason for r in e.run.log if r.status is Status.LOST]
    by_model = sum(reason.endswith(BY_MODEL) for reason in reasons)
    if lost := len(reasons) - by_model:
        yield f"{lost} of {len(e.run.log)} frames {'has' if lost == 1 else 'have'} no motion."
    if by_model:
        yield (
            f"The model calls {by_model} of {len(e.run.log)} motions lost, most as slips: more abrupt than the"
            " vehicle can be; if yours can, raise --max-acceleration in gpvo run or gpvo import."
        )
    if (e.truth_sigma > np.maximum(1.5 * e.truth_sigma_stated, _ROUNDING)).any():
        stated = _up_to(e.truth_sigma_stated) or "none"
        jitter = f", as its stamps jitter by {1e3 * e.truth_jitter_s:.2g} ms" if e.truth_jitter_s else ""
        yield (
            f"The truth itself has an estimated noise of {_up_to(e.truth_sigma)} per pose on its worst axis (its source"
            f" states {stated}){jitter}. This is taken into account."
        )
    if not e.covered.any():
        yield "gpvo evaluate --twins judges a run by its twins, if it was made with --keep-tracks."
    elif (bare := int((~e.covered).sum())) > _FEW_BARE * len(e.covered):
        yield f"{bare} of {len(e.covered)} frames have no ground truth."
    if e.tells_from_m > 0:
        where = "on this run" if math.isinf(e.tells_from_m) else f"below {e.tells_from_m:.2g} m of path"
        yield f"The truth's noise outweighs the odometry's errors {where}, so it cannot judge them there."
    yield from _of_few_motions(e)
    unseen = [a for k, a in enumerate(AXES) if len(e.errors.xi) and k not in seen_axes(e.errors.xi)]
    if 0 < len(unseen) < len(AXES):
        yield (
            f"Odometry and truth never differ in {_listed(unseen)} of the camera (x right, y down, z ahead; planar?):"
            " those axes are not judged."
        )
    if e.late_s is not None and not _are_strangers(e):
        yield (
            f"The clocks of odometry and truth seem to differ by {abs(e.late_s):.3g} s: with --time-offset auto, errors"
            " over a second are smaller."
        )
    if e.inverse is not None:
        backwards = ", unless one of the two looks backwards" if e.inverse.or_backwards else ""
        yield (
            f"The poses of the {e.inverse.of} seem to be inverse, T_cam_world: the other way round, errors over a"
            f" second are {-100 * e.inverse.error_change:.0f} % smaller. Write them as T_world_cam{backwards}."
        )
    if e.unlike is not None:
        yield _of_unlike(e.unlike)
    yield from _of_truth_and_path(e)
    if e.turned is not None and len(unseen) < len(AXES):
        yield _of_frames(e.turned, e.run.log.camera)


def _of_frames(turned: FixedRotation, camera: StereoCamera | None) -> str:
    # So large, it is rarely a mounting: a quaternion with w first read as x first, or a body's poses as a camera's.
    asked = "; are the quaternion's order and --frame right?" if turned.angle_deg > GROSS_DEG else ""
    is_turned, smaller = turned.angle_deg >= _LEAST_DEG, f"{-100 * turned.error_change:.0f} % smaller"
    parts = [f"a fixed rotation of {turned.angle_deg:.2f} deg"] * is_turned
    parts += [f"a lever arm of {turned.lever_m:.3g} m"] * (turned.lever_m > 0)
    size = _of_size("motions are", turned.scale, camera) if turned.scale != 1.0 else ""
    if size and not (parts and turned.align_change):  # --align fits no size, and there is nothing else to fit
        return f"{size} Without {' and '.join(['it', *parts])}, errors over a second are {smaller}."
    return (
        f"Truth and odometry differ by {' and '.join(parts)} (mounting, calibration, or a steady bias of the"
        f" odometry{asked}).{f' {size}' * bool(size)} Without it, errors over a second are {smaller} (--align"
        f" {'transform' if turned.lever_m else 'rotation'}{', but nothing takes off the size' * bool(size)})."
    )


def _of_size(what: str, scale: float, camera: StereoCamera | None) -> str:
    asked = "a wrong baseline or focal length, or a camera alone."
    if not 1 / _MOST_SCALE < scale < _MOST_SCALE:
        asked = "are both in metres?" + " Are the baseline and the focal length right?" * (camera is not None)
    return f"The odometry's {what} {scale:.3g} times as large as the truth's: {asked}"


def _of_few_motions(e: Evaluation) -> Iterator[str]:
    """Motions so few and so wrong that every mean is theirs."""
    far, square = e.errors.far(_FAR), e.errors.sizes**2
    if 0 < far.sum() <= _FEW_FAR * len(far) and (square[far].sum(axis=0) > _OUTWEIGH * square.sum(axis=0)).any():
        at = e.errors.index[np.flatnonzero(far)[0]]
        yield (
            f"In {far.sum()} of {len(far)} motions, first at frame {at} ({e.t_s[at]:.2f} s), odometry and truth differ"
            f" by more than {_FAR:g} times the median (slips, or jumps of the truth): they outweigh all others in every"
            " mean."
        )


def _are_strangers(e: Evaluation) -> bool:
    """Whether not even the paths of odometry and truth are alike, so that neither a clock nor a unit explains it."""
    return e.unlike is not None and not e.unlike.in_path_alone


def _of_unlike(found: Resemblance) -> str:
    shares = {"motion": found.motion, "turn": found.turn}
    apart = " and ".join(f"{100 * share:.0f} % of the {what}" for what, share in shares.items() if share > 0.05)
    told = f"over a second they differ by {apart}, however their frames are turned against each other"
    if found.in_path_alone:
        return (
            f"Odometry and truth take the same path, but not with the same attitudes: {told}. Are the quaternions of"
            " both in the right order (TUM and --map: x y z w) and not conjugate, positions and attitudes in one"
            " right-handed frame, and --frame right?"
        )
    return (
        f"Odometry and truth do not move alike: {told}. Are they of one flight, on one clock and at the rate of their"
        " stamps, poses of one body and not increments, with the quaternions in the right order?"
    )


def _of_truth_and_path(e: Evaluation) -> Iterator[str]:
    """A truth that stalls or is slower than the frames, and a path of another size."""
    if e.run.truth is None or not e.covered.any():
        return
    given = len(e.run.truth.t_ns)
    if held := given - len(without_held(e.run.truth).t_ns):
        yield (
            f"{held} of {given} poses of the ground truth only repeat the one before while it moves, as a source does"
            " that stalls or is slower: they do not count."
        )
    if steps_s := steps_of_slow_truth(e.run.truth, e.run.log.t_ns):
        between = (
            "between its poses it is interpolated, and what that misses is only estimated"
            if steps_s[0] <= MAX_GAP_S
            else f"nothing is interpolated over more than {MAX_GAP_S:g} s"
        )
        yield f"The ground truth comes every {steps_s[0]:.2g} s, the frames every {steps_s[1]:.2g} s: {between}."
    if every := interpolated_between(e.run.truth):
        yield (
            f"The ground truth runs in straight pieces of {every} poses: it was interpolated, and looks more exact than"
            " it is. Give the poses as they were measured."
        )
    # Of each piece that no lost motion breaks: a log that starts again, at its origin, is no smaller for it.
    log = flag_slips(e.run.log)
    piece = np.cumsum(~log.usable & log.column("is_reference"))[e.covered]
    size, true_size = (_extent(T[e.covered, :3, 3], piece) for T in (e.T_est, e.T_true))
    whole = _extent(e.T_true[e.covered, :3, 3], np.zeros_like(piece))
    is_told = e.turned is not None and e.turned.scale != 1.0
    is_one_path = e.inverse is None and not is_told and not _are_strangers(e)
    told = is_one_path and whole > _LEAST_PATH_M and true_size > 0
    if told and not 1 / _MOST_SCALE < size / true_size < _MOST_SCALE:
        yield _of_size("path is", size / true_size, e.run.log.camera)


def _extent(p: Array, piece: NDArray[np.int64]) -> float:
    """Rms distance [m] of positions (n, 3) from the mean of their ``piece`` (n,)."""
    _, of, count = np.unique(piece, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(of, axis) / count for axis in p.T], axis=1)
    return float(np.sqrt(((p - mean[of]) ** 2).sum(axis=1).mean()))


def _up_to(sigma: Array) -> str:
    """The worst axis of each kind."""
    translation, rotation = 1e3 * sigma.reshape(2, 3).max(axis=1)
    return " and ".join(f"{x:.2g} {unit}" for x, unit in ((translation, "mm"), (rotation, "mrad")) if x)
