"""Pictures have the axes they say, the report stands alone and shows the numbers of ``--json``."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from evaluation_runs import make_run
from gpvo.errors import SourceError
from gpvo.evaluation import panels, plots
from gpvo.evaluation.evaluate import Evaluation, document, evaluate_run
from gpvo.evaluation.report import render, scene, write_report
from gpvo.io.run import read_run, write_run
from gpvo.types import VoLog
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
    "memory": [("lag [s]", "autocorrelation"), ("averaging time [s]", "Allan deviation")],
    "nees": [("time [s]", "NEES / dof")],
    "inputs": [("", "points"), ("", "disparity [px]"), ("time [s]", "image")],
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
    (ax,) = plots.reliability(evaluation).axes
    line = next(entry for entry in ax.get_lines() if entry.get_label() == "triangulation")
    np.testing.assert_allclose(line.get_ydata(), line.get_xdata(), atol=0.05)


def test_pictures_are_saved(evaluation, tmp_path):
    saved = plots.save_all(evaluation, tmp_path / "pictures")
    assert len(saved) == len(plots.FIGURES)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in saved)


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

    monkeypatch.setattr("gpvo.io.atomic.os.replace", fail)
    with pytest.raises(SourceError, match=r"report\.html: cannot be written: disk full"):
        write_report([evaluation], target)
    assert target.read_bytes() == before
    assert [p.name for p in target.parent.iterdir()] == ["report.html"]


def _embedded(page: str) -> list[dict]:
    """Every JSON block of the page."""
    return [json.loads(text) for text in re.findall(r'<script type="application/json">(.*?)</script>', page, re.DOTALL)]


def test_every_panel_is_on_the_page(evaluation, page):
    wanted = [panel for group in panels.groups(evaluation) for panel in group["panels"]]
    assert _embedded(page)[1:] == wanted
    labels = {panel["y"] for panel in wanted}
    assert labels >= {"x [mm]", "rot z [mrad]", "share of errors inside", "NEES / dof", "autocorrelation", "points"}
    # Both views, six axes, reliability and NEES, two memories, points alone: no images, no disparities.
    assert len(wanted) == 2 + 6 + 2 + 2 + 1


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


def test_views_are_no_mirror_images(evaluation):
    to_plane, _ = plots.level(evaluation)
    assert np.linalg.det(to_plane) == pytest.approx(1.0)
    T = np.tile(np.eye(4), (len(evaluation.T_true), 1, 1))
    to_plane, names = plots.level(replace(evaluation, T_true=T))
    assert names[0] == "forward z"
    assert np.linalg.det(to_plane) == pytest.approx(1.0)


def test_what_is_embedded_cannot_end_its_element(evaluation):
    run = evaluation.run
    said = {"</script><b>": np.eye(6) * 1e-6}
    log = VoLog([replace(r, covariances=said if r.usable else {}, v_t={}) for r in run.log], run.log.camera)
    nasty = render([evaluate_run(replace(run, log=log))])
    assert "</script><b>" not in nasty
    assert all(isinstance(block, dict) for block in _embedded(nasty))


@pytest.mark.slow
@pytest.mark.parametrize("width", [360, 1200])
def test_a_browser_shows_the_page_without_errors(page, tmp_path, width):
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium here to open the report with")
    # At the end of the scripts: did they run, does anything stick out sideways, and was anything fetched?
    probe = """<script>
    document.body.dataset.wide = document.documentElement.scrollWidth - window.innerWidth;
    document.body.dataset.drawn = document.querySelectorAll("figure.panel svg path").length;
    document.body.dataset.fetched = performance.getEntriesByType("resource").length;
    const drawn = () => document.querySelectorAll("figure.panel svg path").length, before = drawn();
    document.querySelector("figure.panel figcaption button").click();
    document.body.dataset.hidden = before - drawn();
    document.querySelector("figure.panel figcaption button").click();
    document.body.dataset.back = before - drawn();
    const svg = document.querySelector("svg.timed"), box = svg.getBoundingClientRect();
    const move = (type, share) => svg.dispatchEvent(new PointerEvent(type,
      { clientX: box.left + share * box.width, pointerType: "mouse", bubbles: true }));
    move("pointermove", 0.5);
    document.body.dataset.values = svg.parentElement.querySelector(".values").textContent.split("\\n").length;
    const timed = () => [...document.querySelectorAll("svg.timed")];
    const ticks = () => timed().map(s => s.querySelector("text").textContent).join();
    const whole = ticks();
    move("pointerdown", 0.4);
    move("pointerup", 0.6);
    document.body.dataset.zoomed = ticks() !== whole;
    document.querySelector("svg.timed").dispatchEvent(new MouseEvent("dblclick"));
    document.body.dataset.unzoomed = ticks() === whole;
    document.body.dataset.verdict = document.querySelector(".verdict strong").textContent;
    document.body.dataset.letters = getComputedStyle(document.querySelector("figure text")).fontSize;
    </script></body>"""
    (tmp_path / "report.html").write_text(page.replace("</body>", probe), encoding="utf-8")
    command = [
        browser, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--v=0",
        f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},900",
        "--dump-dom", (tmp_path / "report.html").as_uri(),
    ]  # fmt: skip
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    found = dict(
        re.findall(
            r'data-(wide|drawn|fetched|letters|hidden|back|values|zoomed|unzoomed|verdict)="([^"]*)"', shown.stdout
        )
    )
    assert int(found["wide"]) <= 0
    assert int(found["drawn"]) >= 13
    assert found["fetched"] == "0"
    assert found["letters"] == "12px"
    # A click on a name hides its curve wherever it is drawn, and another brings it back.
    assert int(found["hidden"]) >= 1
    assert found["back"] == "0"
    # The pointer shows the time and what each curve has there; dragging zooms all times together.
    assert int(found["values"]) >= 2
    assert (found["zoomed"], found["unzoomed"]) == ("true", "true")
    assert found["verdict"] == "The triangulation covariance is true here, per motion and over distance."
    # Drawing sets the size of the canvas.
    assert re.search(r'<canvas[^>]* width="\d+"', shown.stdout)
    # The page forbids itself to fetch anything: an attempt would be an error here, as any other would.
    assert "default-src 'none'" in page
    assert "CONSOLE" not in shown.stderr, shown.stderr
