(function () {
  "use strict";
  const data = JSON.parse(document.getElementById("chart-data").textContent);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const axes = {};
  for (const [name, text] of Object.entries(data.axes)) {
    const t = new DataView(bytes(text));
    axes[name] = Array.from({length: t.byteLength / 8}, (_, i) => t.getFloat64(8 * i, true));
  }
  // An axis of windows begins and ends inside the recording: empty points stretch it, so that all charts line up.
  const stretched = (name, list, head, tail) => (name === "samples" ? list : [head].concat(list, [tail]));
  const values = (s) => {
    const q = new DataView(bytes(s.q));
    return Array.from({length: q.byteLength / 2}, (_, i) => {
      const k = q.getInt16(2 * i, true);
      return k === -32768 ? null : s.low + (k + 32767) * s.step;
    });
  };
  const shown = (v, unit) => (v == null ? "–" : Number(v.toPrecision(4)) + " " + unit).replace("-", "−");
  const dashes = {d2: [7, 3], d4: [2, 3]};
  const widths = {d3: 2, d3d4: 1.6};
  const [first, last] = data.span;
  const plots = [];
  let linking = false;

  function marksOver(u, color, level) {
    const ctx = u.ctx, {left, top, width, height} = u.bbox, px = devicePixelRatio || 1;
    const at = (t) => Math.round(u.valToPos(t, "x", true));
    ctx.save();
    ctx.beginPath();
    ctx.rect(left, top, width, height);
    ctx.clip();
    const line = (t, style, dash, wide) => {
      ctx.strokeStyle = style;
      ctx.lineWidth = wide * px;
      ctx.setLineDash(dash.map((d) => d * px));
      ctx.beginPath();
      ctx.moveTo(at(t), top);
      ctx.lineTo(at(t), top + height);
      ctx.stroke();
    };
    if (level != null) {
      const y = Math.round(u.valToPos(level, "y", true));
      ctx.strokeStyle = color("--leak");
      ctx.lineWidth = 1.5 * px;
      ctx.setLineDash([10 * px, 4 * px]);
      ctx.beginPath();
      ctx.moveTo(left, y);
      ctx.lineTo(left + width, y);
      ctx.stroke();
    }
    const onset = data.onset;
    if (onset.low != null) {
      ctx.fillStyle = color("--band");
      ctx.fillRect(at(onset.low), top, Math.max(px, at(onset.high) - at(onset.low)), height);
    }
    if (onset.t != null) line(onset.t, color("--leak"), [], 1.5);
    for (const m of data.marks) line(m.t, color(m.known ? "--ink" : "--soft"), m.known ? [8, 3, 2, 3] : [2, 3], 1.5);
    ctx.restore();
  }

  // The values under the cursor stand beside the key of the chart, and nothing while there is no cursor.
  function readOut(u, c, series, box) {
    const at = u.cursor.idx, head = box.previousElementSibling;
    head.querySelector(".at").textContent = at == null ? "" : u.data[0][at].toFixed(2) + " s";
    const ends = c.band && at != null ? [u.data[1][at], u.data[2][at]] : [];
    for (const [k, text] of head.querySelectorAll(".key output").entries()) {
      if (at == null) text.textContent = "";
      else if (c.band && k === 1) text.textContent = ends.map((v) => shown(v, "")).join(" to ");
      else text.textContent = shown(u.data[c.band ? 3 : k + 1][at], c.unit);
    }
  }

  function link(from, min, max) {
    if (linking) return;
    linking = true;
    for (const p of plots) if (p !== from) p.setScale("x", {min, max});
    linking = false;
  }

  function build() {
    const style = getComputedStyle(document.documentElement);
    const color = (name) => style.getPropertyValue(name).trim();
    for (const c of data.charts) {
      const box = document.querySelector('[data-chart="' + c.key + '"]');
      if (!box || !box.clientWidth || box.classList.contains("live")) continue; // folded, or drawn already
      const series = c.band ? [c.series[1], c.series[2], c.series[0]] : c.series; // the estimate above its interval
      const pen = (s) => ({
        stroke: color("--" + s.style), width: widths[s.style] || 1.1, dash: dashes[s.style],
        points: {show: c.axis !== "samples" && axes[c.axis].length < 60, size: 4, fill: color("--" + s.style)},
      });
      const axis = {stroke: color("--soft"), grid: {stroke: color("--grid"), width: 1}, ticks: {stroke: color("--rule"), width: 1}, font: "12px system-ui, sans-serif"};
      const plot = new uPlot({
        width: box.clientWidth, height: c.height,
        scales: {x: {time: false}, y: {range: (u, min, max) => c.limits || (min == null ? [0, 1] : uPlot.rangeNum(min, max, 0.06, true))}},
        axes: [Object.assign({size: 30, values: (u, list) => list.map((v) => v + " s")}, axis), Object.assign({size: (u, list) => Math.max(66, 24 + 7 * Math.max(0, ...(list || []).map((v) => v.length))), space: 22, values: (u, list) => list.map((v) => (v == null ? "" : (Math.abs(v) >= 1e5 ? v.toExponential().replace("e+", "e") : String(+v.toPrecision(6))).replace("-", "−")))}, axis)],
        series: [{}].concat(series.map((s, i) => c.band && i < 2 ? Object.assign(pen(s), {width: 0, points: {show: false}}) : pen(s))),
        bands: c.band ? [{series: [2, 1], fill: color("--fill-a")}] : [],
        legend: {show: false},
        cursor: {sync: {key: "t", scales: ["x", null]}, drag: {x: true, y: false}},
        hooks: {draw: [(u) => marksOver(u, color, c.level)], setCursor: [(u) => readOut(u, c, series, box)], setScale: [(u, key) => {if (key === "x" && u.status) link(u, u.scales.x.min, u.scales.x.max);}]},
      }, [stretched(c.axis, axes[c.axis], first, last)].concat(series.map((s) => stretched(c.axis, values(s), null, null))), box);
      box.classList.add("live");
      plot.drawnHeight = c.height;
      plots.push(plot);
    }
  }
  build();
  document.addEventListener("toggle", build, true);
  function rebuild() {
    for (const p of plots.splice(0)) {
      p.root.parentNode.classList.remove("live");
      p.destroy();
    }
    build();
  }

  const tools = document.getElementById("chart-tools");
  if (tools) {
    tools.hidden = false;
    tools.addEventListener("click", (event) => {
      const range = event.target.dataset && event.target.dataset.range;
      if (range && plots.length) {
        const [min, max] = range.split(" ").map(Number);
        plots[0].setScale("x", {min, max});
        link(plots[0], min, max);
      }
    });
  }
  let waiting = 0;
  new ResizeObserver(() => {
    clearTimeout(waiting);
    waiting = setTimeout(() => plots.forEach((p) => {
      const width = p.root.parentNode.clientWidth;
      if (width && width !== p.width) p.setSize({width, height: p.drawnHeight});
    }), 60);
  }).observe(document.querySelector("main"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", rebuild);
})();
