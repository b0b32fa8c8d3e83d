// The page of a monitor. Whatever comes from the wire goes into the document as text, never as markup.
"use strict";

let chosen = decodeURIComponent(location.hash.slice(1)) || null;
let hours = "";
let chart = null;
let shown = "";

function flow(value, interval) {
  if (value === null || value === undefined) return "no L/min";
  const range = interval ? ` (${litres(interval[0])} to ${litres(interval[1])})` : "";
  return `${litres(Math.max(value, 0))}${range} L/min`;
}

// the leak of an actuator, or the upper bound of an undetected one
function leakOf(row) {
  if (row.leak_lpm !== null) return `${litres(Math.max(row.leak_lpm, 0))} L/min`;
  return row.bound_lpm === null || row.bound_lpm === undefined ? "" : `< ${Number(row.bound_lpm.toPrecision(2))} L/min`;
}

// whether the chosen actuator's recordings are files, on their logger's clock
let chosenByFiles = false;

// clocks beyond 1973 are dates, others seconds since the beginning
function clock(t, byFiles = chosenByFiles) {
  if (t === null || t === undefined) return "";
  if (t > 1e8) return isoTime(t, byFiles);
  const whole = Math.floor(t);
  const parts = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  return parts.map((part) => String(part).padStart(2, "0")).join(":");
}

// fetch JSON from the monitor: without a session go to the login form, in an outage show it and throw an error
async function requestJson(address, options) {
  const answer = await fetch(address, options);
  if (answer.status === 401) location.href = "/login";
  const values = await answer.json();
  if (answer.status === 503) {
    showOutages(values);
    throw new Error(values.error || "the monitor is busy");
  }
  return values;
}

// what the monitor does not reach, and what waits for it
function showOutages(values) {
  const lines = (values.outages || []).map(
    (outage) => `The ${outage.part} is not reached since ${clock(outage.since, false)}: ${outage.reason}`,
  );
  if (lines.length && values.waiting) lines.push(`${values.waiting} blocks wait to be stored`);
  const place = byId("outages");
  const text = lines.join(". ");
  if (place.textContent !== text) place.textContent = text;
  place.hidden = !lines.length;
}

// a rate per 1000 h in the words of a plant: how long until the next one
function onceIn(rate) {
  const hours = 1000 / rate;
  const [length, unit] = hours < 48 ? [hours, "hours"] : hours < 8760 ? [hours / 24, "days"] : [hours / 8760, "years"];
  return length >= 1e4 ? `10 000 ${unit}` : `${Number(length.toPrecision(2))} ${unit}`;
}

// how seldom the whole fleet, if healthy, would raise an alarm as strong as this one
let fleetCount = 1;
const byChance = (alarm) =>
  alarm.by_chance_per_1000_h === null || alarm.by_chance_per_1000_h === undefined
    ? ""
    : `healthy, the fleet would raise such an alarm once in ${onceIn(alarm.by_chance_per_1000_h * fleetCount)} or less often`;

function stateOf(row) {
  const since = row.state.since_s === null ? "" : ` since ${clock(row.state.since_s, row.by_files)}`;
  const why = { "no data": "no data", "not comparable": `not comparable (${row.state.cause})`, learning: "learns its baseline" };
  const now = `${why[row.state.condition] || row.status}${since}`;
  if (!row.alarm) return now;
  const over = row.alarm.returned_s !== null;
  return over ? `alarm ${row.alarm.state}, over; ${now}` : `alarm ${row.alarm.state}; leak since ${clock(row.alarm.onset_s, row.by_files)}`;
}

function showFleet(fleet) {
  fleetCount = fleet.actuators.length;
  const list = byId("fleet");
  const focused = document.activeElement && document.activeElement.dataset.name;
  list.replaceChildren();
  const states = new Map();
  for (const row of fleet.actuators) {
    const button = element("button");
    button.type = "button";
    button.dataset.name = row.name;
    button.classList.add(row.state.symbol);
    states.set(row.state.name, (states.get(row.state.name) || 0) + 1);
    if (row.name === chosen) button.setAttribute("aria-current", "true");
    button.append(element("span", "name", row.name));
    button.append(element("span", "figure", leakOf(row)));
    button.append(badge(row.state), element("span", "state", stateOf(row)));
    button.addEventListener("click", () => choose(row.name));
    const item = element("li");
    item.append(button);
    list.append(item);
    if (row.name === focused) button.focus();
  }
  const count = fleet.actuators.length;
  byId("budget").textContent =
    `While all run, at most one false alarm in ${onceIn(fleet.false_alarms_per_1000_h)} is stated for all of them together` +
    (fleet.actuators.some((row) => row.recording)
      ? "; where recordings are judged whole and that is more, one in 10 000 healthy recordings."
      : ".");
  const parts = [...states].map(([name, number]) => `${number} ${name}`);
  byId("overall").textContent = `${count} actuator${count === 1 ? "" : "s"}: ${parts.join(", ")}`;
  const dropped = Object.entries(fleet.counters).map(([reason, number]) => `${number} ${reason}`);
  byId("dropped").textContent = dropped.length ? `Since the start: ${dropped.join("; ")}` : "";
}

function showFacts(alarm, judged) {
  const list = byId("alarm-facts");
  list.replaceChildren();
  const rows = [
    ["Since", `${clock(alarm.onset_s)} (${clock(alarm.onset_interval_s[0])} to ${clock(alarm.onset_interval_s[1])})`],
    ["Raised", clock(alarm.raised_s)],
    ["Evidence", alarm.evidence],
    ["By chance", judged && judged.verdict === "leak" ? judged.odds : byChance(alarm)],
    ["Reason", alarm.reason],
    ["Number", `${alarm.diagnostic_number}${alarm.baseline ? `, baseline ${alarm.baseline}` : ""}`],
  ];
  for (const [name, value] of rows.filter((row) => row[1])) list.append(element("dt", "", name), element("dd", "", value));
}

// the steps of an alarm's life, the one it is at marked
function showWorkflow(alarm) {
  const steps = ["new", "acknowledged", "valid", "closed"];
  byId("workflow").replaceChildren(
    ...steps.map((step) => {
      const made = element("li", "", step);
      if (step === alarm.state) made.setAttribute("aria-current", "step");
      return made;
    }),
  );
  for (const button of byId("marks").querySelectorAll("button")) {
    button.disabled = button.value === alarm.state || (button.value === "acknowledged" && alarm.state === "valid");
  }
}

// the range of the chart of flows: from zero, and of what lies below a tenth of it
function flowRange(least, most) {
  if (least === null || most === null) return [0, 1];
  const top = most > 0 ? 1.05 * most : 1;
  return [Math.max(1.05 * Math.min(least, 0), -0.1 * top), top];
}

// an empty row in every pause that is longer than PAUSE usual distances: no line is drawn through it
const PAUSE = 3;
function withPauses(course) {
  const steps = course.slice(1).map((row, k) => row.t - course[k].t);
  const usual = [...steps].sort((one, other) => one - other)[Math.floor(steps.length / 2)];
  return course.flatMap((row, k) => (k && steps[k - 1] > PAUSE * usual ? [{ t: course[k - 1].t + usual }, row] : [row]));
}

function draw(course, events) {
  const place = byId("chart");
  const rows = withPauses(course);
  const column = (name) => rows.map((row) => row[name] ?? null);
  const data = [column("t"), column("leak_low_lpm"), column("leak_high_lpm"), column("leak_lpm"), column("total_lpm")];
  const warmth = column("oil_celsius");
  const warm = warmth.some((value) => value !== null);
  if (warm) data.push(warmth);
  if (chart) chart.destroy();
  place.replaceChildren();
  if (!course.length) {
    place.append(element("p", "quiet", "No block yet."));
    return;
  }
  const dated = course[0].t > 1e8;
  const grid = { stroke: colour("--line"), width: 1 };
  const flowText = (plot, value) => (value === null || value === undefined ? "–" : `${litres(value)} L/min`);
  const degrees = (plot, value) => (value === null || value === undefined ? "–" : `${value.toFixed(1)} °C`);
  const edge = { stroke: colour("--band"), width: 1, points: { show: false }, value: flowText };
  const marks = events.filter((event) => event.event !== "comment");
  chart = new uPlot(
    {
      width: Math.max(280, place.clientWidth),
      height: 240,
      // blocks scatter below zero, where nothing flows: they must not press the leak flat
      scales: { x: { time: dated }, y: { range: (plot, least, most) => flowRange(least, most) } },
      fmtDate: isoTemplate,
      ...(chosenByFiles ? { tzDate: (t) => uPlot.tzDate(new Date(t * 1000), "UTC") } : {}),
      bands: [{ series: [2, 1], fill: colour("--band") }],
      axes: [
        { stroke: colour("--quiet"), grid, space: 80, ...(dated ? {} : { values: (plot, at) => at.map(clock) }) },
        { stroke: colour("--quiet"), grid, size: 70, label: "L/min", values: (plot, at) => at.map(litres) },
        ...(warm ? [{ scale: "oil", side: 1, stroke: colour("--quiet"), grid: { show: false }, label: "oil, °C" }] : []),
      ],
      series: [
        { value: (plot, at) => (at === null ? "–" : clock(at)), label: "clock" },
        { ...edge, label: "from" },
        { ...edge, label: "to" },
        { label: "leak", stroke: colour("--leak"), width: 2, value: flowText },
        { label: "pump and piston", stroke: colour("--total"), width: 1, value: flowText },
        ...(warm ? [{ label: "oil", scale: "oil", stroke: colour("--oil"), width: 1, value: degrees }] : []),
      ],
      hooks: {
        draw: [
          (plot) => {
            const context = plot.ctx;
            context.save();
            context.strokeStyle = colour("--quiet");
            context.fillStyle = colour("--ink");
            context.font = `${11 * devicePixelRatio}px system-ui`;
            context.setLineDash([4, 4]);
            marks.forEach((event, k) => {
              const x = plot.valToPos(event.t, "x", true);
              if (x < plot.bbox.left || x > plot.bbox.left + plot.bbox.width) return;
              context.beginPath();
              context.moveTo(x, plot.bbox.top);
              context.lineTo(x, plot.bbox.top + plot.bbox.height);
              context.stroke();
              const wide = x + 4 + context.measureText(event.event).width > plot.bbox.left + plot.bbox.width;
              context.textAlign = wide ? "right" : "left";
              context.fillText(event.event, x + (wide ? -4 : 4), plot.bbox.top + (12 + 12 * (k % 4)) * devicePixelRatio);
            });
            context.restore();
          },
        ],
      },
    },
    data,
    place,
  );
}

function showLife(life) {
  if (life.error) {
    byId("life").hidden = true;
    return;
  }
  byId("life").hidden = false;
  byId("life-title").textContent = life.name;
  chosenByFiles = life.by_files;
  const now = life.summary;
  const base = now.baseline;
  const learned = base ? `; baseline ${base.version}, ${base.hours.toPrecision(2)} h` +
    (base.lpm === null ? "" : `, ${litres(Math.max(base.lpm, 0))} L/min`) : "; the baseline is being learned";
  const oil = now.oil_celsius === null || now.oil_celsius === undefined ? "" : `, oil ${now.oil_celsius.toFixed(0)} °C`;
  const state = now.state;
  const since = state.since_s === null ? "" : ` since ${clock(state.since_s)}`;
  const judged = now.recording;
  const alarm = life.alarms.find((each) => each.state !== "closed" && each.state !== "invalid");
  const leaks = state.condition.startsWith("leak");
  const known = leaks && judged && judged.verdict !== "leak" && alarm ? alarm : now;
  const size = judged && (judged.verdict === "leak") === leaks ? judged.size : leaks ? flow(known.leak_lpm, known.leak_interval_lpm) : "";
  const limit = life.limit_lpm ? `; limit ${litres(life.limit_lpm)} L/min` : "";
  byId("state").replaceChildren(
    badge(state),
    element("strong", "", ` ${known === now && judged ? judged.summary : state.condition}${size ? `: ${size}` : ""}${since}${limit}`),
    element("span", "action", `${state.cause ? `Cause: ${state.cause}. ` : ""}${state.action}`),
  );
  const total = `pump and piston pass ${flow(now.total_lpm, now.total_interval_lpm)}`;
  byId("now").textContent = judged
    ? `${clock(now.t)}: ${judged.file}: ${judged.summary}: ${judged.reason}; ${total}${oil}; judged against the machine's healthy recordings`
    : `${clock(now.t)}: ${now.status}; ${now.why_no_litres ? `${now.why_no_litres}; ` : ""}${total}, leak ${flow(now.leak_lpm, now.leak_interval_lpm)}${oil}${learned}`;
  byId("alarm").hidden = !alarm;
  if (alarm) {
    byId("alarm-title").textContent = `${alarm.level}: ${flow(alarm.leak_lpm, alarm.leak_interval_lpm)}, ${alarm.state}${alarm.returned_s == null ? "" : ", over"}`;
    showFacts(alarm, judged);
    showWorkflow(alarm);
  }
  const list = byId("events");
  list.replaceChildren();
  for (const event of life.events) {
    const item = element("li");
    item.append(element("time", "", clock(event.t)), element("span", "", `${event.alarm.id}: ${event.event}`));
    if (event.alarm.leak_lpm !== null) item.append(element("span", "quiet", ` ${flow(event.alarm.leak_lpm)}`));
    if (event.by) item.append(element("span", "", ` by ${event.by}`));
    if (event.text) item.append(element("span", "", `: ${event.text}`));
    list.append(item);
  }
  if (!life.events.length) list.append(element("li", "quiet", "Nothing yet."));
  const passed = Object.entries(now.counters).map(([reason, number]) => `${number} ${reason}`);
  byId("counters").textContent = passed.length ? passed.join("; ") : "none";
  draw(life.course, life.events);
  showMachine(life.machine, now, alarm);
}

async function refresh() {
  const fleet = await requestJson("/api/fleet");
  showOutages(fleet);
  if (chosen === null && fleet.actuators.length) chosen = fleet.actuators[0].name;
  showFleet(fleet);
  listen();
  if (chosen === null) return;
  const query = hours ? `&hours=${hours}` : "";
  showLife(await requestJson(`/api/actuator?name=${encodeURIComponent(chosen)}${query}`));
}

function choose(name) {
  chosen = name;
  history.replaceState(null, "", `#${encodeURIComponent(name)}`);
  byId("mark-answer").textContent = "";
  refresh().then(
    () => {
      if (matchMedia("(max-width: 60rem)").matches) byId("life").scrollIntoView();
    },
    requestRefresh,
  );
}

byId("marks").addEventListener("submit", async (event) => {
  event.preventDefault();
  const mark = event.submitter ? event.submitter.value : "comment";
  if (mark === "invalid" && !byId("comment").value.trim()) {
    byId("mark-answer").textContent = "Say the reason first: why is the alarm invalid?";
    byId("comment").focus();
    return;
  }
  const answer = await requestJson(`/api/mark?name=${encodeURIComponent(chosen)}`, {
    method: "POST",
    headers: { "Content-Type": "application/json", "X-Sealscope": "mark" },
    body: JSON.stringify({ mark, text: byId("comment").value }),
  }).catch((error) => ({ error: `not kept: ${error.message}` }));
  byId("mark-answer").textContent = answer.error || `${answer.id}: ${mark}`;
  if (!answer.error) byId("comment").value = "";
  requestRefresh();
});

for (const button of document.querySelectorAll(".spans button")) {
  button.addEventListener("click", () => {
    hours = button.dataset.hours;
    for (const other of document.querySelectorAll(".spans button")) {
      other.setAttribute("aria-pressed", String(other === button));
    }
    requestRefresh();
  });
}

// refresh the page now or, while it is being refreshed, once more afterwards; at most every 0.5 s
let busy = false;
let again = false;
async function requestRefresh() {
  if (busy) {
    again = true;
    return;
  }
  busy = true;
  try {
    await refresh();
    byId("overall").classList.remove("lost");
  } catch (error) {
    byId("overall").textContent = error instanceof TypeError ? "the monitor does not answer" : error.message;
    again = !(error instanceof TypeError); // without a connection, the stream of events tells when to try again
    await new Promise((later) => setTimeout(later, 1500));
  }
  setTimeout(() => {
    busy = false;
    if (again) {
      again = false;
      requestRefresh();
    }
  }, 500);
}

addEventListener("resize", requestRefresh);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", requestRefresh);
requestRefresh();
