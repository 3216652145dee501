"""Figures have the axes they say, the report stands alone and shows the numbers of ``--json``."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import make_run
from gpvo.errors import SourceError
from gpvo.evaluation import panels, plots
from gpvo.evaluation.document import document
from gpvo.evaluation.evaluate import Evaluation, evaluate_run, unjudged_run
from gpvo.evaluation.fusion import Trace
from gpvo.evaluation.report import render, scene, write_report
from gpvo.geometry import se3
from gpvo.io.run import Run, read_run, write_run
from gpvo.types import Mounting, Status, VoLog, VoRecord
from matplotlib.figure import Figure

AXES = {
    "trajectory": [("[m]", "[m]")] * 2,
    "errors": [
        ("", "x [mm]"),
        ("", "rot x [mrad]"),
        ("", "y"),
        ("", "rot y"),
        ("time [s]", "z"),
        ("time [s]", "rot z"),
    ],
    "reliability": [("stated probability", "share of errors inside")],
    "memory": [("lag [s]", "autocorrelation"), ("averaging time [s]", "deviation")],
    "nees": [("time [s]", "NEES / dof")],
    "inputs": [("time [s]", "points")],
}


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory) -> Evaluation:
    log, truth = make_run(300, lost={40})
    path = tmp_path_factory.mktemp("runs") / "a & b <i>"
    write_run(path, log, truth=truth)
    return evaluate_run(read_run(path))


@pytest.fixture(scope="module")
def page(evaluation) -> str:
    return render([evaluation])


@pytest.mark.parametrize("name", list(plots.FIGURES))
def test_figures_have_their_axes(evaluation, name):
    figure = plots.FIGURES[name](evaluation)
    assert isinstance(figure, Figure)
    labels = [(ax.get_xlabel(), ax.get_ylabel()) for ax in figure.axes]
    assert len(labels) == len(AXES[name])
    for (x, y), (in_x, in_y) in zip(labels, AXES[name], strict=True):
        assert in_x in x
        assert in_y in y


def test_reliability_of_an_honest_method_is_the_diagonal(evaluation):
    (ax,) = plots.FIGURES["reliability"](evaluation).axes
    line = next(entry for entry in ax.get_lines() if entry.get_label() == "triangulation")
    np.testing.assert_allclose(line.get_ydata(), line.get_xdata(), atol=0.05)


def test_pictures_are_saved(evaluation, tmp_path):
    saved = plots.save_all(evaluation, tmp_path / "pictures")
    assert len(saved) == len(plots.FIGURES)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in saved)


def test_many_names_stand_beside_their_curves(evaluation):
    figure = plots.FIGURES["memory"](evaluation)
    figure.draw_without_rendering()
    for ax in figure.axes:
        assert ax.get_legend().get_window_extent().x0 >= ax.get_window_extent().x1


def _trace(world: np.ndarray) -> Trace:
    """Half a circle of 10 m, level, flown by a camera that looks ahead and knows its world turned by ``world``."""
    a = np.linspace(0.0, np.pi, 50)
    flat = 10.0 * np.column_stack([np.sin(a), 1.0 - np.cos(a), np.zeros_like(a)])
    T = se3.from_rt(world @ se3.R_FLU_OPTICAL, np.zeros(3))
    return Trace("flight", "learned", a, T, flat @ world.T, 1.01 * flat @ world.T, 0 * a, 0 * a, 1 + a)


def test_the_path_of_a_filter_is_seen_from_above_in_the_world_of_a_camera_too():
    """KITTI's world is its first camera's, y down: x and y of it are a view along the road."""
    drawn = []
    for world in (np.eye(3), se3.R_FLU_OPTICAL.T):
        ax = plots.fusion([_trace(world)]).axes[0]
        drawn.append([entry.get_xydata() for entry in ax.get_lines()])
        assert ("forward z" in ax.get_xlabel()) == (world[0, 0] == 0)
    np.testing.assert_allclose(drawn[0], drawn[1], atol=1e-9)
    assert np.ptp(drawn[1][0], axis=0) == pytest.approx([10.1, 20.2], rel=2e-2)


def test_the_page_stands_alone(page):
    # Names of XML vocabularies are not fetched; sources, links, styles and scripts would be.
    assert not re.search(r"""(?:src|href|action)\s*=\s*["']?\s*(?:https?:|//|file:)""", page)
    assert not re.search(r"url\(\s*['\"]?(?:https?:|//)|@import|fetch\(|XMLHttpRequest|import\(", page)
    assert "a & b <i>" not in page
    assert "a &amp; b &lt;i&gt;" in page


class _Cells(HTMLParser):
    """Rows of table cells, as text."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self._inside = False

    def handle_starttag(self, tag, attrs):
        if tag == "tr":
            self.rows.append([])
        if tag == "td":
            self.rows[-1].append("")
        self._inside = tag == "td"

    def handle_endtag(self, tag):
        self._inside = self._inside and tag != "td"

    def handle_data(self, data):
        if self._inside:
            self.rows[-1][-1] += data.strip()


def test_the_table_shows_the_numbers_of_json(evaluation, page):
    parser = _Cells()
    parser.feed(page)
    rows = {row[0]: row for row in parser.rows if row}
    (run,) = document([evaluation])["runs"]

    def shown(value: float) -> str:
        return f"{value:.3g}"

    m = run["methods"]["triangulation"]
    expected = [m["nees_dof"][b] for b in ("joint", "translation", "rotation")]
    expected += [m["nees_dof_median"]["joint"], m["nees_dof_truth_noise"]["joint"]]
    expected += [m["one_second"][name] for name in ("nees_dof", "nees_dof_truth_noise")]
    expected += [100 * m["coverage"][k] for k in "123"]
    expected += [m["nll_per_dim"], 1000 * m["energy"]["translation_m"], m["predicted_final_error_m"]]
    assert rows["triangulation"][1:] == [shown(v) for v in expected]
    assert rows["triangulation_vt"][1] == "–"
    reached = [s for s in run["segments"] if s["count"]]
    assert [s["length_m"] for s in reached] == [10.0]
    for s in reached:
        row = rows[f"{shown(s['length_m'])} m"]
        assert row[1:] == [shown(s["translation_percent"]), shown(s["rotation_deg_per_m"]), str(s["count"])]
    assert f"ATE {shown(run['ate_rmse_m'])} m" in page


def test_the_scene_is_centred_and_has_ellipsoids(evaluation):
    s = scene(evaluation)
    assert len(s["est"]) == len(s["true"]) == 301
    ends = [
        np.array(o["at"]) + sign * np.array(axis) for o in s["ellipsoids"] for axis in o["axes"] for sign in (1, -1)
    ]
    assert max(np.abs(s["true"]).max(), np.abs(ends).max()) <= s["size"] + 1e-4 <= 3 * np.abs(s["true"]).max()
    assert len(s["ellipsoids"]) == 9
    axes = np.array(s["ellipsoids"][-1]["axes"])
    half = np.linalg.norm(axes, axis=1)
    final = evaluation.consistency["triangulation"].predicted_final_error_m
    assert np.sqrt((half**2).sum()) / 3 == pytest.approx(final, rel=1e-3)


def test_the_same_input_gives_the_same_page(evaluation, page):
    assert render([evaluation]) == page


def test_the_file_is_whole_or_absent(evaluation, tmp_path, monkeypatch):
    target = tmp_path / "deep" / "report.html"
    write_report([evaluation], target)
    assert target.read_text(encoding="utf-8").rstrip().endswith("</html>")
    before = target.read_bytes()

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("gpvo.files.os.replace", fail)
    with pytest.raises(SourceError, match=r"report\.html: cannot be written: disk full"):
        write_report([evaluation], target)
    assert target.read_bytes() == before
    assert [p.name for p in target.parent.iterdir()] == ["report.html"]


def _embedded(page: str) -> list[dict]:
    """Every JSON block of the page."""
    return [json.loads(text) for text in re.findall(r'<script type="application/json">(.*?)</script>', page, re.DOTALL)]


def test_every_panel_is_on_the_page(evaluation, page):
    wanted = [panel for drawings in panels.GROUPS.values() for drawing in drawings for panel in drawing.of(evaluation)]
    assert _embedded(page)[1:] == wanted
    labels = {panel["y"] for panel in wanted}
    assert labels >= {"x [mm]", "rot z [mrad]", "share of errors inside", "NEES / dof", "autocorrelation", "points"}
    # Both views, six axes, two of what is stated, reliability and NEES, two of time, points alone: no images.
    assert len(wanted) == 2 + 6 + 2 + 2 + 2 + 1


@pytest.mark.parametrize("factor,until", [(0.01, 300), (1.0, 300), (400.0, 300), (400.0, 100)])
def test_bounds_and_ellipses_lie_inside_their_pictures(factor, until):
    log, truth = make_run(300)
    factors = np.where(np.arange(len(log)) < until, factor, 1.0)
    records = [replace(r, covariances={m: f * C for m, C in r.covariances.items()}) for r, f in zip(log, factors)]
    e = evaluate_run(Run(Path("hall"), "hall", VoLog(records, log.camera), truth, None, Mounting(), []))
    for panel in panels.errors(e):
        (band,), (_, top) = panel["bands"], panel["limit"]
        inside = np.mean(np.abs(np.array(band["high"], float)) < top)
        assert inside > 0.9, panel["y"]
    for panel in panels.views(e):
        rings = [line for line in panel["lines"] if not line["name"]]
        assert len(rings) == 11
        assert not any(line["aside"] for line in rings)


def test_a_panel_shows_the_lost_frame(evaluation):
    (points,) = panels.inputs(evaluation)
    assert points["shades"] == [{"from": 1.95, "to": 2.0, "colour": "#d62728"}]


def test_thinning_loses_no_peak():
    y = np.zeros(100_000)
    y[12_345], y[77_777], y[500] = 5.0, -3.0, np.nan
    x, thin = panels._thin(np.arange(100_000.0), y)
    assert len(thin) <= panels.MAX_POINTS
    assert (np.diff(x) > 0).all()
    assert np.nanmax(thin) == 5.0
    assert np.nanmin(thin) == -3.0


def test_shades_of_a_long_run_are_no_more_than_a_screen_shows():
    n, bad = 20_000, {Status.LOST: range(7, 19_000, 10), Status.DEGRADED: [19_500]}
    status = {k: s for s, frames in bad.items() for k in frames}
    records = [VoRecord(k * 10**8, max(k - 1, 0) * 10**8, status.get(k, Status.OK), np.eye(4)) for k in range(n)]
    run = Run(Path("long"), "long", VoLog(records), None, None, Mounting(), [])
    shades = panels._shades(unjudged_run(run))
    assert [s["colour"] for s in shades] == ["#d62728", "#ffbf00"]
    assert (shades[0]["from"], shades[0]["to"]) == (0.6, 1899.7)
    assert (shades[1]["from"], shades[1]["to"]) == (1949.9, 1950.0)


def test_views_are_no_mirror_images(evaluation):
    to_plane, _ = panels.level(evaluation.T_world_first)
    assert np.linalg.det(to_plane) == pytest.approx(1.0)
    T = np.tile(np.eye(4), (len(evaluation.T_true), 1, 1))
    to_plane, names = panels.level(replace(evaluation, T_true=T).T_world_first)
    assert names[0] == "forward z"
    assert np.linalg.det(to_plane) == pytest.approx(1.0)


def test_what_is_embedded_cannot_end_its_element(evaluation):
    run = evaluation.run
    said = {"</script><b>": np.eye(6) * 1e-6}
    log = VoLog([replace(r, covariances=said if r.usable else {}, v_t={}) for r in run.log], run.log.camera)
    nasty = render([evaluate_run(replace(run, log=log))])
    assert "</script><b>" not in nasty
    assert all(isinstance(block, dict) for block in _embedded(nasty))
