"use strict";
// Panels drawn as SVG to the width that there is, so that letters stay readable on a phone and on paper.
(() => {
  const NS = "http://www.w3.org/2000/svg";
  const finite = v => v !== null && Number.isFinite(v);
  const make = (parent, name, attributes, text) => {
    const node = document.createElementNS(NS, name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (text !== undefined) node.textContent = text;
    return parent.appendChild(node);
  };
  const extent = (panel, key, log) => {
    const all = panel.lines.filter(l => !l.aside && !hidden.has(l.name)).flatMap(l => l[key]).filter(v => finite(v) && (!log || v > 0));
    if (key === "y" && finite(panel.level) && (!log || panel.level > 0)) all.push(panel.level);
    let low = all.reduce((a, b) => Math.min(a, b), Infinity), high = all.reduce((a, b) => Math.max(a, b), -Infinity);
    if (!(low <= high)) [low, high] = log ? [0.1, 10] : [0, 1];
    if (log) {
      // So wide that two numbers of the series 1, 2, 5 lie within: one alone shows no scale.
      const slack = Math.max(1.2, Math.sqrt(5.1 * low / high));
      return [low / slack, high * slack];
    }
    const pad = (high - low || Math.abs(high) || 1) * (key === "x" && !panel.equal ? 0.01 : 0.06);
    return [low - pad, high + pad];
  };
  const ticks = (low, high, log, count) => {
    if (log) {
      const out = [];
      for (let p = Math.ceil(Math.log10(low)); p <= Math.log10(high); p += 1) out.push(10 ** p);
      if (out.length >= 2) return out.filter((_, i) => i % Math.ceil(out.length / (count + 1)) === 0);
      return [1, 2, 5].flatMap(m => [-12, -11, -10, -9, -8, -7, -6, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, 5, 6].map(
        p => m * 10 ** p)).filter(v => v >= low && v <= high).sort((a, b) => a - b);
    }
    const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find(m => m * power >= 0.8 * rough), out = [];
    for (let k = Math.ceil(low / step); k * step <= high + 1e-9 * step; k += 1) out.push(k * step);
    return out.length < 2 && count < 50 ? ticks(low, high, log, 2 * count) : out; // one alone shows no scale
  };
  const label = v => v === 0 ? "0" : Math.abs(v) >= 1e4 || Math.abs(v) < 1e-3 ? v.toExponential(0).replace("e+", "e")
    : String(Number(v.toPrecision(4)));

  // Black lines are drawn in the page's ink, so that they show on a dark page too.
  const ink = colour => colour === "#1b1b1b" ? "var(--ink)" : colour;
  const timed = panel => panel.x.startsWith("time");
  const hidden = new Set();
  let span = null;

  function draw(figure, panel, index, fixed) {
    const width = fixed || Math.max(260, figure.clientWidth), square = panel.equal;
    const left = 58, right = 10, top = 8, bottom = 40;
    const [logX, logY] = [(panel.log || "").includes("x"), (panel.log || "").includes("y")];
    let [x0, x1] = extent(panel, "x", logX), [y0, y1] = panel.limit || extent(panel, "y", logY);
    if (span && timed(panel)) [x0, x1] = span;
    const inner = width - left - right;
    let height = Math.round(Math.min(280, Math.max(170, width * 0.42)));
    if (square) {
      // One metre is as long upwards as sideways; a flat path still gets a little air.
      const tall = inner * (y1 - y0) / (x1 - x0), room = Math.min(460, Math.max(90, tall));
      height = room + top + bottom;
      const grow = Math.max((y1 - y0) / room, (x1 - x0) / inner);
      [x0, x1] = [(x0 + x1 - grow * inner) / 2, (x0 + x1 + grow * inner) / 2];
      [y0, y1] = [(y0 + y1 - grow * room) / 2, (y0 + y1 + grow * room) / 2];
    }
    const scale = (low, high, log, a, b) => log
      ? v => v > 0 ? a + (b - a) * Math.log(v / low) / Math.log(high / low) : NaN
      : v => a + (b - a) * (v - low) / (high - low);
    const X = scale(x0, x1, logX, left, width - right), Y = scale(y0, y1, logY, height - bottom, top);
    figure.replaceChildren();
    const svg = make(figure, "svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${panel.y} over ${panel.x}`,
      ...(timed(panel) ? { class: "timed" } : {}) });
    const clip = `clip-${index}`;
    make(make(svg, "clipPath", { id: clip }), "rect", { x: left, y: top, width: inner, height: height - top - bottom });
    for (const v of ticks(x0, x1, logX, Math.max(4, inner / 70))) {
      make(svg, "line", { x1: X(v), x2: X(v), y1: top, y2: height - bottom, class: "grid" });
      make(svg, "text", { x: X(v), y: height - bottom + 15, "text-anchor": "middle" }, label(v));
    }
    for (const v of ticks(y0, y1, logY, Math.max(3, height / 45))) {
      make(svg, "line", { x1: left, x2: width - right, y1: Y(v), y2: Y(v), class: "grid" });
      make(svg, "text", { x: left - 6, y: Y(v) + 4, "text-anchor": "end" }, label(v));
    }
    const inside = make(svg, "g", { "clip-path": `url(#${clip})` });
    for (const s of panel.shades || []) {
      make(inside, "rect", { x: X(s.from), width: Math.max(1, X(s.to) - X(s.from)), y: top, height: height - top - bottom,
        fill: s.colour, opacity: 0.3 });
    }
    // A bound of none is drawn as far as the frame, not as nothing.
    const within = v => Math.min(Math.max(v, top - 5), height - bottom + 5);
    for (const band of panel.bands || []) {
      const at = band.x.map((_, i) => i).filter(i => finite(band.low[i]) && finite(band.high[i]));
      const edge = (i, side) => `${X(band.x[i]).toFixed(1)},${within(Y(band[side][i])).toFixed(1)}`;
      make(inside, "polygon", { fill: band.colour, opacity: 0.2,
        points: [...at.map(i => edge(i, "high")), ...at.reverse().map(i => edge(i, "low"))].join(" ") });
    }
    if (finite(panel.level)) {
      make(inside, "line", { x1: left, x2: width - right, y1: Y(panel.level), y2: Y(panel.level), class: "level" });
    }
    for (const l of panel.lines.filter(l => !hidden.has(l.name))) {
      let path = "", pen = false;
      l.x.forEach((x, i) => {
        const seen = finite(x) && finite(l.y[i]) && Number.isFinite(X(x)) && Number.isFinite(Y(l.y[i]));
        if (seen) path += `${pen ? "L" : "M"}${X(x).toFixed(1)} ${Y(l.y[i]).toFixed(1)}`;
        pen = seen;
      });
      make(inside, "path", { d: path, fill: "none", stroke: ink(l.colour), "stroke-width": l.width,
        "stroke-linejoin": "round", ...(l.dash ? { "stroke-dasharray": "5 4" } : {}) });
    }
    make(svg, "rect", { x: left, y: top, width: inner, height: height - top - bottom, class: "frame" });
    make(svg, "text", { x: left + inner / 2, y: height - 6, "text-anchor": "middle" }, panel.x);
    const middle = top + (height - top - bottom) / 2;
    make(svg, "text", { x: 12, y: middle, "text-anchor": "middle", transform: `rotate(-90 12 ${middle})` }, panel.y);
    const back = u => logX ? x0 * (x1 / x0) ** ((u - left) / inner) : x0 + (x1 - x0) * (u - left) / inner;
    listen(figure, svg, { X, Y, back, left, right: width - right, top, bottom: height - bottom, width }, panel);
    const named = panel.lines.filter(l => l.name);
    if (named.length === 0) return;
    const key = figure.appendChild(document.createElement("figcaption"));
    for (const l of named) {
      const entry = key.appendChild(document.createElement("button"));
      entry.textContent = l.name;
      entry.style.setProperty("--tint", ink(l.colour));
      entry.setAttribute("aria-pressed", String(!hidden.has(l.name)));
      entry.addEventListener("click", () => {
        if (!hidden.delete(l.name)) hidden.add(l.name);
        drawAll();
      });
    }
  }

  // What the curves say at the pointer, and a stretch of time chosen by dragging.
  function listen(figure, svg, frame, panel) {
    const { X, Y, back, left, right, top, bottom, width } = frame;
    const place = event => {
      const box = svg.getBoundingClientRect(), unit = width / box.width;
      return [(event.clientX - box.left) * unit, (event.clientY - box.top) * unit];
    };
    const at = event => place(event)[0];
    const label = figure.appendChild(document.createElement("div"));
    label.className = "values";
    label.hidden = true;
    const pointer = make(svg, "line", { y1: top, y2: bottom, class: "pointer", visibility: "hidden" });
    const choice = make(svg, "rect", { y: top, height: bottom - top, width: 0, class: "zoom" });
    const aside = u => label.classList.toggle("left", u > (left + right) / 2);
    let from = null;
    if (panel.along) {
      const { x, y, told } = panel.along, dot = make(svg, "circle", { r: 4, class: "here", visibility: "hidden" });
      svg.addEventListener("pointermove", event => {
        const [u, v] = place(event), away = i => Math.hypot(X(x[i]) - u, Y(y[i]) - v);
        const k = x.reduce((best, _, i) => away(i) < away(best) ? i : best, 0);
        const short = name => name.replace(/ \[(.*)\]/, "");
        label.textContent = Object.entries(told).filter(([, values]) => finite(values[k])).map(([name, values]) =>
          `${short(name)} ${Number(values[k].toPrecision(3))} ${name.match(/\[(.*)\]/)[1]}`).join("\n");
        aside(u);
        dot.setAttribute("cx", X(x[k]));
        dot.setAttribute("cy", Y(y[k]));
        label.hidden = false;
        dot.setAttribute("visibility", "visible");
      });
      svg.addEventListener("pointerleave", () => { label.hidden = true; dot.setAttribute("visibility", "hidden"); });
      return;
    }
    svg.addEventListener("pointermove", event => {
      const u = Math.min(Math.max(at(event), left), right), x = back(u);
      if (from !== null) {
        choice.setAttribute("x", Math.min(u, from));
        choice.setAttribute("width", Math.abs(u - from));
      }
      const rows = panel.lines.filter(l => !l.aside && !l.dash && !hidden.has(l.name) && l.x.length).map(l => {
        const k = l.x.reduce((best, v, i) => finite(v) && Math.abs(v - x) < Math.abs(l.x[best] - x) ? i : best, 0);
        return finite(l.y[k]) ? `${l.name || panel.y.replace(/ \[.*/, "")} ${Number(l.y[k].toPrecision(3))}` : null;
      }).filter(Boolean);
      label.textContent = [`${panel.x.replace(/ \[.*/, "")} ${Number(x.toPrecision(4))}`, ...rows].join("\n");
      label.hidden = rows.length === 0;
      aside(u);
      pointer.setAttribute("x1", X(x));
      pointer.setAttribute("x2", X(x));
      pointer.setAttribute("visibility", label.hidden ? "hidden" : "visible");
    });
    svg.addEventListener("pointerleave", () => {
      label.hidden = true;
      pointer.setAttribute("visibility", "hidden");
    });
    if (!timed(panel)) return;
    svg.addEventListener("pointerdown", event => { if (event.pointerType === "mouse") from = at(event); });
    svg.addEventListener("pointerup", event => {
      const [a, b] = [from, at(event)].sort((p, q) => p - q);
      if (from !== null && b - a > 8) {
        span = [back(Math.max(a, left)), back(Math.min(b, right))];
        drawAll();
      }
      from = null;
    });
    svg.addEventListener("dblclick", () => { span = null; drawAll(); });
  }

  const figures = [...document.querySelectorAll("figure.panel")];
  const data = figures.map(f => JSON.parse(f.querySelector("script").textContent));
  let drawn = 0;
  const drawAll = fixed => { drawn = window.innerWidth; figures.forEach((f, i) => draw(f, data[i], i, fixed)); };
  window.addEventListener("resize", () => { if (window.innerWidth !== drawn) drawAll(); });
  // Two panels stand side by side on paper, each this wide.
  window.addEventListener("beforeprint", () => drawAll(340));
  window.addEventListener("afterprint", () => drawAll());
  drawAll();
})();
