"use strict";
// The curves of a page: drawn as SVG from the JSON beside this script, with hover, zoom, smoothing, a legend.
// A page of a run that is being trained (it has #state) asks its server again and again for what is new.

const COLOURS = 8, LEFT = 52, RIGHT = 16, TOP = 8, BOTTOM = 22, HEIGHT = 220; // pixels
const TIP_ROWS = 12; // series that a tip names
const view = {axis: "decisions", smooth: 0, log: false, each: false, range: null, at: null, hidden: new Set()};
let data = JSON.parse(document.getElementById("data").textContent);
let charts = [];

function make(name, attributes, ...children) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (value !== null) node.setAttribute(key, value);
  }
  node.append(...children);
  return node;
}

function draw(parent, name, attributes, text) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  parent.append(node);
  return node;
}

// --- series

function isShown(value) {
  return value !== null && value !== undefined && (!view.log || value > 0);
}

function pick(x, y, low, high) {
  const kept = {x: [], y: [], low: [], high: []};
  x.forEach((place, row) => {
    if (place === null || !isShown(y[row])) return;
    kept.x.push(place);
    kept.y.push(y[row]);
    kept.low.push(low && isShown(low[row]) ? low[row] : null);
    kept.high.push(high && isShown(high[row]) ? high[row] : null);
  });
  return kept;
}

// An exponential mean without the weight of its beginning, as TensorBoard draws it.
function smoothed(values) {
  let mean = 0, weight = 0;
  return values.map((value) => {
    if (value === null) return null;
    mean = view.smooth * mean + (1 - view.smooth) * value;
    weight = view.smooth * weight + (1 - view.smooth);
    return mean / weight;
  });
}

function seriesOf(metric) {
  const all = [];
  data.groups.forEach((group, number) => {
    if (view.hidden.has(number)) return;
    const runs = data.runs.filter((run) => run.group === number && metric in run.columns);
    const mean = group.curves[metric] && group.curves[metric][view.axis];
    const single = (run) => [run.columns[data.axes[view.axis]], run.columns[metric],
      run.columns[metric + "_low"], run.columns[metric + "_high"]];
    if (mean && mean.x.length) {
      const end = (sign) => mean.mean.map((value, row) =>
        value === null || mean.spread[row] === null ? null : value + sign * mean.spread[row]);
      all.push({label: group.label, number, thin: false, ...pick(mean.x, mean.mean, end(-1), end(1))});
    } else if (runs.length) all.push({label: group.label, number, thin: false, ...pick(...single(runs[0]))});
    if (mean && view.each)
      for (const run of runs)
        all.push({label: run.name, number, thin: true, ...pick(...single(run).slice(0, 2))});
  });
  for (const one of all) {
    one.raw = one.y;
    if (view.smooth > 0) for (const key of ["y", "low", "high"]) one[key] = smoothed(one[key]);
  }
  return all.filter((one) => one.x.length);
}

// --- numbers

function ticks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((factor) => factor * power).find((one) => one >= rough * 0.999);
  const out = [];
  for (let number = Math.ceil(low / step); number * step <= high * (1 + 1e-9) + step * 1e-6; number++)
    out.push(number * step);
  return out;
}

function decades(low, high) {
  const out = [];
  const first = Math.floor(Math.log10(low)), last = Math.ceil(Math.log10(high));
  const every = Math.max(1, Math.ceil((last - first) / 5));
  for (let power = first; power <= last; power += every)
    for (const factor of last - first <= 2 ? [1, 2, 5] : [1]) out.push(factor * 10 ** power);
  return out.filter((value) => value >= low && value <= high);
}

function short(value) {
  const size = Math.abs(value);
  for (const [least, unit, sign] of [[1e9, 1e9, "G"], [1e6, 1e6, "M"], [1e4, 1e3, "k"]])
    if (size >= least * 0.99995) return Number((value / unit).toPrecision(4)) + sign;
  if (size > 0 && size < 1e-3) return value.toExponential(1).replace(".0e", "e");
  return String(Number(value.toPrecision(4))).replace("-", "\u2212");
}

function unitOf(seconds) {
  return seconds >= 7200 ? [3600, " h"] : seconds >= 180 ? [60, " min"] : [1, " s"];
}

function place(value, longest = value) {
  if (view.axis === "decisions") return short(value);
  const [unit, sign] = unitOf(longest);
  return Number((value / unit).toPrecision(3)) + sign;
}

function nearest(x, at) {
  let low = 0, high = x.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (x[middle] < at) low = middle; else high = middle;
  }
  return at - x[low] <= x[high] - at ? low : high;
}

// --- a chart

class Chart {
  constructor(metric) {
    this.metric = metric;
    this.svg = draw(document.createDocumentFragment(), "svg", {role: "img", "aria-label": metric});
    this.tip = make("div", {class: "tip", hidden: ""});
    this.node = make("div", {class: "chart"}, make("h3", {}, metric), this.svg, this.tip);
    this.drag = null;
    this.svg.addEventListener("pointermove", (event) => this.move(event));
    this.svg.addEventListener("pointerdown", (event) => this.press(event));
    this.svg.addEventListener("pointerup", (event) => this.release(event));
    this.svg.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && this.leave());
    this.svg.addEventListener("dblclick", () => zoom(null));
  }

  draw() {
    const width = this.node.clientWidth;
    if (!width || !this.node.closest("details").open) return; // folded away
    this.width = width;
    this.svg.replaceChildren();
    this.svg.setAttribute("viewBox", `0 0 ${width} ${HEIGHT}`);
    this.series = seriesOf(this.metric);
    this.scale();
    if (this.isEmpty) {
      draw(this.svg, "text", {x: width / 2, y: HEIGHT / 2, "text-anchor": "middle"},
        view.log ? "no numbers above 0 here" : "no numbers here");
      return;
    }
    this.drawAxes();
    const clip = `clip-${charts.indexOf(this)}`;
    draw(draw(this.svg, "clipPath", {id: clip}), "rect",
      {x: LEFT, y: 0, width: width - LEFT - RIGHT, height: HEIGHT - BOTTOM + 2});
    const inside = draw(this.svg, "g", {"clip-path": `url(#${clip})`});
    for (const one of this.series) this.drawSeries(inside, one);
    this.over = draw(this.svg, "g", {});
    if (!this.tip.hidden) this.showTip(this.pixel);
  }

  scale() {
    const ends = view.range || extent(this.series.map((one) => one.x));
    const values = [];
    for (const one of this.series)
      one.x.forEach((at, row) => {
        if (at < ends[0] || at > ends[1]) return;
        values.push(one.y[row]);
        if (one.low[row] !== null) values.push(one.low[row]);
        if (one.high[row] !== null) values.push(one.high[row]);
      });
    this.isEmpty = values.length === 0;
    if (this.isEmpty) {
      this.tip.hidden = true;
      return;
    }
    let [low, high] = extent([values]);
    if (view.log) [low, high] = low === high ? [low / 2, high * 2] : [low / 1.05, high * 1.05];
    else {
      // a constant has no span, or one of rounding
      const isFlat = high - low <= 1e-6 * Math.max(Math.abs(low), Math.abs(high));
      const margin = isFlat ? Math.abs(high) * 0.05 || 1 : (high - low) * 0.05;
      [low, high] = [low - margin, high + margin];
    }
    this.xs = ends[0] === ends[1] ? [ends[0] - 1, ends[1] + 1] : ends;
    this.ys = [low, high];
  }

  x(value) {
    return LEFT + (value - this.xs[0]) / (this.xs[1] - this.xs[0]) * (this.width - LEFT - RIGHT);
  }

  y(value) {
    const by = view.log ? Math.log : (number) => number;
    const share = (by(value) - by(this.ys[0])) / (by(this.ys[1]) - by(this.ys[0]));
    return HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM);
  }

  value(pixel) {
    return this.xs[0] + (pixel - LEFT) / (this.width - LEFT - RIGHT) * (this.xs[1] - this.xs[0]);
  }

  drawAxes() {
    for (const value of view.log ? decades(...this.ys) : ticks(...this.ys, 5)) {
      const y = this.y(value).toFixed(1);
      draw(this.svg, "line", {class: "grid", x1: LEFT, x2: this.width - RIGHT, y1: y, y2: y});
      draw(this.svg, "text", {x: LEFT - 6, y: Number(y) + 4, "text-anchor": "end"}, short(value));
    }
    const unit = view.axis === "time" ? unitOf(this.xs[1])[0] : 1;
    for (const value of ticks(this.xs[0] / unit, this.xs[1] / unit, this.width < 420 ? 4 : 6)) {
      const x = this.x(value * unit);
      if (x < LEFT - 1 || x > this.width - RIGHT + 1) continue;
      const anchor = x > this.width - 20 ? "end" : "middle";
      draw(this.svg, "text", {x: x.toFixed(1), y: HEIGHT - 6, "text-anchor": anchor}, place(value * unit, this.xs[1]));
    }
  }

  drawSeries(parent, one) {
    const group = draw(parent, "g", {class: `c${one.number % COLOURS}`});
    const line = (values) => one.x.map((at, row) => `${this.x(at).toFixed(1)},${this.y(values[row]).toFixed(1)}`);
    const rows = one.low.map((low, row) => row).filter((row) => one.low[row] !== null && one.high[row] !== null);
    if (!one.thin && rows.length > 1) {
      const end = (row, values) => `${this.x(one.x[row]).toFixed(1)},${this.y(values[row]).toFixed(1)}`;
      const points = [...rows.map((row) => end(row, one.high)), ...rows.reverse().map((row) => end(row, one.low))];
      draw(group, "polygon", {class: "band", points: points.join(" ")});
    }
    if (view.smooth > 0 && !one.thin) draw(group, "polyline", {class: "raw", points: line(one.raw).join(" ")});
    // beyond the eighth series colours come again, dashed
    const dash = one.number >= COLOURS ? {"stroke-dasharray": "6 3"} : {};
    draw(group, "polyline", {class: one.thin ? "raw" : "line", points: line(one.y).join(" "), ...dash});
    if (one.x.length === 1) draw(group, "circle", {class: "dot", cx: this.x(one.x[0]), cy: this.y(one.y[0]), r: 3});
  }

  move(event) {
    if (this.isEmpty || !this.over) return;
    const pixel = Math.min(Math.max(event.clientX - this.svg.getBoundingClientRect().left, LEFT), this.width - RIGHT);
    this.over.replaceChildren();
    if (this.drag !== null) {
      const [low, high] = [Math.min(pixel, this.drag), Math.max(pixel, this.drag)];
      draw(this.over, "rect", {class: "box", x: low, y: TOP, width: high - low, height: HEIGHT - TOP - BOTTOM});
    }
    this.showTip(pixel);
  }

  showTip(pixel) {
    this.pixel = pixel;
    view.at = this.value(pixel);
    draw(this.over, "line", {class: "cursor", x1: pixel, x2: pixel, y1: TOP, y2: HEIGHT - BOTTOM});
    const rows = [];
    let at = view.at;
    for (const one of this.series) {
      const row = nearest(one.x, view.at);
      // the curve may have ended before this place
      if (Math.abs(this.x(one.x[row]) - pixel) > Math.max(30, (this.width - LEFT) / one.x.length)) continue;
      if (!rows.length) at = one.x[row];
      const colour = `c${one.number % COLOURS}`;
      draw(draw(this.over, "g", {class: colour}), "circle",
        {class: "dot", cx: this.x(one.x[row]), cy: this.y(one.y[row]), r: 3.5});
      const spread = one.high[row] !== null && !one.thin
        ? ` (${short(one.low[row])} to ${short(one.high[row])})` : "";
      rows.push(make("div", {}, make("span", {class: colour}, one.label),
        make("b", {}, short(one.y[row]) + spread)));
    }
    const more = rows.length > TIP_ROWS ? [make("div", {}, `and ${rows.length - TIP_ROWS} more`)] : [];
    const where = view.axis === "time" ? place(at) : `${Math.round(at).toLocaleString("en")} decisions`;
    this.tip.replaceChildren(make("div", {}, where), ...rows.slice(0, TIP_ROWS), ...more);
    this.tip.hidden = false;
    const left = pixel + 12 + this.tip.offsetWidth > this.width ? pixel - 12 - this.tip.offsetWidth : pixel + 12;
    this.tip.style.left = `${Math.max(0, left)}px`;
    this.tip.style.top = "2.2rem";
  }

  press(event) {
    // a finger reads values, which stay when it is lifted, or scrolls; it zooms by the buttons
    for (const other of charts) if (other !== this) other.leave();
    if (event.pointerType !== "mouse") this.move(event);
    if (event.pointerType !== "mouse" || event.button !== 0 || this.isEmpty) return;
    this.drag = event.clientX - this.svg.getBoundingClientRect().left;
    this.svg.setPointerCapture(event.pointerId);
  }

  release(event) {
    if (this.drag === null) return;
    const ends = [this.drag, event.clientX - this.svg.getBoundingClientRect().left].sort((a, b) => a - b);
    this.drag = null;
    if (ends[1] - ends[0] > 8)
      zoom([Math.max(this.xs[0], this.value(ends[0])), Math.min(this.xs[1], this.value(ends[1]))]);
  }

  leave() {
    this.tip.hidden = true;
    if (this.over && this.drag === null) this.over.replaceChildren();
  }
}

function extent(lists) {
  let low = Infinity, high = -Infinity;
  for (const list of lists)
    for (const value of list) {
      if (value < low) low = value;
      if (value > high) high = value;
    }
  return [low, high];
}

// --- the page

function redraw() {
  for (const chart of charts) chart.draw();
}

function zoom(range) {
  view.range = range;
  redraw();
}

function zoomBy(factor) {
  const whole = extent(data.runs.map((run) => run.columns[data.axes[view.axis]].filter((value) => value !== null)));
  const [low, high] = view.range || whole, half = (high - low) / 2 * factor;
  const middle = view.at !== null && view.at >= low && view.at <= high ? view.at : (low + high) / 2;
  const ends = [Math.max(whole[0], middle - half), Math.min(whole[1], middle + half)];
  zoom(ends[0] <= whole[0] && ends[1] >= whole[1] ? null : ends);
}

function legend() {
  return data.groups.map((group, number) => {
    const count = data.runs.filter((run) => run.group === number).length;
    const label = count > 1 ? `${group.label} (${count} runs)` : group.label;
    const button = make("button", {type: "button", "aria-pressed": String(!view.hidden.has(number)), onclick: () => {
      if (!view.hidden.delete(number)) view.hidden.add(number);
      button.setAttribute("aria-pressed", String(!view.hidden.has(number)));
      redraw();
    }}, make("i", {class: `c${number % COLOURS}`}), label);
    return button;
  });
}

function tools() {
  const change = (key, read) => (event) => { view[key] = read(event.target); redraw(); };
  const axis = make("select", {id: "axis", onchange: (event) => {
    view.axis = event.target.value;
    view.range = view.at = null;
    redraw();
  }}, make("option", {value: "decisions"}, "decisions"), make("option", {value: "time"}, "time"));
  axis.value = view.axis;
  const box = (key, text) => {
    const input = make("input", {type: "checkbox", id: key, onchange: change(key, (node) => node.checked)});
    input.checked = view[key];
    return make("label", {}, input, text);
  };
  const smooth = make("input", {type: "range", id: "smooth", min: 0, max: 0.98, step: 0.02, value: view.smooth,
    oninput: change("smooth", (node) => Number(node.value))});
  const button = (name, text, action) =>
    make("button", {type: "button", id: name, "aria-label": text, title: text, onclick: action},
      {"zoom-in": "+", "zoom-out": "−", "zoom-reset": "all"}[name]);
  const several = data.groups.some((group) => Object.keys(group.curves).length);
  return make("div", {class: "tools"}, make("label", {}, "over", axis), make("label", {}, "smooth", smooth),
    box("log", "log"), ...(several ? [box("each", "each run")] : []),
    make("span", {}, button("zoom-in", "zoom in", () => zoomBy(0.5)), " ",
      button("zoom-out", "zoom out", () => zoomBy(2)), " ", button("zoom-reset", "whole axis", () => zoom(null))),
    data.groups.length > 1 ? make("div", {class: "legend"}, ...legend()) : "");
}

function build() {
  const home = document.getElementById("curves");
  const open = new Set([...home.querySelectorAll("details[open]")].map((node) => node.dataset.name));
  const isFirst = !home.querySelector("details");
  home.querySelectorAll(".tools, details, .hint").forEach((node) => node.remove());
  charts = [];
  home.append(tools(), make("p", {class: "hint"}, "Drag over a chart, or + and −, to zoom; a double click shows " +
    "the whole axis again." + (data.groups.some((group) => Object.keys(group.curves).length)
      ? " Lines are means over runs that differ only in their seed, bands one standard deviation." : "")));
  data.charts.forEach(([name, metrics], number) => {
    const own = metrics.map((metric) => new Chart(metric));
    charts.push(...own);
    const isOpen = isFirst ? ["Episodes", "Lessons", "Matches and self-play"].includes(name) || number === 0
      : open.has(name);
    home.append(make("details", {"data-name": name, open: isOpen ? "" : null, ontoggle: redraw},
      make("summary", {}, name + " ", make("small", {}, metrics.length)),
      make("div", {class: "charts"}, ...own.map((chart) => chart.node))));
  });
  redraw();
}

function show(answer) {
  const shape = (from) => from && JSON.stringify([from.charts, from.groups.map((group) => group.label)]);
  const isSame = shape(data) === shape(answer.data);
  data = answer.data;
  for (const [name, text] of Object.entries(answer.sections)) {
    const section = document.getElementById(name), home = section.querySelector("div");
    if (home.innerHTML !== text) home.innerHTML = text;
    section.hidden = !text;
  }
  if (isSame) redraw(); else build();
}

async function follow(state) {
  let wait = 3, failures = 0;
  while (failures < 3) {
    try {
      const answer = await (await fetch("data.json", {cache: "no-store"})).json();
      failures = 0;
      wait = answer.refresh_s;
      if (answer.data) show(answer);
      state.className = "alive";
      state.textContent = answer.data ? `training, every ${wait.toFixed(0)} s what is new` : answer.message;
    } catch {
      failures += 1;
    }
    await new Promise((done) => setTimeout(done, 1000 * wait));
  }
  state.className = "";
  state.textContent = "The run has ended, or was ended: what it showed last. mappo-report writes a page to keep.";
}

const state = document.getElementById("state");
if (data) build();
if (state) follow(state);
new ResizeObserver(redraw).observe(document.body);
