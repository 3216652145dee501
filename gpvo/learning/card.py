"""The model card: what a person should know before flying a model, in Markdown beside the file, with a picture."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timezone
from html import escape
from typing import Any

from gpvo.files import markdown_table

_PANELS = (("translation_m", "translation [mm]"), ("rotation_rad", "rotation [mrad]"))
_COLOURS = (
    "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf",
)  # fmt: skip
_SIZE, _LEFT, _TOP, _GAP = 260, 62, 14, 84
_TRUE = math.sqrt(2.0)
"""Sigma within this factor counts as right, as in the verdict: NEES per degree of freedom from 0.5 to 2."""


def model_card(header: Mapping[str, Any], table: Mapping[str, Any], name: str) -> str:
    """Markdown from a model's header and its table of left-out sequences."""
    if header["target"] == "position":
        what = "Predicts the residual of the accumulated position [m], as the thesis does. Not for filters."
        inputs = f"* inputs: {', '.join(f'`{i}`' for i in header['features'])}"
        return "\n\n".join([f"# {name}", what, inputs, _sequences(header), _domain(header)]) + "\n"
    sections = [
        _intro(header, name),
        _unfit(header, table),
        f"{_sequences(header)}{_simulated(header)}\n\nDigest of the rows: `{header['training_digest']}`",
        _scores(table, name),
        _calibration(header),
        _domain(header),
        _limits(header),
    ]
    return "\n\n".join(s for s in sections if s) + "\n"


def _section(title: str, *lines: str) -> str:
    return "\n".join([f"## {title}", "", *lines])


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
            f"* target: {h['target']}" + f" (one motion), at {h['rate_hz']:.3g} Hz" * (h["target"] == "frame"),
            f"* base variance: {choices['base']}",
            f"* inputs of the Gaussian process (chosen set: {choices['inputs']}): {inputs}",
        ]
    )


def _today() -> str:
    """Today's date, or that of SOURCE_DATE_EPOCH in the environment, which makes builds reproducible."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    now = datetime.fromtimestamp(int(epoch), timezone.utc) if epoch.isdecimal() else datetime.now(timezone.utc)
    return now.date().isoformat()


def _unfit(h: Mapping[str, Any], table: Mapping[str, Any]) -> str:
    """Where the model must not be used, with examples."""
    camera, domain = h["camera"], h["training_domain"]
    lines = [f"* At a rate other than {h['rate_hz']:.3g} frames/s."] if h["target"] == "frame" else []
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
    return _section("Where not to use it", *lines, "", "`gpvo check MODEL RUN` checks this before a flight.")


def _simulated(h: Mapping[str, Any]) -> str:
    """Says so if the truth was simulated, as that of twins is."""
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
    return _section("Training data", f"Camera: {seen}.", "", *markdown_table(head, rows))


def _camera(camera: Mapping[str, Any]) -> str:
    return f"{camera['fx_px']:.1f} px, baseline {camera['baseline_m']:.4f} m"


def _table(scores: Iterable[tuple[str, Mapping[str, Any]]]) -> list[str]:
    """The lines of a table of scores by name, without those that have no values."""
    rows = []
    for name, s in scores:
        numbers = [s["nees_dof"]["joint"], s["nees_dof_median"]["joint"], s["coverage"]["1"]]
        numbers += [s["nll_per_dim"], s["nll_stated_per_dim"]]
        if any(numbers):
            rows.append([name, *("-" if v is None else f"{v:.3g}" for v in numbers)])
    return markdown_table(("", "NEES/dof", "median", "within 1 sigma", "NLL per axis, Gaussian", "as stated"), rows)


def _scores(table: Mapping[str, Any], name: str) -> str:
    if not table.get("folds"):
        return _section("Scores", "One short sequence: none could be left out, so nothing is known about others.")
    blocks = table.get("folds_are") == "time blocks"
    title = "Scores on parts of the one sequence, left out in turn" if blocks else "Scores on sequences left out"
    lines = ["They say nothing about another flight.", ""] if blocks else []
    c = table["comparison"]
    d = c["nll_per_dim_difference"]
    lines += [
        *_table(table["mean"].items()),
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
    return _section(title, *lines)


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
    c, nu = h["calibration"], h["calibration"].get("nu")
    shape = "Gaussian" if nu is None else f"a Student-t with {nu:.1f} degrees of freedom"
    marked = " With so few sequences the spread between sequences is a guess." if h["by_few_sequences"] else ""
    widths = ", ".join(
        f"{100 * level:.0f} %: {w:.2f}" for level, w in zip(c["interval_levels"], c["interval_sigmas"][0])
    )
    apart = bool(c.get("calibration_part"))
    return _section(
        "Calibration",
        f"Calibrated by {c['by']} ({c['groups']} left out in turn).{marked}",
        f"The error {'of' if h['target'] == 'frame' else 'over'} {h['horizon']} is stated as {shape}; the covariance"
        " is its second moment.",
        f"Half widths, in sigma, of the intervals that covered left-out data on the first axis: {widths}.",
        *(["The camera's calibration differs between these sequences; a part of the model is for that."] * apart),
    )


def _domain(h: Mapping[str, Any]) -> str:
    ranges = zip(h["training_domain"].items(), h["units"])
    rows = [[f"`{name}`", unit, f"{low:.4g}", f"{high:.4g}"] for (name, (low, high)), unit in ranges]
    return _section("Range of the training data", *markdown_table(("feature", "unit", "from", "to"), rows))


def _limits(h: Mapping[str, Any]) -> str:
    return _section(
        "Limits",
        "* Outside the ranges above the covariance grows, `in_domain` falls, and the numbers are a guess.",
        "* The noise of the ground truth is part of the error that was learned.",
        f"* Versions: {', '.join(f'{name} {number}' for name, number in h['versions'].items())}.",
    )


def stated_against_actual(folds: Sequence[Mapping[str, Any]]) -> str | None:
    """The card's picture as SVG: stated against actual error of motions that were left out of training; None where no
    fold has what it shows."""
    drawn = [f for f in folds if f.get("stated_and_actual")]
    if not drawn:
        return None
    height = _TOP + _SIZE + 52 + 16 * ((len(drawn) + 3) // 4)
    width = 2 * (_LEFT + _SIZE) + 40
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
        ' font-family="system-ui, sans-serif" font-size="12" fill="#333">',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for k, (kind, name) in enumerate(_PANELS):
        parts += _panel(_LEFT + k * (_SIZE + _GAP), name, [f["stated_and_actual"][kind] for f in drawn])
    for k, fold in enumerate(drawn):
        x, y = _LEFT + 165 * (k % 4), _TOP + _SIZE + 54 + 16 * (k // 4)
        parts.append(f'<rect x="{x}" y="{y - 6}" width="12" height="3" fill="{_colour(k)}"/>')
        parts.append(f'<text x="{x + 16}" y="{y}">{escape(str(fold["held_out"])[:22])}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def _panel(left: float, name: str, curves: Sequence[Sequence[tuple[float, float]]]) -> list[str]:
    """Log-log with equal scales, and the band in which sigma counts as right."""
    values = [1e3 * v for curve in curves for pair in curve for v in pair if v > 0] or [0.1, 10.0]
    low, high = min(values) / 1.3, max(values) * 1.3

    def at(value: float) -> float:
        return _SIZE * math.log(max(value, low) / low) / math.log(high / low)

    bottom = _TOP + _SIZE
    above, below = (low * _TRUE, low), (high, high / _TRUE)
    band = (above[::-1], below[::-1], (high, high), below, above, (low, low))
    points = " ".join(f"{left + at(x):.1f},{bottom - at(y):.1f}" for x, y in band)
    out = [
        f'<polygon points="{points}" fill="#2ca02c" opacity="0.13"/>',
        f'<line x1="{left}" y1="{bottom}" x2="{left + _SIZE}" y2="{_TOP}" stroke="#333" stroke-dasharray="4 4"/>',
    ]
    for v in _ticks(low, high):
        x, y = left + at(v), bottom - at(v)
        out.append(f'<line x1="{x:.1f}" y1="{_TOP}" x2="{x:.1f}" y2="{bottom}" stroke="#e5e5e5"/>')
        out.append(f'<line x1="{left}" y1="{y:.1f}" x2="{left + _SIZE}" y2="{y:.1f}" stroke="#e5e5e5"/>')
        out.append(f'<text x="{x:.1f}" y="{bottom + 15}" text-anchor="middle">{v:g}</text>')
        out.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{v:g}</text>')
    for k, curve in enumerate(curves):
        line = " ".join(f"{left + at(1e3 * s):.1f},{bottom - at(1e3 * a):.1f}" for s, a in curve)
        out.append(f'<polyline points="{line}" fill="none" stroke="{_colour(k)}" stroke-width="1.6"/>')
    out.append(f'<rect x="{left}" y="{_TOP}" width="{_SIZE}" height="{_SIZE}" fill="none" stroke="#999"/>')
    middle = _TOP + _SIZE / 2
    out.append(f'<text x="{left + _SIZE / 2}" y="{bottom + 32}" text-anchor="middle">stated {name}</text>')
    turned = f'transform="rotate(-90 {left - 44} {middle})"'
    return [*out, f'<text x="{left - 44}" y="{middle}" text-anchor="middle" {turned}>actual {name}</text>']


def _ticks(low: float, high: float) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1,) if math.log10(high / low) > 2 else (1, 3)
    return [m * 10.0**p for p in decades for m in steps if low <= m * 10.0**p <= high]


def _colour(k: int) -> str:
    return _COLOURS[k % len(_COLOURS)]
