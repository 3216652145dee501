"""One self-contained HTML page: no network, readable on a phone and in print."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gpvo import __version__
from gpvo.evaluation import panels
from gpvo.evaluation.document import document
from gpvo.evaluation.evaluate import Evaluation
from gpvo.evaluation.panels import spread
from gpvo.evaluation.verdict import HONEST
from gpvo.files import templates, write_text
from gpvo.geometry.covariance import half_axes
from gpvo.types import Array

if TYPE_CHECKING:
    from gpvo.evaluation.pictures import MatchPicture

PAGE = (b"<title>gpvo report</title>", "report")
_MAX_POINTS = 600


def write_report(
    evaluations: Sequence[Evaluation], path: Path, pictures: Sequence[MatchPicture] = (), model: str = ""
) -> None:
    """Write the page, whole or not at all. ``pictures``: matches of single frames of the only run; ``model``: name of
    the error model behind ``learned``."""
    write_text(path, render(evaluations, pictures, model), own=PAGE)


def render(evaluations: Sequence[Evaluation], pictures: Sequence[MatchPicture] = (), model: str = "") -> str:
    """The page as text. Its table shows the numbers of ``gpvo evaluate --json``."""
    environment = templates("gpvo.evaluation")
    environment.filters["number"] = number
    environment.filters["tone"] = _tone
    runs = []
    for entry, evaluation in zip(document(evaluations)["runs"], evaluations, strict=True):
        runs.append(
            {
                "data": entry,
                "groups": _groups(evaluation),
                "scene": _embedded(scene(evaluation)),
                "bounds_of": evaluation.shown_method,
                "verdict": _worded(entry["verdict"]),
                "camera": _camera(evaluation),
                "judged": bool(evaluation.covered.any()),
            }
        )
    return environment.get_template("report.html").render(
        runs=runs, pictures=pictures, version=__version__, made=_made(evaluations), model=model
    )


def _groups(e: Evaluation) -> list[dict[str, Any]]:
    out = []
    for (title, note), drawings in panels.GROUPS.items():
        drawn = [_embedded(panel) for d in drawings for panel in d.of(e)]
        if drawn:
            out.append({"title": title, "note": note.format(method=e.shown_method), "panels": drawn})
    return out


def scene(e: Evaluation) -> dict[str, Any]:
    """Estimate, truth and 3-sigma ellipsoids for the turnable view, z up, centred, lengths in m."""
    to_plane, _ = panels.level(e.T_world_first)
    keep, covered = spread(len(e.T_est), _MAX_POINTS), np.flatnonzero(e.covered)
    shown = covered[spread(len(covered), _MAX_POINTS)]
    est, true = e.T_est[keep, :3, 3] @ to_plane.T, e.T_true[shown, :3, 3] @ to_plane.T
    path = true if len(true) else est
    centre = (path.max(0) + path.min(0)) / 2
    ellipsoids: list[dict[str, Any]] = []
    if (bounds := e.shown_bounds) is not None:
        for k in np.unique(np.linspace(0, len(e.T_est) - 1, 10).astype(int))[1:]:
            R = to_plane @ e.T_est[k, :3, :3]
            axes = half_axes(R @ bounds[k, :3, :3] @ R.T)
            ellipsoids.append({"at": _rounded(to_plane @ e.T_est[k, :3, 3] - centre), "axes": _rounded(axes)})
    # Whole ellipsoids lie inside the view, unless they are far larger than the path.
    reach = [np.abs(o["at"]).max() + np.linalg.norm(o["axes"], axis=1).max() for o in ellipsoids]
    half = max(float(np.abs(path - centre).max()), 1e-6)
    size = max(half, min(max(map(float, reach), default=0.0), 3.0 * half))
    return {"est": _rounded(est - centre), "true": _rounded(true - centre), "ellipsoids": ellipsoids, "size": size}


def _worded(found: dict[str, Any]) -> dict[str, Any]:
    words = {"green": "honest", "amber": "partly honest", "red": "not honest"}
    told = (word for word in ("overconfident", "too cautious") if word in found["headline"])
    return {**found, "word": next(told, words[found["colour"]]) if found["judged"] else "cannot be judged"}


def _camera(e: Evaluation) -> str:
    camera = e.run.log.camera
    if camera is None:
        return ""
    return f"{camera.width}x{camera.height}, {camera.fx_px:.0f} px, baseline {camera.baseline_m:.3g} m"


def _made(evaluations: Sequence[Evaluation]) -> str:
    """When the runs were made, so that the same runs give the same page."""
    days = sorted({str(e.run.meta.get("finished") or e.run.meta.get("created") or "")[:10] for e in evaluations} - {""})
    return f"runs of {' to '.join(dict.fromkeys((days[0], days[-1])))}" if days else "undated runs"


def _rounded(values: Array) -> Any:
    return np.round(values, 5).tolist()


def _embedded(value: Any) -> str:
    """JSON that cannot end the element it stands in."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _tone(nees: float | None) -> str:
    """Colour of a NEES per degree of freedom, as in the verdict."""
    if nees is None or not np.isfinite(nees):
        return ""
    return "red" if nees > HONEST[1] else "amber" if nees < HONEST[0] else "green"


def number(value: float | None) -> str:
    """Three digits, as every table shows them; a dash for what could not be computed."""
    return "–" if value is None or not np.isfinite(value) else f"{value:.3g}"
