// Charts over time: a labelled figure whose window is asked of the server, with a cursor by arrow keys, a spoken
// reading and a table of what is seen; and a plot of single results over dates.
import { ask, make, drawn } from "./main.mjs";
const digits = (value) => (value === null || value === undefined || Number.isNaN(value) ? "–" : String(Number(value.toPrecision(4))).replace("-", "−"));
const seconds = (t) => `${Number(t.toFixed(4))} s`;
function keyOf(name, tone, dash) {
  const sample = make("i");
  sample.style.borderTopColor = colour(tone);
  if (dash) sample.style.borderTopStyle = dash === "dot" ? "dotted" : "dashed";
  return make("span", { class: "key" }, sample, make("span", { text: name }));
}
export const tableOf = (heads, rows) => make("table", {}, make("thead", {}, make("tr", {}, ...heads.map((text) => make("th", { scope: "col", text })))), make("tbody", {}, ...rows.map((row) => make("tr", {}, ...row.map((text) => make("td", { text }))))));
// the head of a table once it is filled, or as soon as the page shows something else
export async function settled(query, isWanted) {
  for (;;) {
    const head = await ask("window", { ...query, columns: "", pixels: 10 });
    if (head.complete || head.error || !isWanted()) return head;
    await new Promise((later) => setTimeout(later, 300));
  }
}
// charts whose time axes move together
export class Linked {
  constructor(span) { Object.assign(this, { charts: [], begin: null, end: null, first: 0, last: 1, waiting: 0 }, span); }
  move(begin, end) {
    const shortest = Math.max(1e-6, (this.last - this.first) * 1e-9);
    const length = Math.min(Math.max(end - begin, shortest), this.last - this.first);
    this.begin = Math.min(Math.max(begin, this.first), this.last - length);
    this.end = this.begin + length;
    for (const chart of this.charts) chart.place(this.begin, this.end);
    clearTimeout(this.waiting);
    this.waiting = setTimeout(() => this.charts.forEach((chart) => chart.load()), 60);
  }
  whole() { this.move(this.first, this.last); }
  zoom(factor, at = (this.begin + this.end) / 2) { this.move(at - (at - this.begin) * factor, at + (this.end - at) * factor); }
  pan(share) { const step = share * (this.end - this.begin); this.move(this.begin + step, this.end + step); }
  close() { for (const chart of this.charts.splice(0)) chart.close(); }
}
// options: title, unit, lines [{name, colour, column, dash}], fetch(begin, end, pixels), marks [{t, label}],
// shades [[begin, end, weight]], level {value, label}, height
export class Trace {
  constructor(place, link, options) {
    Object.assign(this, { link, options, data: null, plot: null, cursor: null });
    link.charts.push(this);
    this.key = make("span", { class: "keys" });
    const tool = (text, label, work) => make("button", { type: "button", text, "aria-label": `${label}: ${options.title}`, title: label, onclick: work });
    this.tools = make("span", { class: "tools" },
      tool("◀", "earlier", () => link.pan(-0.5)), tool("▶", "later", () => link.pan(0.5)),
      tool("+", "closer", () => link.zoom(0.5)), tool("−", "farther", () => link.zoom(2)), tool("whole", "whole recording", () => link.whole()));
    const help = "Left and right arrow move the cursor, with Shift the window, plus and minus zoom, 0 shows the whole.";
    this.box = make("div", { class: "plot", tabindex: "0", role: "group", "aria-roledescription": "chart", "aria-label": `${options.title}, ${options.unit}. ${help}` });
    this.reading = make("p", { class: "reading", role: "status", "aria-live": "polite" });
    this.table = make("details", {}, make("summary", { text: "Table of what is seen" }), make("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": `Table: ${options.title}` }));
    this.table.addEventListener("toggle", () => this.fillTable());
    this.figure = make("figure", { class: "trace" }, make("figcaption", {}, make("span", { text: options.title }), this.key, this.tools), this.box, make("div", { class: "under" }, this.reading, this.table));
    place.append(this.figure);
    this.box.addEventListener("keydown", (event) => this.press(event));
    this.watcher = new ResizeObserver(() => this.resize());
    this.watcher.observe(this.box);
    this.ready = this.load();
  }
  get width() { return Math.max(240, this.box.clientWidth || 240); }
  async load() {
    const asked = (this.asked = Symbol());
    let data;
    try {
      data = await this.options.fetch(this.link.begin, this.link.end, Math.round(this.width));
    } catch (error) { this.reading.textContent = error.message; return; }
    if (asked !== this.asked) return;
    if (data.error && !data.t.length) { this.reading.textContent = data.error; return; }
    this.data = data;
    if (!this.options.lines.length) return;
    this.link.first = Math.min(data.first, this.link.begin === null ? data.first : this.link.first);
    this.link.last = Math.max(data.last, this.link.begin === null ? data.last : this.link.last);
    const following = this.link.begin === null || this.partial;
    this.partial = data.complete === false;
    if (following && !this.partial) Object.assign(this.link, { begin: data.first, end: data.last });
    if (following && this.partial) Object.assign(this.link, { begin: data.first, end: data.last, last: data.last });
    this.draw();
    if (this.partial) { this.reading.textContent = `reading: ${data.count} rows so far`; this.again = setTimeout(() => this.load(), 300); }
  }
  draw() {
    const { options, data, link } = this;
    const rows = [data.t, ...options.lines.map((line) => data.lines[line.column])];
    const tone = colour("--ink");
    if (this.plot && this.tone === tone) {
      this.plot.setData(rows, false);
      this.place(link.begin, link.end);
    } else {
      if (this.plot) this.plot.destroy();
      this.tone = tone;
      const grid = { stroke: colour("--line"), width: 1 };
      const axis = { stroke: colour("--quiet"), grid, ticks: grid, font: "12px system-ui" };
      this.plot = new uPlot(
        {
          width: this.width,
          height: options.height || 190,
          legend: { show: false },
          scales: { x: { time: false, range: () => [link.begin, link.end] }, y: { range: (plot, low, high) => (low === null ? [0, 1] : uPlot.rangeNum(low, high, 0.06, true)) } },
          axes: [{ ...axis, size: 28, values: (plot, at) => at.map(seconds) }, { ...axis, size: 54, space: 26, label: options.unit, labelSize: 18, labelFont: "12px system-ui", values: (plot, at) => at.map(digits) }],
          series: [{}, ...options.lines.map((line) => ({ label: line.name, stroke: colour(line.colour), width: line.width || 1.2, dash: line.dash, spanGaps: false, points: { show: false } }))],
          cursor: { sync: { key: "evidence", scales: ["x", null] }, drag: { x: true, y: false, setScale: false } },
          hooks: {
            drawClear: [(plot) => this.shade(plot)],
            draw: [(plot) => this.markOver(plot)],
            setCursor: [(plot) => this.read(plot.cursor.idx)],
            setSelect: [(plot) => {
              if (plot.select.width < 4) return;
              const [begin, end] = [plot.select.left, plot.select.left + plot.select.width].map((x) => plot.posToVal(x, "x"));
              plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
              link.move(begin, end);
            }],
          },
        },
        rows,
        this.box,
      );
      this.key.replaceChildren(...options.lines.map((line) => keyOf(line.name, line.colour, line.dash)));
    }
    this.fillTable();
  }
  place(begin, end) { if (this.plot) this.plot.setScale("x", { min: begin, max: end }); }
  shade(plot) {
    const { left, top, width, height } = plot.bbox;
    const context = plot.ctx;
    context.save();
    context.beginPath();
    context.rect(left, top, width, height);
    context.clip();
    context.fillStyle = colour("--total");
    const most = Math.max(...(this.options.shades || []).map((shade) => shade[2]), 1e-12);
    for (const [begin, end, weight] of this.options.shades || []) {
      context.globalAlpha = 0.22 * (weight / most) ** 2;
      const x = plot.valToPos(begin, "x", true);
      context.fillRect(x, top, Math.max(1, plot.valToPos(end, "x", true) - x), height);
    }
    context.restore();
  }
  markOver(plot) {
    const { left, top, width, height } = plot.bbox;
    const context = plot.ctx;
    context.save();
    context.strokeStyle = context.fillStyle = colour("--leak");
    context.lineWidth = 1.5 * devicePixelRatio;
    context.font = `${11 * devicePixelRatio}px system-ui`;
    (this.options.marks || []).forEach((mark, k) => {
      const x = plot.valToPos(mark.t, "x", true);
      if (!(x >= left && x <= left + width)) return;
      context.setLineDash([5, 4]);
      context.beginPath();
      context.moveTo(x, top);
      context.lineTo(x, top + height);
      context.stroke();
      const wide = x + 4 + context.measureText(mark.label).width > left + width;
      context.textAlign = wide ? "right" : "left";
      context.fillText(mark.label, x + (wide ? -4 : 4), top + (12 + 13 * (k % 5)) * devicePixelRatio);
    });
    const level = this.options.level;
    if (level) {
      const y = plot.valToPos(level.value, "y", true);
      if (y >= top && y <= top + height) {
        context.setLineDash([9, 5]);
        context.beginPath();
        context.moveTo(left, y);
        context.lineTo(left + width, y);
        context.stroke();
        context.textAlign = "right";
        context.fillText(level.label, left + width - 4, y - 4);
      }
    }
    context.restore();
  }
  read(index) {
    if (index === null || index === undefined || !this.data) return;
    this.cursor = index;
    const values = this.options.lines.map((line) => `${line.name} ${digits(this.data.lines[line.column][index])}`);
    this.reading.textContent = `${seconds(this.data.t[index])}: ${values.join(", ")} ${this.options.unit}`;
  }
  press(event) {
    if (!this.plot || !this.data) return;
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (step && event.shiftKey) this.link.pan(0.25 * step);
    else if (step) {
      const t = this.data.t;
      const inside = (index) => t[index] >= this.link.begin && t[index] <= this.link.end;
      let index = (this.cursor ?? (step > 0 ? -1 : t.length)) + step * (event.ctrlKey ? 20 : 1);
      if (!inside(index)) index = step > 0 ? t.findIndex((value) => value >= this.link.begin) : t.findLastIndex((value) => value <= this.link.end);
      if (index < 0) return;
      this.plot.setCursor({ left: this.plot.valToPos(t[index], "x"), top: 20 });
      this.read(index);
    } else if (event.key === "+" || event.key === "=") this.link.zoom(0.5, this.at());
    else if (event.key === "-") this.link.zoom(2, this.at());
    else if (event.key === "0" || event.key === "Home") this.link.whole();
    else return;
    event.preventDefault();
  }
  at() { const t = this.cursor === null ? null : this.data.t[this.cursor]; return t === null || t < this.link.begin || t > this.link.end ? undefined : t; }
  fillTable() {
    if (!this.table.open || !this.data) return;
    const { t, lines } = this.data;
    const step = Math.max(1, Math.ceil(t.length / 200));
    const rows = t.map((value, k) => [value, ...this.options.lines.map((line) => lines[line.column][k])]).filter((row, k) => k % step === 0);
    this.table.lastChild.replaceChildren(tableOf(["t [s]", ...this.options.lines.map((line) => `${line.name} [${this.options.unit}]`)], rows.map((row) => row.map(digits))));
  }
  resize() {
    clearTimeout(this.sizing);
    this.sizing = setTimeout(() => {
      if (this.plot && this.box.clientWidth && this.plot.width !== this.width) this.plot.setSize({ width: this.width, height: this.plot.height });
    }, 80);
  }
  close() {
    this.asked = null;
    clearTimeout(this.again);
    this.watcher.disconnect();
    if (this.plot) this.plot.destroy();
    this.figure.remove();
  }
}
// the frame of a drawing: its figure, axes with units, and the places of values
function frame(title, size, [x0, x1], [y0, y1], unit, log, dates) {
  const [width, height] = size, left = 62, right = width - 14, top = 20, bottom = height - 34;
  const svg = drawn("svg", { class: "dots", viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": `${title}, ${unit}` });
  const x = (value) => left + ((value - x0) / (x1 - x0 || 1)) * (right - left);
  const y = (value) => bottom - (log ? Math.log(Math.max(value, y0) / y0) / Math.log(y1 / y0) : (value - y0) / (y1 - y0 || 1)) * (bottom - top);
  const write = (words, at, down, anchor, kind) => { const made = drawn("text", { x: at, y: down, "text-anchor": anchor, class: kind }); made.textContent = words; svg.append(made); };
  const ticks = (low, high) => { // whole multiples of 1, 2 or 5 times a power of ten
    const least = (high - low || 1) / 6, power = 10 ** Math.floor(Math.log10(least)), step = [1, 2, 5, 10].map((factor) => factor * power).find((value) => value >= least * 0.999);
    return Array.from({ length: 9 }, (none, k) => Number(((Math.ceil(low / step - 1e-9) + k) * step).toPrecision(12))).filter((value) => value <= high + 1e-9 * step);
  };
  for (const level of log ? [0, 0.25, 0.5, 0.75, 1].map((share) => Number((y0 * (y1 / y0) ** share).toPrecision(2))) : ticks(y0, y1)) {
    svg.append(drawn("path", { class: "axis", d: `M${left} ${y(level)}H${right}` }));
    write(digits(level), left - 6, y(level) + 4, "end");
  }
  for (const value of dates ? [x0, 0.5 * (x0 + x1), x1] : ticks(x0, x1)) write(dates ? isoTime(value, true).slice(0, 10) : digits(value), x(value), bottom + 16, !dates || value !== x0 && value !== x1 ? "middle" : value === x0 ? "start" : "end");
  write(unit, left, 12, "start");
  const keys = make("span", { class: "keys" }), caption = make("figcaption", {}, make("span", { text: title }), keys);
  return { svg, x, y, write, keys, left, right, top, bottom, figure: make("figure", { class: "trace" }, caption, svg) };
}
const TONES = { out: "--side-a", "mean out": "--side-a", in: "--side-b", "mean in": "--side-b", samples: "--tone", proportional: "--quiet", "by the stated area A": "--d1", "by the stated area B": "--d4", "samples at rest": "--tone" };
const span = (values, margin) => { const [low, high] = [Math.min(...values), Math.max(...values)], more = margin * (high - low || Math.abs(high) || 1); return [low - more, high + more]; };
// one of the checks of the channels: curves and clouds of points over each other; arrow keys read the curves
export function checkPlot(check) {
  const rows = check.curves.flatMap((curve) => curve.x.map((value, k) => [value, curve.y[k]])).filter(([a, b]) => a !== null && b !== null);
  if (!rows.length) return "";
  const { svg, x, y, write, keys, figure, left, right, top, bottom } = frame(check.title, [560, 280], span(rows.map(([a]) => a), 0.02), span(rows.map(([, b]) => b), 0.06), check.y);
  write(check.x, right, bottom + 31, "end");
  const inside = (at, low, high) => at >= low && at <= high;
  if (inside(y(0), top, bottom)) svg.append(drawn("path", { class: "zero", d: `M${left} ${y(0)}H${right}` }));
  if (inside(x(0), left, right)) svg.append(drawn("path", { class: "zero", d: `M${x(0)} ${top}V${bottom}` }));
  for (const curve of [...check.curves].sort((one, other) => one.is_cloud - other.is_cloud)) {
    let path = "";
    curve.x.forEach((value, k) => { if (value !== null && curve.y[k] !== null) path += `${curve.is_cloud || !path || curve.y[k - 1] === null ? "M" : "L"}${x(value).toFixed(1)} ${y(curve.y[k]).toFixed(1)}${curve.is_cloud ? "h0" : ""}`; });
    const tone = TONES[curve.name] || "--leak", drawing = drawn("path", { class: curve.is_cloud ? "cloud" : "curve", d: path || "M0 0" });
    drawing.style.stroke = colour(tone);
    svg.append(drawing);
    keys.append(keyOf(curve.name, tone, curve.is_cloud && "dot"));
  }
  if (check.mark !== null && inside(x(check.mark), left, right)) svg.append(drawn("path", { class: "limit", d: `M${x(check.mark)} ${top}V${bottom}` }));
  const lines = check.curves.filter((curve) => !curve.is_cloud), read = lines.length ? lines : check.curves.slice(0, 1), reading = make("p", { class: "reading", role: "status", "aria-live": "polite" });
  const say = (k) => `${check.x} ${digits(read[0].x[k])}: ${read.map((curve) => `${curve.name} ${digits(curve.y[k])}`).join(", ")}`;
  let at = -1;
  Object.entries({ tabindex: "0", "aria-roledescription": "chart", "aria-label": `${check.title}. ${check.text} Left and right arrow read the curves.` }).forEach((pair) => svg.setAttribute(...pair));
  svg.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step) return;
    at = Math.max(0, Math.min(read[0].x.length - 1, at + step));
    reading.textContent = say(at);
    event.preventDefault();
  });
  const every = Math.ceil(read[0].x.length / 60), list = read[0].x.map((value, k) => [value, ...read.map((curve) => curve.y[k])]).filter((row, k) => k % every === 0);
  const table = tableOf([check.x, ...read.map((curve) => `${curve.name}, ${check.y}`)], list.map((row) => row.map(digits)));
  figure.append(make("p", { class: check.severity, text: check.text }), make("div", { class: "under" }, reading, make("details", {}, make("summary", { text: "Table of what is seen" }), make("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": `Table: ${check.title}` }, table))));
  return figure;
}
// single results over dates; points: {t, value, low, high, bound, label, leak, chosen, go}; options: title, unit, limit,
// log, join, repairs
export function dotPlot(points, options) {
  const width = Math.max(330, Math.min(1400, document.querySelector("main").clientWidth - 34));
  const known = points.filter((point) => point.t !== null && point.t !== undefined && (point.value ?? point.bound) !== null);
  if (!known.length) return make("p", { class: "quiet", text: options.empty || "Nothing to draw yet." });
  const levels = known.flatMap((point) => [point.value, point.high, point.bound].filter((value) => value !== null && value !== undefined));
  const limit = options.limit ?? null, highest = Math.max(...levels, limit ?? 0, 1e-9) * 1.12, positive = levels.filter((value) => value > 0);
  const lowest = options.log ? Math.min(...(positive.length ? positive : [highest / 100]), limit || highest) / 2 : Math.min(0, ...known.map((point) => point.low ?? 0));
  const dates = [...known.map((point) => point.t), ...(options.repairs || [])], margin = (Math.max(...dates) - Math.min(...dates)) * 0.04 || 43200;
  const { svg, x, y, write, keys, figure, left, right, top, bottom } = frame(options.title, [width, 230], [Math.min(...dates) - margin, Math.max(...dates) + margin], [lowest, highest], options.unit, options.log, true);
  if (limit !== null) { svg.append(drawn("path", { class: "limit", d: `M${left} ${y(limit)}H${right}` })); write(`limit ${litres(limit)}`, left + 6, y(limit) - 5, "start", "limit-text"); }
  for (const t of options.repairs || []) { svg.append(drawn("path", { class: "repair", d: `M${x(t)} ${top}V${bottom}` })); write("repair", x(t) + 4, top + 10, "start"); }
  const kinds = [["leak", "--leak", known.some((point) => point.leak)], [options.join ? "estimate" : "no leak stated", "--total", known.some((point) => !point.leak && (point.value ?? null) !== null)], ["no leak above", "--good", known.some((point) => (point.value ?? null) === null)]];
  keys.append(...kinds.filter(([, , occurs]) => occurs).map(([name, tone]) => keyOf(name, tone)));
  const ordered = [...known].sort((a, b) => a.t - b.t);
  if (options.join) {
    const steps = ordered.slice(1).map((point, k) => point.t - ordered[k].t).sort((a, b) => a - b);
    const gap = 4 * (steps[Math.floor(steps.length / 2)] || Infinity);
    const path = ordered.map((point, k) => `${k && point.t - ordered[k - 1].t <= gap ? "L" : "M"}${x(point.t).toFixed(1)} ${y(point.value ?? point.bound).toFixed(1)}`).join("");
    svg.append(drawn("path", { class: "line", d: path }));
  }
  for (const point of ordered) {
    const at = x(point.t), level = point.value ?? point.bound;
    const link = drawn(point.go ? "a" : "g", point.go ? { href: point.go, "aria-label": point.label, class: point.chosen ? "chosen" : "" } : { role: "img", "aria-label": point.label });
    const title = drawn("title");
    title.textContent = point.label;
    link.append(title);
    if (point.low !== null && point.low !== undefined) link.append(drawn("path", { class: `bar ${point.leak ? "leak" : ""}`, d: `M${at} ${y(point.low)}V${y(point.high)}` }));
    if (point.value === null || point.value === undefined) link.append(drawn("path", { class: "dot bound", d: `M${at - 7} ${y(level)}H${at + 7}M${at} ${y(level)}v14m-4 -5l4 5l4 -5` }));
    else link.append(drawn("circle", { class: `dot ${point.leak ? "leak" : ""}`, cx: at, cy: y(level), r: 6.5 }));
    svg.append(link);
  }
  return figure;
}
