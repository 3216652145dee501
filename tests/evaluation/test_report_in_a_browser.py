"""The report in Chromium: wide and narrow, light and dark; a good fit, a misfit, no truth, and three runs."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from evaluation_runs import make_run
from gpvo.evaluation.evaluate import Evaluation, evaluate_run, unjudged_run
from gpvo.evaluation.report import render
from gpvo.io.run import Run
from gpvo.types import Mounting, VoLog

pytestmark = pytest.mark.slow

TRUE = "The triangulation covariance is honest here, per motion and over 1 s, 1 m and 10 m."
# Case: its verdicts.
CASES = {
    "good fit": [TRUE],
    "misfit": ["The triangulation covariance is overconfident per motion; the model does not know these conditions."],
    "no truth": ["There is no ground truth, so no covariance can be judged."],
    "three runs": [TRUE, TRUE, "The triangulation covariance is too cautious per motion."],
}
# At the end of the scripts: did they run, does anything stick out sideways, and was anything fetched?
PROBE = """<script>
const told = document.body.dataset;
told.wide = document.documentElement.scrollWidth - window.innerWidth;
told.fetched = performance.getEntriesByType("resource").length;
const drawn = () => document.querySelectorAll("figure.panel svg path").length, before = drawn();
told.drawn = before;
const name = () => document.querySelector("figure.panel figcaption button");
name().click();
told.hidden = before - drawn();
name().click();
told.back = before - drawn();
const svg = document.querySelector("svg.timed"), box = svg.getBoundingClientRect();
const move = (type, share) => svg.dispatchEvent(new PointerEvent(type,
  { clientX: box.left + share * box.width, pointerType: "mouse", bubbles: true }));
move("pointermove", 0.5);
const view = document.querySelector("figure.panel svg"), seen = view.getBoundingClientRect();
view.dispatchEvent(new PointerEvent("pointermove",
  { clientX: seen.left + seen.width / 2, clientY: seen.top + seen.height / 2, pointerType: "mouse", bubbles: true }));
told.along = view.parentElement.querySelector(".values").textContent.replace(/ [\\d.e-]+/g, "").replaceAll("\\n", ", ");
told.values = svg.parentElement.querySelector(".values").textContent.split("\\n").length;
const ticks = () => [...document.querySelectorAll("svg.timed")].map(s => s.querySelector("text").textContent).join();
const whole = ticks();
move("pointerdown", 0.4);
move("pointerup", 0.6);
told.zoomed = ticks() !== whole;
document.querySelector("svg.timed").dispatchEvent(new MouseEvent("dblclick"));
told.unzoomed = ticks() === whole;
told.verdicts = [...document.querySelectorAll(".verdict strong")].map(s => s.textContent).join("|");
told.letters = getComputedStyle(document.querySelector("figure text")).fontSize;
told.paper = getComputedStyle(document.body).backgroundColor;
told.across = window.innerWidth;
const numbers = (svg, at) => [...svg.querySelectorAll(`text[text-anchor=${at}]`)].filter(t => !isNaN(t.textContent));
told.bare = [...document.querySelectorAll("figure svg")].filter(
  svg => ["end", "middle"].some(at => numbers(svg, at).length < 2)).length;
told.rows = document.querySelectorAll("nav tr").length;
told.dead = [...document.querySelectorAll("a[href^='#']")].filter(
  a => !document.getElementById(a.getAttribute("href").slice(1))).length;
</script></body>"""


def evaluations(case: str) -> list[Evaluation]:
    factors = {"good fit": [1.0], "misfit": [0.02], "no truth": [1.0], "three runs": [1.0, 1.0, 9.0]}[case]
    out = []
    for k, factor in enumerate(factors):
        log, truth = make_run(300, seed=k)
        records = [replace(r, covariances={m: factor * C for m, C in r.covariances.items()}, v_t={}) for r in log]
        run = Run(Path(f"hall-{k}"), f"hall-{k}", VoLog(records, log.camera), truth, None, Mounting(), [])
        out.append(unjudged_run(replace(run, truth=None)) if case == "no truth" else evaluate_run(run))
    return [replace(e, in_domain=0.03) for e in out] if case == "misfit" else out


@pytest.mark.parametrize("scheme,paper", [("light", "rgb(255, 255, 255)"), ("dark", "rgb(20, 23, 27)")])
@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("case", CASES)
def test_a_browser_shows_the_page_without_errors(
    tmp_path: Path, case: str, width: int, scheme: str, paper: str
) -> None:
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium here to open the report with")
    # An axis that ends just before a round number: it must find two numbers all the same.
    page = re.sub(r'"limit": ?\[[^\]]*\]', '"limit": [-48, 48]', render(evaluations(case), model="tunnel.gpvo"))
    (tmp_path / "report.html").write_text(page.replace("</body>", PROBE), encoding="utf-8")
    command = [
        browser, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--v=0",
        f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},900",
        f"--screen-info={{{width}x900}}", "--kiosk",  # a window of its own is never narrower than 500 pixels
        f"--blink-settings=preferredColorScheme={0 if scheme == 'dark' else 1}",
        "--dump-dom", (tmp_path / "report.html").as_uri(),
    ]  # fmt: skip
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    (body,) = re.findall("<body[^>]*>", shown.stdout)
    found = dict(re.findall(r'data-(\w+)="([^"]*)"', body))
    assert found["verdicts"].split("|") == CASES[case]
    assert found["across"] == str(width)
    assert int(found["wide"]) <= 0
    assert int(found["drawn"]) >= (5 if case == "no truth" else 13)
    assert found["fetched"] == "0"
    # Every axis has two numbers or more.
    assert found["bare"] == "0"
    assert (found["letters"], found["paper"]) == ("12px", paper)
    # The contents lead somewhere; a table across runs where there are several.
    assert found["dead"] == "0"
    assert found["rows"] == ("4" if case == "three runs" else "0")
    # A click on a name hides its curve wherever it is drawn, and another brings it back.
    assert int(found["hidden"]) >= 1
    assert found["back"] == "0"
    # Pointed at, the path says when the camera was there, how far off it is and what was stated.
    stated = "time s, stated sigma m" if case == "no truth" else "time s, off by m, stated sigma m"
    assert found["along"] == stated
    # The pointer shows the time and what each curve has there; dragging zooms all times together.
    assert int(found["values"]) >= 2
    assert (found["zoomed"], found["unzoomed"]) == ("true", "true")
    # Drawing sets the size of the canvas.
    assert re.search(r'<canvas[^>]* width="\d+"', shown.stdout)
    # The page forbids itself to fetch anything: an attempt would be an error here, as any other would.
    assert "default-src 'none'" in page
    assert "CONSOLE" not in shown.stderr, shown.stderr
