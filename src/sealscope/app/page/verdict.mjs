// The screen of the verdicts: by date, and for one recording the signals, the evidence and the balance of its flows.
import { app, ask, attempt, ensureMachine, fillSelect, go, machineNow, make, rowsRead, say, tell } from "./main.mjs";
import { Linked, Trace, dotPlot, settled } from "./charts.mjs";
const TONES = { p_A: "--side-a", p_B: "--side-b", x: "--piston", pump: "--steel", piston: "--total", creep: "--steel", valve: "--d1", compression: "--compression", "compression A": "--compression", "compression B": "--d1", leakage: "--leak", other: "--other", residual: "--residual" };
let link = new Linked();
let result = null, limit = null, renewed = "", pages = new Map();
let drawnFor = "";

export async function show() {
  await ensureMachine();
  drawnFor = "";
  update();
}

export async function update() {
  const machine = machineNow();
  if (!machine) return;
  const verdicts = new Map(machine.verdicts.map((verdict) => [verdict.file, verdict]));
  const rows = rowsRead();
  const others = rows.filter((row) => !machine.healthy.includes(row.key) && !machine.rejected.includes(row.key));
  byId("judge").textContent = machine.commissioned ? `Judge ${others.length} other logs against the healthy days` : `Judge ${others.length} logs, each by itself`;
  byId("judge").disabled = !others.length;
  byId("judge").onclick = () => attempt(() => tell("judge", { machine: machine.name, files: others.map((row) => row.key) }));
  fillSelect(byId("verdict-file"), rows.map((row) => [row.key, `${row.name}${verdicts.has(row.key) ? `: ${verdicts.get(row.key).summary || verdicts.get(row.key).verdict}` : ""}`]), app.file);
  const key = app.file;
  const answer = verdicts.has(key) ? await ask("verdict", { machine: machine.name, file: key }).catch((error) => say(error.message)) : { verdict: null };
  if (!answer || key !== app.file) return;
  result = answer.verdict;
  if (result) renewed = "";
  limit = (await ask("limit", { text: machine.limit || "", machine: machine.name }).catch(() => ({ lpm: null }))).lpm;
  showDates(machine, verdicts, rows);
  showHead(machine, verdicts.get(key), key);
  if (app.rows.get(key)?.state === "read") await draw(machine, key);
  byId("evidence").hidden = app.rows.get(key)?.state !== "read";
}

function showDates(machine, verdicts, rows) {
  const ordered = rows.filter((row) => verdicts.has(row.key));
  const points = ordered.map((row, k) => {
    const verdict = verdicts.get(row.key);
    const known = verdict.leak_lpm !== null;
    const size = known ? `${litres(verdict.leak_lpm)} L/min` : verdict.bound_lpm === null ? "no L/min" : `below ${litres(verdict.bound_lpm)} L/min`;
    const interval = result && result.key === row.key ? result.leak_interval_lpm : null;
    return { t: row.start_s ?? row.changed_s ?? k, value: known ? Math.max(0, verdict.leak_lpm) : null, bound: verdict.bound_lpm, low: interval && interval[0], high: interval && interval[1], leak: verdict.verdict === "leak", label: `${row.name}, ${row.date}: ${verdict.summary || verdict.verdict}, ${size}${verdict.opinion ? `, ${verdict.opinion}` : ""}`, chosen: row.key === app.file, go: `#${["verdict", machine.name, row.key].map(encodeURIComponent).join("|")}` };
  });
  const list = make("ul", { class: "checks" }, ...points.map((point) => make("li", { class: point.leak ? "bad" : "" }, make("a", { href: point.go, text: point.label }))));
  byId("by-date").replaceChildren(
    dotPlot(points, { title: "Verdicts by date", unit: "L/min", limit: limit ?? (result && result.limit_lpm), empty: ordered.length ? "No leak is stated in L/min: state the area or the displacement on the screen Channels." : "No log is judged yet." }),
    points.length ? make("details", { open: points.length < 2 }, make("summary", { text: `${points.length} verdicts as a list` }), list) : "",
  );
}

function showHead(machine, kept, key) {
  const place = byId("verdict-head");
  place.hidden = !app.rows.has(key);
  if (place.hidden) return;
  const row = app.rows.get(key);
  const judge = make("button", { type: "button", text: kept ? "Judge again" : "Judge this log", onclick: () => attempt(() => tell("judge", { machine: machine.name, files: [key] })) });
  if (kept && !result && renewed !== `${machine.name}|${key}`) {
    renewed = `${machine.name}|${key}`;
    tell("judge", { machine: machine.name, files: [key] }).catch((error) => say(error.message));
  }
  if (!kept || !result) {
    place.replaceChildren(make("p", { class: "verdict-line", text: kept ? `${row.name}: ${kept.summary || kept.verdict}` : `${row.name} is not judged yet` }), make("p", { class: "quiet", text: row.state === "unreadable" ? row.error : row.date }), make("div", { class: "actions" }, judge));
    return;
  }
  const interval = result.leak_interval_lpm;
  const figure = result.leak_lpm !== null ? `${litres(result.leak_lpm)} L/min${interval ? ` (${litres(interval[0])} to ${litres(interval[1])})` : ""}` : result.bound_lpm !== null ? `a leak would be below ${litres(result.bound_lpm)} L/min` : "";
  const facts = [["Why", result.reason], ["Since", result.onset_s === null ? "" : `${Number(result.onset_s.toFixed(1))} s${result.onset_interval_s ? ` (${result.onset_interval_s.map((t) => Number(t.toFixed(1))).join(" to ")} s)` : ""}`], ["How sure", result.odds || ""], ["Limit", result.limit_lpm === null ? "" : `${litres(result.limit_lpm)} L/min`], ["Compared with", result.against ? `${result.against} healthy days` : "its own beginning"], ["Next", result.next_check]];
  const opinion = (value, text) => make("button", { type: "button", "aria-pressed": String(kept.opinion === value), text, onclick: () => attempt(() => tell("opinion", { machine: machine.name, file: key, opinion: kept.opinion === value ? "" : value })) });
  const report = make("p", { role: "status" });
  const written = pages.get(`${machine.name}|${key}`);
  if (written) report.append(make("a", { href: written.address, target: "_blank", rel: "noopener", text: `reports/${written.page}` }));
  place.replaceChildren(
    make("p", { class: "verdict-line" }, badge(result.state), make("span", { text: `${row.name}: ${result.summary}` }), make("span", { class: result.verdict === "leak" ? "bad" : "", text: figure })),
    make("dl", {}, ...facts.filter(([, text]) => text).flatMap(([name, text]) => [make("dt", { text: name }), make("dd", { text })])),
    make("div", { class: "actions" }, opinion("confirmed", "Confirm"), opinion("rejected", "Reject"),
      make("button", { type: "button", text: "Add to the healthy days", onclick: () => attempt(async () => {
        await tell("mark", { machine: machine.name, files: [key], mark: "healthy" });
        go("healthy");
      }) }),
      make("button", { type: "button", text: "Write the report’s page", onclick: () => attempt(async () => {
        report.textContent = "writing …";
        pages.set(`${machine.name}|${key}`, await tell("report", { machine: machine.name, file: key }));
        showHead(machine, kept, key);
      }) }), judge),
    report,
  );
}

async function draw(machine, key) {
  const healthy = rowsRead().filter((row) => machine.healthy.includes(row.key) && row.key !== key);
  fillSelect(byId("overlay"), [["", "no other day"], ...healthy.map((row) => [row.key, row.name])], byId("overlay").value);
  const overlay = byId("overlay").value;
  const shift = Number(byId("overlay-shift").value.replace(",", ".")) || 0;
  const now = JSON.stringify([key, machine.name, machine.map, machine.area, machine.displacement, machine.rate, overlay, shift, result && result.onset_s, result && result.score]);
  if (now === drawnFor) return;
  drawnFor = now;
  link.close();
  link = new Linked();
  const place = byId("evidence-charts");
  place.replaceChildren();
  const window = (table, columns, file = key, moved = 0) => (begin, end, pixels) => ask("window", { table, file, machine: machine.name, columns: columns.join(","), pixels, ...(begin === null ? {} : { from: begin - moved, to: end - moved }) });
  place.append(make("p", { class: "quiet", text: "Reading the signals and balancing the volumes …" }));
  const [head, flows] = await Promise.all(["channels", "balance"].map((table) => settled({ table, file: key, machine: machine.name }, () => drawnFor === now)));
  if (drawnFor !== now) return;
  place.replaceChildren();
  Object.assign(link, { first: head.first, last: head.last, begin: head.first, end: head.last });
  const blocks = (flows.about && flows.about.blocks) || [];
  const marks = result && result.onset_s !== null ? [{ t: result.onset_s, label: "onset" }] : [];
  const columnOf = (name) => head.names.findIndex((text) => text.startsWith(`${name} [`));
  const unitOf = (name) => /\[(.*)\]$/.exec(head.names[columnOf(name)] || "")?.[1] || "";
  const add = (title, names, table, unit, columns, options = {}) => {
    const lines = names.map((name, k) => ({ name, colour: TONES[name] || "--d3", column: k, width: { leakage: 2, pump: 5, creep: 5 }[name] || 1.3 }));
    if (!overlay) return new Trace(place, link, { title, unit, lines, marks, shades: blocks, fetch: window(table, columns), ...options });
    const other = app.rows.get(overlay).name;
    const both = [...lines, ...lines.map((line) => ({ ...line, name: `${line.name} of ${other}`, dash: [4, 4], column: line.column + lines.length }))];
    const fetch = async (begin, end, pixels) => {
      const [mine, theirs] = await Promise.all([window(table, columns)(begin, end, pixels), window(table, columns, overlay, shift)(begin, end, pixels)]);
      return { ...mine, lines: [...mine.lines, ...theirs.lines.map((line) => resample(theirs.t.map((t) => t + shift), line, mine.t))] };
    };
    return new Trace(place, link, { title, unit, lines: both, marks, shades: blocks, fetch, ...options });
  };
  const pressures = ["p_A", "p_B"].filter((name) => columnOf(name) >= 0);
  if (blocks.length) place.append(make("p", { class: "quiet", text: "Blue: the seconds that carry the evidence, the darker the more." }));
  if (pressures.length) add("Chamber pressures", pressures, "channels", unitOf(pressures[0]), pressures.map(columnOf), { height: 150 });
  for (const { chamber, names, first } of (flows.about && flows.about.groups) || []) {
    const where = chamber ? ` in chamber ${chamber}` : "", main = names.filter((name) => name !== "residual");
    const columnsOf = (wanted) => wanted.map((name) => first + names.indexOf(name));
    add(`Where the oil goes${where}: ${names[0]} = ${names.slice(1).join(" + ")}`, main, "balance", flows.about.unit, columnsOf(main), { height: 200 });
    const small = names.slice(1).filter((name) => !["piston", "valve"].includes(name));
    add(`The small parts${where} on their own scale: leakage of pump and piston, compression, and what no term explains`, small, "balance", flows.about.unit, columnsOf(small), { height: 170 });
  }
  if (!flows.names.length) place.append(make("p", { class: "quiet", text: flows.error || flows.about.problem }));
  if (result && result.course) {
    const { t, lpm, low, high } = result.course;
    const title = result.course.whole ? "Leakage estimated block by block" : "Leak since its onset, block by block";
    new Trace(place, link, { title, unit: "L/min", marks, level: result.limit_lpm === null ? null : { value: result.limit_lpm, label: "limit" }, lines: [{ name: "leak", colour: "--leak", column: 0, width: 2 }, { name: "lower bound", colour: "--quiet", column: 1, dash: [3, 3] }, { name: "upper bound", colour: "--quiet", column: 2, dash: [3, 3] }], fetch: async () => ({ t, lines: [lpm, low, high], first: link.first, last: link.last, complete: true }) });
  }
  const more = head.names.map((name, column) => ({ name: name.replace(/ \[.*/, ""), unit: /\[(.*)\]$/.exec(name)[1], column })).filter((line) => !pressures.includes(line.name));
  for (const line of more) add(line.name, [line.name], "channels", line.unit, [line.column], { height: 130 });
}
// values at other times, by the nearest one before
function resample(from, line, to) {
  let k = 0;
  return to.map((t) => {
    while (k < from.length - 1 && from[k + 1] <= t) k += 1;
    return from.length && t >= from[0] && t <= from[from.length - 1] ? line[k] : null;
  });
}
byId("verdict-file").addEventListener("change", (event) => go("verdict", event.target.value));
byId("overlay").addEventListener("change", update);
byId("overlay-shift").addEventListener("change", update);
