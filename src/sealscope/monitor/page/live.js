// The last seconds of the chosen actuator: its pressures and their wavelet details, from the stream of events.
"use strict";

let news = null;
const replaced = [];
let heard = "";
let paused = false;
let latest = null;
const drawing = { pressure: "p_A", drawn: "rms" };
const plots = {};

// one stream for changes and for the samples of the chosen actuator; none while the page is hidden
function listen() {
  const query = new URLSearchParams();
  if (chosen !== null && !paused) {
    query.set("actuator", chosen);
    query.set("pressure", drawing.pressure);
    query.set("drawn", drawing.drawn);
  }
  const address = document.hidden ? "" : `/api/changes?${query}`;
  if (address === heard && news && news.readyState !== EventSource.CLOSED) return;
  if (news) replaced.push(news);
  heard = address;
  news = address ? new EventSource(address) : null;
  if (!news) {
    closeReplaced();
    return;
  }
  const stream = news;
  stream.onmessage = () => {
    // not before: the monitor keeps the samples of an actuator only while a stream asks for them
    if (stream === news) closeReplaced();
    requestRefresh();
  };
  stream.addEventListener("live", (event) => {
    if (stream === news) showLive(JSON.parse(event.data));
  });
  stream.onerror = () => {
    if (stream !== news) return;
    closeReplaced();
    byId("overall").textContent = "the monitor does not answer";
    // a refused stream is closed for good: ask again
    if (stream.readyState === EventSource.CLOSED) setTimeout(listen, 3000);
  };
}

function closeReplaced() {
  for (const stream of replaced.splice(0)) stream.close();
}

const bar = (value) => (value === null || value === undefined ? "–" : value.toFixed(value < 99.95 ? 1 : 0));
const seconds = (value) => `${Number(value.toFixed(1))} s`;

function plotOf(id, names, unit, colours, values) {
  const place = byId(id);
  const key = [place.clientWidth, names.join(), unit, colour("--ink")].join("|");
  const data = [values.t, ...names.map((name) => values[name])];
  if (plots[id] && plots[id].key === key) {
    plots[id].plot.setData(data);
    return;
  }
  if (plots[id]) plots[id].plot.destroy();
  place.replaceChildren();
  const grid = { stroke: colour("--line"), width: 1 };
  const plot = new uPlot(
    {
      width: Math.max(240, place.clientWidth),
      height: 190,
      legend: { live: false },
      scales: { x: { time: false } },
      axes: [
        { stroke: colour("--quiet"), grid, space: 60, values: (made, at) => at.map(seconds) },
        { stroke: colour("--quiet"), grid, size: 58, label: unit, labelSize: 18, values: (made, at) => at.map(litres) },
      ],
      series: [
        {},
        ...names.map((name, k) => ({
          label: name,
          stroke: colour(colours[k]),
          width: 1.5,
          points: { show: false },
        })),
      ],
    },
    data,
    place,
  );
  plots[id] = { key, plot };
}

// replace a plot by the reason why there is none
function clearPlot(id, reason) {
  if (plots[id]) plots[id].plot.destroy();
  delete plots[id];
  byId(id).replaceChildren(element("p", "quiet", reason));
}

function showLive(live) {
  if (live.name !== chosen) return;
  latest = live;
  const says = byId("live-says");
  byId("live-charts").hidden = live.t === null;
  if (live.t === null) {
    says.textContent = live.error || "Waits for samples.";
    clearPlot("pressures", "");
    clearPlot("details", "");
    showTwin(live);
    return;
  }
  says.textContent = `As of ${clock(live.t)}, ${Number(live.rate.toPrecision(4))} Hz: ${live.channels.join(", ")}`;
  const names = ["p_A", "p_B"].filter((name) => live.pressures[name]);
  if (names.length) {
    const tones = { p_A: "--side-a", p_B: "--side-b" };
    plotOf("pressures", names, "bar", names.map((name) => tones[name]), live.pressures);
  } else clearPlot("pressures", "No chamber pressure is recorded.");
  const details = live.details;
  if (details.t.length) {
    const levels = ["d1", "d2", "d3", "d4"];
    plotOf("details", levels, "kPa", levels.map((level) => `--${level}`), details);
  } else clearPlot("details", `The details need ${details.needs} successive samples, ${details.has} are known.`);
  showTwin(live);
}

// mark the chosen buttons as pressed, and name the drawn details in their heading
function updateControls() {
  for (const button of document.querySelectorAll("[data-pressure], [data-drawn]")) {
    const on = button.dataset.pressure === drawing.pressure || button.dataset.drawn === drawing.drawn;
    button.setAttribute("aria-pressed", String(on));
  }
  byId("pause").setAttribute("aria-pressed", String(paused));
  const what = drawing.drawn === "rms" ? "RMS over 1000 samples of the details" : "Details";
  byId("details-title").textContent = `${what} d1 to d4 (db8) of ${drawing.pressure}`;
}

for (const button of document.querySelectorAll("[data-pressure], [data-drawn]")) {
  button.addEventListener("click", () => {
    Object.assign(drawing, { ...button.dataset });
    updateControls();
    listen();
  });
}
byId("pause").addEventListener("click", () => {
  paused = !paused;
  updateControls();
  listen();
});
document.addEventListener("visibilitychange", () => {
  listen();
  if (!document.hidden) requestRefresh();
});
const redrawLive = () => {
  if (latest) showLive(latest);
};
addEventListener("resize", redrawLive);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redrawLive);
updateControls();
listen();
