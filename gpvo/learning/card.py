"""The model card: what a person should know before flying a model, in Markdown beside the file."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from datetime import datetime, timezone
from typing import Any

from gpvo.files import markdown_table


def model_card(header: Mapping[str, Any], table: Mapping[str, Any], name: str) -> str:
    """Markdown from a model's header and its table of left-out sequences."""
    if header["target"] == "position":
        return "\n\n".join([_position(header, name), _sequences(header), _domain(header)]) + "\n"
    sections = [
        _intro(header, name),
        _unfit(header, table),
        _data(header),
        _scores(table, name),
        _calibration(header),
        _domain(header),
        _limits(header),
    ]
    return "\n\n".join(s for s in sections if s) + "\n"


def _intro(h: Mapping[str, Any], name: str) -> str:
    choices = h["choices"]
    inputs = ", ".join(f"`{i}`" for i in h["inputs"]) or (
        "none: no set of features predicts left-out sequences better than the base variance does, beyond chance"
    )
    return "\n".join(
        [
            f"# {name}",
            "",
            "Predicts the error covariance of stereo visual odometry, in the frame of the rectified left camera.",
            "",
            f"* trained on {_today()} with gpvo {h['versions']['gpvo']}",
            f"* target: {h['target']} ({h['horizon']}), at {h['rate_hz']:.3g} Hz",
            f"* base variance: {choices['base']}",
            f"* inputs of the Gaussian process (chosen set: {choices['inputs']}): {inputs}",
        ]
    )


def _today() -> str:
    """The date, or that of the environment's SOURCE_DATE_EPOCH, by which builds are made reproducible."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    now = datetime.fromtimestamp(int(epoch), timezone.utc) if epoch.isdecimal() else datetime.now(timezone.utc)
    return now.date().isoformat()


def _unfit(h: Mapping[str, Any], table: Mapping[str, Any]) -> str:
    """Where the model must not be used, by example."""
    camera, domain = h["camera"], h["training_domain"]
    lines = [f"* At a rate other than {h['rate_hz']:.3g} frames/s."]
    if camera is not None:
        lines.insert(0, f"* With a camera other than its own (focal length {_camera(camera)}).")
    speeds = [domain[c] for c in ("v_x_mps", "v_y_mps", "v_z_mps") if c in domain]
    if speeds:
        top = max(abs(v) for reach in speeds for v in reach)
        lines.append(f"* Faster than {top:.2g} m/s along any axis of the camera, the highest speed in training.")
    if "n_inliers" in domain:
        lines.append(
            f"* Where odometry keeps fewer than {math.ceil(domain['n_inliers'][0])} inliers, the fewest in training."
        )
    for fold in table.get("folds", ()):
        found, inside = fold["methods"]["learned"]["nees_dof"]["joint"], fold.get("in_domain", 1.0)
        if found is not None and not 0.5 <= found <= 2.0:
            wrong = "overconfident" if found > 1 else "too cautious"
            lines.append(
                f"* On flights like `{fold['held_out']}`: left out of training, it was {wrong} (NEES/dof {found:.3g})."
            )
        elif inside < 0.9:
            lines.append(f"* On flights like `{fold['held_out']}`: only {100 * inside:.0f} % of it was in domain.")
    if h.get("simulated_truth"):
        lines.append("* As evidence that a vehicle is safe: the ground truth was simulated.")
    return "\n".join(["## Where not to use it", "", *lines, "", "`gpvo check MODEL RUN` checks this before a flight."])


def _position(h: Mapping[str, Any], name: str) -> str:
    what = "Predicts the residual of the accumulated position [m], as the thesis does. Not for filters."
    return "\n".join([f"# {name}", "", what, "", f"* inputs: {', '.join(f'`{i}`' for i in h['features'])}"])


def _data(h: Mapping[str, Any]) -> str:
    return _sequences(h) + _simulated(h) + f"\n\nDigest of the rows: `{h['training_digest']}`"


def _simulated(h: Mapping[str, Any]) -> str:
    """Says so where truth was simulated, as the twins' is."""
    told = []
    for s in h.get("simulated_truth") or ():
        rig = ", ".join(f"{k} {v:g}" for k, v in s["tolerance"].items())
        gap = f"; errors times {', '.join(f'{v:.2f}' for v in s['gap']['ratio'])} by axis" if s.get("gap") else ""
        told.append(f"* {s['twins']} twins of `{s['of']}`; tolerance of the rig `{s['tolerance_name']}` ({rig}){gap}")
    if not told:
        return ""
    head = "The truth was simulated: these sequences are twins, made from the tracks of a run. Leaving out twins of one"
    return "\n".join(["\n", f"{head} run tests the fit, not how well it carries over to another flight.", "", *told])


def _sequences(h: Mapping[str, Any]) -> str:
    keys, camera = ("name", "rows", "lost", "without_truth", "truth_moves_at_rest"), h["camera"]
    seen = "no camera known"
    if camera is not None:
        seen = f"focal length {_camera(camera)}, {camera['width']}x{camera['height']}"
    rows = [[str(s.get(key, 0)) for key in keys] for s in h["sequences"]]
    head = ("sequence", "rows", "lost", "without truth", "truth moves at rest")
    return "\n".join(["## Training data", "", f"Camera: {seen}.", "", *markdown_table(head, rows)])


def _camera(camera: Mapping[str, Any]) -> str:
    return f"{camera['fx_px']:.1f} px, baseline {camera['baseline_m']:.4f} m"


def _table(scores: Iterable[tuple[str, Mapping[str, Any]]]) -> list[str]:
    """The lines of a table of scores by name, without those of which nothing is known."""
    rows = []
    for name, s in scores:
        numbers = [s["nees_dof"]["joint"], s["nees_dof_median"]["joint"], s["coverage"]["1"]]
        numbers += [s["nll_per_dim"], s["nll_stated_per_dim"]]
        if any(numbers):
            rows.append([name, *("-" if v is None else f"{v:.3g}" for v in numbers)])
    return markdown_table(("", "NEES/dof", "median", "within 1 sigma", "NLL per axis, Gaussian", "as stated"), rows)


def _scores(table: Mapping[str, Any], name: str) -> str:
    if not table.get("folds"):
        return "## Scores\n\nOne short sequence: none could be left out, so nothing is known about others."
    blocks = table.get("folds_are") == "time blocks"
    lines = [
        "## Scores on sequences left out" if not blocks else "## Scores on parts of the one sequence, left out in turn",
        "",
        *(["They say nothing about another flight.", ""] if blocks else []),
        *_table(table["mean"].items()),
    ]
    c = table["comparison"]
    d = c["nll_per_dim_difference"]
    lines += [
        "",
        f"Best row by NLL: `{c['best_row']}`. `learned` minus `{c['rival']}`: {_difference(d)}.",
        _gain_of_gp(c["learned_less_base"]),
        "",
        "`learned` on each:",
        "",
        *_table((fold["held_out"], fold["methods"]["learned"]) for fold in table["folds"]),
    ]
    if any(fold.get("stated_and_actual") for fold in table["folds"]):
        lines += [
            "",
            f"![Stated against actual error]({name}.svg)",
            "",
            "Actual error against stated sigma of each axis, for ten groups of motions sorted by it. On the diagonal",
            "sigma is right; above it sigma is too small. In the green band it is right within a factor of 1.4.",
        ]
    return "\n".join(lines)


def _difference(d: Mapping[str, float | None]) -> str:
    interval = "(too few for an interval)" if d["low"] is None else f"[{d['low']:+.3f}, {d['high']:+.3f}]"
    return f"{d['mean']:+.3f} nats per axis {interval}"


def _gain_of_gp(d: Mapping[str, float | None]) -> str:
    """What the Gaussian process adds to its own mean function, in plain words."""
    low, high = d["low"], d["high"]
    if d["mean"] == 0.0 and not low and not high:
        verdict = "the Gaussian process is not at work"
    elif high is not None and high < 0:
        verdict = "the Gaussian process gains"
    else:
        loses = low is not None and low > 0
        verdict = "the Gaussian process loses" if loses else "the Gaussian process changes nothing beyond chance"
    return f"`learned` minus `base` (the Gaussian process held at its mean): {_difference(d)}: {verdict}."


def _calibration(h: Mapping[str, Any]) -> str:
    c = h["calibration"]
    marked = " With so few sequences the spread between sequences is a guess." if h["by_few_sequences"] else ""
    widths = ", ".join(
        f"{100 * level:.0f} %: {w:.2f}" for level, w in zip(c["interval_levels"], c["interval_sigmas"][0])
    )
    apart = bool(c.get("calibration_part"))
    return "\n".join(
        [
            "## Calibration",
            "",
            f"Calibrated by {c['by']} ({c['groups']} left out in turn).{marked}",
            _tails(h["calibration"]),
            f"Half widths, in sigma, of the intervals that covered left-out data on the first axis: {widths}.",
            *(["The camera's calibration differs between these sequences; a part of the model is for that."] * apart),
        ]
    )


def _tails(calibration: Mapping[str, Any]) -> str:
    nu = calibration.get("nu")
    shape = "Gaussian" if nu is None else f"a Student-t with {nu:.1f} degrees of freedom"
    return f"The error of one motion is stated as {shape}; the covariance is its second moment."


def _domain(h: Mapping[str, Any]) -> str:
    ranges = zip(h["training_domain"].items(), h["units"])
    rows = [[f"`{name}`", unit, f"{low:.4g}", f"{high:.4g}"] for (name, (low, high)), unit in ranges]
    return "\n".join(["## Range of the training data", "", *markdown_table(("feature", "unit", "from", "to"), rows)])


def _limits(h: Mapping[str, Any]) -> str:
    return "\n".join(
        [
            "## Limits",
            "",
            "* Outside the ranges above the covariance grows, `in_domain` falls, and the numbers are a guess.",
            "* The noise of the ground truth is part of the error that was learned.",
            f"* Versions: {', '.join(f'{name} {number}' for name, number in h['versions'].items())}.",
        ]
    )
