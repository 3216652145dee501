"use strict";
// The path in three dimensions, turned by dragging, keys or buttons.
document.querySelectorAll("div.scene").forEach(box => {
  const canvas = box.querySelector("canvas"), data = JSON.parse(box.querySelector("script").textContent);
  const views = { turn: [-0.6, 0.6], above: [0, Math.PI / 2], side: [0, 0] };
  const path = data.true.length ? data.true : data.est;
  let [yaw, pitch] = views.turn, zoom = 1, held = null;
  const rings = data.ellipsoids.flatMap(e => [[0, 1], [1, 2], [2, 0]].map(([a, b]) =>
    Array.from({ length: 33 }, (_, k) => {
      const t = k * Math.PI / 16;
      return e.at.map((c, j) => c + Math.cos(t) * e.axes[a][j] + Math.sin(t) * e.axes[b][j]);
    })));
  const niceLength = v => { const p = 10 ** Math.floor(Math.log10(v)); return p * [5, 2, 1].find(m => m * p <= v); };

  function draw() {
    const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    canvas.width = w * ratio;
    canvas.height = h * ratio;
    const g = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
    const [ink, grid] = ["--ink", "--grid"].map(name => style.getPropertyValue(name).trim());
    g.scale(ratio, ratio);
    const s = zoom * 0.42 * Math.min(w, h * 1.6) / data.size;
    const place = ([x, y, z]) => {
      const u = x * Math.cos(yaw) - y * Math.sin(yaw), v = x * Math.sin(yaw) + y * Math.cos(yaw);
      return [w / 2 + s * u, h / 2 - s * (z * Math.cos(pitch) + v * Math.sin(pitch))];
    };
    const line = (points, colour, width) => {
      g.beginPath();
      g.strokeStyle = colour;
      g.lineWidth = width;
      points.forEach((p, k) => { const [a, b] = place(p); if (k) g.lineTo(a, b); else g.moveTo(a, b); });
      g.stroke();
    };
    const r = data.size, low = Math.min(...path.map(p => p[2]));
    for (let k = -2; k <= 2; k += 1) {
      line([[k * r / 2, -r, low], [k * r / 2, r, low]], grid, 1);
      line([[-r, k * r / 2, low], [r, k * r / 2, low]], grid, 1);
    }
    rings.forEach(ring => line(ring, "rgba(44, 160, 44, 0.55)", 0.8));
    line(data.true, ink, 1.8);
    line(data.est, "#d62728", 1.4);
    const [a, b] = place(path[0]);
    g.fillStyle = ink;
    g.beginPath();
    g.arc(a, b, 4, 0, 2 * Math.PI);
    g.fill();
    const length = niceLength(0.25 * w / s);
    g.font = "13px system-ui, sans-serif";
    g.fillText(`${length >= 1 ? length : Number(length.toPrecision(1))} m`, 14, h - 20);
    g.fillRect(14, h - 14, length * s, 2);
  }
  const turn = (dyaw, dpitch) => {
    yaw += dyaw;
    pitch = Math.max(0, Math.min(Math.PI / 2, pitch + dpitch));
    draw();
  };
  canvas.addEventListener("pointerdown", e => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { held = null; });
  canvas.addEventListener("pointermove", e => {
    if (!held) return;
    const [x, y] = held;
    held = [e.clientX, e.clientY];
    turn((e.clientX - x) * 0.01, (e.clientY - y) * 0.01);
  });
  // With a plain wheel the page scrolls, as everywhere.
  canvas.addEventListener("wheel", e => {
    if (!e.ctrlKey && !e.metaKey) return;
    e.preventDefault();
    zoom *= Math.exp(-e.deltaY * 0.002);
    draw();
  }, { passive: false });
  canvas.addEventListener("keydown", e => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (step) { e.preventDefault(); turn(...step); }
  });
  box.querySelectorAll("button").forEach(button => button.addEventListener("click", () => {
    if (button.value in views) [yaw, pitch] = views[button.value];
    else zoom *= button.value === "near" ? 1.4 : 1 / 1.4;
    draw();
  }));
  window.addEventListener("resize", draw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
});
