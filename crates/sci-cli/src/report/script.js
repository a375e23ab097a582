"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const page = document.getElementById("page");
page.replaceChildren();

// ---- small helpers -------------------------------------------------------------------------------------------------
const SVG = "http://www.w3.org/2000/svg";
function put(parent, tag, attributes = {}, text) {
  const inSvg = tag === "svg" || parent.namespaceURI === SVG;
  const node = inSvg ? document.createElementNS(SVG, tag) : document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  return parent.appendChild(node);
}
const show = (x, digits, unit = "") => x === null || x === undefined ? "–" : x.toFixed(digits) + unit;
const small = x => x === null || x === undefined ? "–" : x !== 0 && Math.abs(x) < 1e-3 ? x.toExponential(2) : x.toFixed(4);
const words = s => s.replaceAll("_", " ");
function section(title) {
  const s = put(page, "section");
  if (title) put(s, "h2", {}, title);
  return s;
}
function table(parent, head, rows) {
  const t = put(put(parent, "div", { class: "scroll" }), "table");
  const tr = put(put(t, "thead"), "tr");
  head.forEach(h => put(tr, "th", { scope: "col" }, h));
  const body = put(t, "tbody");
  rows.forEach(({ cells, warning }) => {
    const r = put(body, "tr", warning ? { class: "warning" } : {});
    cells.forEach(c => put(r, "td", {}, c));
  });
}

// ---- charts --------------------------------------------------------------------------------------------------------
const W = 480, WIDE = 1060, H = 230, LEFT = 52, RIGHT = 12, TOP = 14, BOTTOM = 36;
const color = i => `var(--s${i % 6})`;
/** About `n` round values that cover [lo, hi]. */
function ticks(lo, hi, n) {
  const raw = (hi - lo) / n || 1, power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find(m => m * power >= raw);
  const out = [];
  for (let v = Math.ceil(lo / step - 1e-9) * step; v <= hi + step * 1e-9; v += step) out.push(+v.toPrecision(12));
  return out;
}
function decades(lo, hi) {
  const out = [], a = Math.floor(lo), b = Math.ceil(hi), step = Math.max(1, Math.ceil((b - a) / 5));
  for (let e = a; e <= b; e += step) out.push(e);
  return out;
}
function frameOf(parent, label, xLabel, width = W) {
  const svg = put(parent, "svg", { viewBox: `0 0 ${width} ${H}`, role: "img", "aria-label": label });
  put(svg, "text", { x: (width + LEFT) / 2, y: H - 4, "text-anchor": "middle" }, xLabel);
  return svg;
}
function axisY(svg, marks, y, text, width = W) {
  marks.forEach(v => {
    put(svg, "line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: y(v), y2: y(v) });
    put(svg, "text", { x: LEFT - 6, y: y(v) + 4, "text-anchor": "end" }, text(v));
  });
}
/** Curves of [{ name, xs, ys }]; a null in ys is a gap. */
function lines(parent, { label, xLabel, series, log }) {
  const f = log ? Math.log10 : v => v;
  const usable = v => v !== null && Number.isFinite(f(v));
  const points = series.flatMap(s => s.ys.map((y, i) => [s.xs[i], y])).filter(([, y]) => usable(y));
  if (!points.length) return;
  const xMax = Math.max(...points.map(p => p[0])) || 1;
  let lo = Math.min(...points.map(p => f(p[1]))), hi = Math.max(...points.map(p => f(p[1])));
  if (hi - lo < 1e-9) { lo -= .5; hi += .5; }
  const marksY = log ? decades(lo, hi) : ticks(lo, hi, 5);
  lo = Math.min(lo, marksY[0]); hi = Math.max(hi, marksY.at(-1));
  const x = v => LEFT + v / xMax * (W - LEFT - RIGHT);
  const y = v => TOP + (hi - v) / (hi - lo) * (H - TOP - BOTTOM);
  const svg = frameOf(parent, label, xLabel);
  axisY(svg, marksY, y, v => log ? (10 ** v).toExponential(0) : `${v}`);
  ticks(0, xMax, 6).forEach(v => put(svg, "text", { x: x(v), y: H - BOTTOM + 16, "text-anchor": "middle" }, `${v}`));
  series.forEach((s, i) => {
    let d = "", pen = "M";
    s.ys.forEach((v, k) => {
      if (!usable(v)) { pen = "M"; return; }
      d += `${pen}${x(s.xs[k]).toFixed(1)} ${y(f(v)).toFixed(1)}`;
      pen = "L";
    });
    const curve = put(svg, "path", { class: "curve", d, style: `stroke:${color(s.color ?? i)}` });
    put(curve, "title", {}, s.name);
  });
}
function bars(parent, values, stride, pick) {
  const known = values.filter(v => v !== null);
  const svg = frameOf(parent, "PSNR of each frame", "frame", WIDE);
  if (!known.length) return [];
  // Bars start below the smallest value: differences between frames are what one looks for; the axis says where.
  const marks = ticks(Math.floor(Math.min(...known) - 1), Math.ceil(Math.max(...known)), 5);
  const lo = marks[0], hi = Math.max(marks.at(-1), ...known), step = (WIDE - LEFT - RIGHT) / values.length;
  const y = v => TOP + (hi - v) / (hi - lo) * (H - TOP - BOTTOM);
  axisY(svg, marks, y, v => `${v}`, WIDE);
  return values.map((v, t) => {
    const at = LEFT + t * step;
    const bar = put(svg, "rect", { class: "bar", x: at + step * .12, width: step * .76, y: v === null ? y(lo) : y(v), height: v === null ? 0 : y(lo) - y(v) });
    put(bar, "title", {}, `frame ${t * stride}: ${show(v, 2, " dB")}`);
    bar.addEventListener("click", () => pick(t));
    put(svg, "text", { x: at + step / 2, y: H - BOTTOM + 16, "text-anchor": "middle" }, `${t * stride}`);
    return bar;
  });
}
const CURVES = [
  { key: "psnr_db", heading: "PSNR (dB)" },
  { key: "relative_residual", heading: "relative residual ‖y − Hx‖ / ‖y‖", log: true },
  { key: "sigma", heading: "σ (of 255)", map: v => 255 * v },
  { key: "predicted_error", heading: "PSNR that the pixels held out predict (dB)", map: v => -10 * Math.log10(v) },
];
/** The trace's curves with a switch between iterations and seconds. */
function convergence(title, series) {
  if (!series.some(s => s.trace.relative_residual.length || s.trace.psnr_db.length)) return () => {};
  const box = section(title);
  const controls = put(box, "div", { class: "controls" });
  const charts = put(box, "div", { class: "charts" });
  const legend = put(box, "div", { class: "legend" });
  let against = "iteration", only = null;
  const draw = () => {
    charts.replaceChildren();
    const shown = series.map((s, color) => ({ ...s, color })).filter((_, i) => only === null || i === only);
    const xs = trace => against === "seconds" ? trace.seconds : trace.relative_residual.map((_, i) => i + 1);
    const xLabel = against;
    for (const { key, heading, log, map = v => v } of CURVES) {
      const values = trace => (trace[key] ?? []).map(v => v === null ? null : map(v));
      if (!shown.some(s => values(s.trace).some(v => v))) continue;
      const cell = put(charts, "div");
      put(cell, "div", { class: "note" }, heading);
      lines(cell, { label: `${heading} against ${xLabel}`, xLabel, log,
        series: shown.map(s => ({ name: s.name, color: s.color, xs: xs(s.trace), ys: values(s.trace) })) });
    }
    legend.replaceChildren();
    shown.forEach(s => {
      const item = put(legend, "span");
      put(item, "i", { style: `background:${color(s.color)}` });
      item.append(s.name);
    });
  };
  const buttons = ["iteration", "seconds"].map(name => {
    const b = put(controls, "button", { type: "button" }, `against ${name}`);
    b.addEventListener("click", () => { against = name; press(); draw(); });
    return [name, b];
  });
  const press = () => buttons.forEach(([name, b]) => b.setAttribute("aria-pressed", String(name === against)));
  press();
  draw();
  return index => { only = index; draw(); };
}

// ---- one run -------------------------------------------------------------------------------------------------------
function facts(parent, list) {
  const dl = put(parent, "dl", { class: "facts" });
  list.forEach(([name, value, long]) => {
    const div = put(dl, "div");
    put(div, "dt", {}, name);
    put(div, "dd", long ? { class: "long" } : {}, value);
  });
}
function head(r) {
  document.title = `${r.experiment} · ${r.scene}`;
  put(page, "h1", {}, r.experiment);
  put(page, "p", { class: "subtitle" }, `${r.scene} · ${r.solver} + ${r.denoiser} · ${r.measurements.length} measurement${r.measurements.length === 1 ? "" : "s"}`);
  const list = [
    ["mean PSNR", show(r.mean.psnr_db, 2, " dB")], ["mean SSIM", show(r.mean.ssim, 4)],
    ["seconds a measurement", show(r.mean.seconds, r.mean.seconds < 10 ? 3 : 1)], ["iterations", show(r.mean.iterations, 1).replace(/\.0$/, "")],
    ["threads", `${r.threads}`], ["seed", `${r.seed}`], ["kernel", [r.kernel, r.precision_used].filter(Boolean).join(" · ") || "–"], ["CPU", r.cpu || "–", true],
    ["sci", [r.version, r.revision].filter(Boolean).join(" · ") || "–", true],
  ];
  if (r.peak_rss_bytes) list.splice(6, 0, ["peak memory", `${Math.round(r.peak_rss_bytes / 2 ** 20)} MiB`]);
  facts(section(), list);
}
/** The RGBA bytes of a picture. */
function pixels(image) {
  const c = document.createElement("canvas");
  c.width = image.naturalWidth; c.height = image.naturalHeight;
  const cx = c.getContext("2d", { willReadFrequently: true });
  cx.drawImage(image, 0, 0);
  return cx.getImageData(0, 0, c.width, c.height).data;
}
/** Fills a canvas of the image's size, `paint(out, i, x, y)` writing red, green and blue of the pixel at byte `i`. */
function draw(canvas, image, paint) {
  const w = canvas.width = image.naturalWidth, h = canvas.height = image.naturalHeight;
  const cx = canvas.getContext("2d"), picture = cx.createImageData(w, h);
  for (let i = 0; i < picture.data.length; i += 4) {
    paint(picture.data, i, i / 4 % w, Math.floor(i / 4 / w));
    picture.data[i + 3] = 255;
  }
  cx.putImageData(picture, 0, 0);
}
/** |result − truth| through a black-red-yellow-white map that saturates at `limit`. */
function drawError(canvas, result, truth, limit) {
  const a = pixels(result), b = pixels(truth);
  draw(canvas, result, (out, i) => {
    const e = (Math.abs(a[i] - b[i]) + Math.abs(a[i + 1] - b[i + 1]) + Math.abs(a[i + 2] - b[i + 2])) / (3 * 255);
    const v = Math.min(1, e / limit) * 3;
    out[i] = 255 * Math.min(1, v);
    out[i + 1] = 255 * Math.min(1, Math.max(0, v - 1));
    out[i + 2] = 255 * Math.min(1, Math.max(0, v - 2));
  });
}
/** What the sensor sees of the result: of each pixel the one color that its filter lets through. */
function drawMosaic(canvas, result, [redRow, redColumn]) {
  const a = pixels(result);
  draw(canvas, result, (out, i, x, y) => {
    const channel = ((y ^ redRow) & 1) + ((x ^ redColumn) & 1);
    out[i] = out[i + 1] = out[i + 2] = a[i + channel];
  });
}
const ERROR_LIMIT = 0.25;
/** What of a measurement's pictures had to be left out so that the page keeps its size. */
function omitted(set) {
  if (!set.recon.length) return `The ${set.frames} frames are left out so that this page keeps its size (output.report_megabytes).`;
  const parts = [];
  if (set.shrink > 1) parts.push(`frames are shown at 1/${set.shrink} of their height and width`);
  if (set.step > 1) parts.push(`of every ${set.step} frames one is shown`);
  return parts.length ? `So that this page keeps its size (output.report_megabytes), ${parts.join(", and ")}.` : "";
}
function viewer(r, images) {
  const box = section("Frames");
  const controls = put(box, "div", { class: "controls" });
  const choice = put(controls, "select", { id: "measurement", "aria-label": "measurement" });
  r.measurements.forEach((m, i) => put(choice, "option", { value: i }, `measurement ${m.index} · ${m.psnr_db === null ? small(m.relative_residual) + " residual" : show(m.psnr_db, 2, " dB")}`));
  const play = put(controls, "button", { type: "button", id: "play", "aria-pressed": "false" }, "play");
  const slider = put(controls, "input", { type: "range", id: "frame", min: 0, value: 0, step: 1, "aria-label": "frame" });
  const readout = put(controls, "output", { id: "readout", for: "frame", "aria-live": "off" });
  const grid = put(box, "div", { class: "images" });
  const figure = (tag, id, caption) => {
    const f = put(grid, "figure");
    const node = put(f, tag, { id, ...(tag === "img" ? { alt: caption } : {}) });
    put(f, "figcaption", {}, caption);
    return [f, node];
  };
  const [measuredBox, measured] = figure("img", "measured", "measurement (one exposure, scaled to its largest value)");
  const [mosaicBox, mosaic] = figure("canvas", "mosaic", "mosaic (the result as the sensor reads it through its color filters)");
  const [, result] = figure("img", "result", "result");
  const [truthBox, truth] = figure("img", "truth", "truth");
  const [errorBox, error] = figure("canvas", "error", `|error|, white from ${ERROR_LIMIT} of full scale`);
  const perFrame = section("PSNR of each frame (dB)");
  const skippedBox = put(box, "p", { class: "note", id: "skipped" });
  const leftOut = put(box, "p", { class: "note", id: "left-out" });
  let barList = [], timer = null;
  const now = () => images[+choice.value];
  const ready = image => image.decode ? image.decode() : Promise.resolve();
  function frame() {
    const set = now(), t = +slider.value;
    if (!set.recon.length) { readout.textContent = "no frames"; return; }
    result.src = set.recon[t];
    result.dataset.frame = t;
    if (set.red_site) ready(result).then(() => { if (+slider.value === t) drawMosaic(mosaic, result, set.red_site); }, () => {});
    if (set.truth) {
      truth.src = set.truth[t];
      Promise.all([ready(result), ready(truth)]).then(() => { if (+slider.value === t) drawError(error, result, truth, ERROR_LIMIT); }, () => {});
    }
    const psnr = set.psnr_db[t];
    readout.textContent = `frame ${t * set.step} of 0–${set.frames - 1}` + (psnr === undefined ? "" : ` · ${show(psnr, 2, " dB")}`);
    barList.forEach((b, k) => b.classList.toggle("now", k === t));
  }
  function measurement() {
    const set = now(), m = r.measurements[+choice.value], s = m.skipped;
    measured.src = set.measurement ?? "data:,";
    measuredBox.hidden = !set.measurement;
    slider.max = Math.max(0, set.recon.length - 1);
    result.parentElement.hidden = !set.recon.length;
    mosaicBox.hidden = !set.red_site || !set.recon.length;
    truthBox.hidden = errorBox.hidden = !set.truth || !set.recon.length;
    perFrame.hidden = !set.psnr_db.length;
    perFrame.querySelectorAll("svg").forEach(n => n.remove());
    leftOut.textContent = omitted(set);
    leftOut.hidden = !leftOut.textContent;
    barList = set.psnr_db.length ? bars(perFrame, set.psnr_db, set.step, t => { slider.value = t; slider.dispatchEvent(new Event("input")); }) : [];
    const parts = [[s.iterations, "iterations"], [s.tiles ? `${(100 * s.tiles).toFixed(1)} %` : 0, "of the denoiser's tiles"], [s.precision ? `${(100 * s.precision).toFixed(0)} %` : 0, "of the networks' work in f32"], [s.updates, "online updates"]].filter(([n]) => n).map(([n, what]) => `${n} ${what}`);
    skippedBox.textContent = `Skipped: ${parts.join(", ") || "nothing"}. Ended: ${words(m.stop)} after ${m.iterations} iterations.`;
    frame();
  }
  slider.addEventListener("input", frame);
  choice.addEventListener("change", measurement);
  const move = by => {
    const n = now().recon.length;
    if (!n) return;
    slider.value = (+slider.value + by + n) % n;
    slider.dispatchEvent(new Event("input"));
  };
  const stop = () => { clearInterval(timer); timer = null; };
  play.addEventListener("click", () => {
    if (timer) stop(); else timer = setInterval(() => move(1), 200);
    play.setAttribute("aria-pressed", String(timer !== null));
    play.textContent = timer ? "pause" : "play";
  });
  document.addEventListener("keydown", e => {
    // Keys that mean something to the browser, or to what has the focus, are theirs.
    if (e.altKey || e.ctrlKey || e.metaKey || e.shiftKey || e.defaultPrevented) return;
    if (e.target instanceof Element && e.target.closest("summary, select, button, input, textarea, a")) return;
    const step = { ArrowLeft: -1, ArrowRight: 1 }[e.key];
    if (!step && e.key !== " ") return;
    e.preventDefault();
    if (step) move(step); else play.click();
  });
  measurement();
  // A link may name the place: report.html#measurement=1&frame=5&play
  const wish = new URLSearchParams(location.hash.slice(1));
  if (wish.has("measurement")) { choice.value = wish.get("measurement"); if (choice.value === "") choice.value = "0"; choice.dispatchEvent(new Event("change")); }
  if (wish.has("frame")) { slider.value = wish.get("frame"); slider.dispatchEvent(new Event("input")); }
  if (wish.has("play")) play.click();
}
/** What networks learned before a solve: how well they predict pixels that trial solves were not given. */
function adaptation(measurements) {
  if (!measurements.length) return;
  table(section("Adaptation"), ["measurement", "updates", "error of hidden pixels", "error of judging pixels", "in use", "seconds"],
    measurements.flatMap(m => {
      const s = m.online.split;
      const row = (updates, hidden, judged, used) => ({ warning: false, cells: [`${m.index}`, updates, small(hidden), judged > 1e300 ? "diverged" : small(judged), used ? "yes" : "", show(s.seconds, 1)] });
      const rows = s.judgements.map(j => row(`${j.updates}`, j.hidden, j.judged, j.updates === s.kept));
      return s.taken_over == null ? rows : [...rows, row("the network after it", undefined, s.taken_over, !s.ends_early)];
    }));
}
/** What was found out about the data, or looked odd. */
function notes(r) {
  const found = (r.calibration?.parameters ?? []).filter(p => p.told_apart);
  if (!r.warnings?.length && !r.calibration && !r.unsolved) return;
  const box = section("The data");
  if (r.unsolved) put(box, "p", { class: "warning" }, `The run was stopped: ${r.unsolved} more of its measurements were to be solved.`);
  if (r.calibration) {
    const { error_before, error_after } = r.calibration;
    const masks = found.map(p => `${p.name} ${p.value.toFixed(4)}`).join(", ") || "as told";
    put(box, "p", {}, `Masks, as they were found to sit: ${masks}. Held-out error ${small(error_before)} before, ${small(error_after)} after.`);
  }
  const list = put(box, "ul");
  (r.warnings ?? []).forEach(w => put(list, "li", {}, w));
}
function run(r, images) {
  head(r);
  notes(r);
  if (images.length) viewer(r, images);
  convergence("Convergence", r.measurements.map(m => ({ name: `measurement ${m.index}`, trace: m.trace })));
  table(section("Measurements"),
    ["measurement", "PSNR dB", "PSNR RGB dB", "SSIM", "SSIM (Gaussian)", "seconds", "iterations", "denoiser calls", "updates", "residual", "ended"],
    r.measurements.map(m => ({ warning: m.stop === "diverged", cells: [`${m.index}`, show(m.psnr_db, 2), show(m.psnr_rgb_db, 2), show(m.ssim, 4), show(m.ssim_gaussian, 4), show(m.seconds, 3), `${m.iterations}`, `${m.denoiser_calls}`, `${m.updates}`, small(m.relative_residual), words(m.stop)] })));
  adaptation(r.measurements.filter(m => m.online?.split));
  const details = put(section(), "details");
  put(details, "summary", {}, "Resolved experiment");
  put(details, "pre", {}, JSON.stringify(r.config, null, 2));
}

// ---- several runs --------------------------------------------------------------------------------------------------
function compare(runs) {
  document.title = `Comparison of ${runs.length} runs`;
  put(page, "h1", {}, document.title);
  put(page, "p", { class: "subtitle" }, "Means over the measurements; curves of each run's first measurement.");
  table(section("Runs"), ["experiment", "scene", "solver", "denoiser", "PSNR dB", "SSIM", "seconds", "iterations", "threads", "CPU", "revision"],
    runs.map(r => ({ warning: r.measurements.some(m => m.stop === "diverged"), cells: [r.experiment, r.scene, r.solver, r.denoiser, show(r.mean.psnr_db, 2), show(r.mean.ssim, 4), show(r.mean.seconds, 3), show(r.mean.iterations, 1), `${r.threads}`, r.cpu, r.revision] })));
  convergence("Convergence", runs.filter(r => r.measurements.length).map(r => ({ name: `${r.experiment} · ${r.scene}`, trace: r.measurements[0].trace })));
}

if (data.images === null) compare(data.runs); else run(data.runs[0], data.images);
