// The screen of the channels: every column drawn, given a place in the machine's drawing, and checked.
import { app, ask, attempt, ensureMachine, fillSelect, go, machineNow, make, miniature, refresh, say, tell } from "./main.mjs";
import { Linked, Trace, checkPlot, settled } from "./charts.mjs";
let link = new Linked();
let columns = [];
let proposal = { map: {}, groups: [], problem: "" };
let held = null, seen = { channels: [] }, drawnFor = "", counted = "", changing = Promise.resolve();

export async function show() {
  const file = app.file;
  byId("channel-file").disabled = !app.keys.length;
  update();
  if (!file || !app.rows.has(file)) { byId("channel-state").textContent = "Open a log first."; return; }
  const machine = await ensureMachine();
  fillSizes(machine);
  counted = "reading …";
  update();
  const query = { file, machine: machine.name };
  const [read, proposed] = await Promise.all([loadColumns(query), ask("proposal", query).catch((error) => ({ map: {}, groups: [], problem: error.message }))]);
  if (app.file !== file || app.machine !== machine.name) return; // another log was chosen meanwhile
  [columns, proposal] = [read, proposed];
  showGroups();
  showColumns();
  await showMap();
}

export function update() {
  fillSelect(byId("channel-file"), app.keys.map((key) => [key, app.rows.get(key)?.name || key]), app.file);
  byId("channel-state").textContent = `${app.rows.get(app.file)?.date || ""}, ${counted}`;
}

async function loadColumns({ file, machine }) {
  const query = { table: "columns", file, machine, pixels: 150 };
  const first = await ask("window", { ...query, columns: "" });
  if (!first.names.length) throw new Error(first.error || "no columns could be read");
  const data = await ask("window", { ...query, columns: first.names.map((name, k) => k).join(",") });
  counted = `${data.count} rows${data.complete ? `, ${data.names.length} columns` : " so far"}`;
  update();
  if (!data.complete && !data.error) {
    setTimeout(async () => {
      const isShown = () => app.file === file && app.screen === "channels", more = isShown() && (await loadColumns({ file, machine }));
      if (more && isShown()) { columns = more; showColumns(); }
    }, 500);
  }
  return data.names.map((name, index) => ({ name, index, line: data.lines[index] }));
}

function showGroups() {
  const others = proposal.groups.filter((group) => !app.machines.some((known) => known.map.group === group));
  byId("groups").hidden = !others.length;
  byId("groups").replaceChildren(
    make("p", { text: `The columns are those of ${proposal.groups.length} actuators: ${proposal.groups.join(", ")}.` }),
    make("button", { type: "button", text: "Keep them apart, a machine each", onclick: () => attempt(async () => {
      for (const group of others) await tell("machine", { machine: group, values: { map: { "*": "auto", group } } });
      await refresh();
      go("channels", app.file, others[0]);
    }) }),
  );
}
// the map in force: what the machine states, completed by the proposal where it says auto
function mapNow() {
  const stated = machineNow()?.map || {};
  const isAuto = !Object.keys(stated).length || stated["*"] === "auto" || "group" in stated;
  const entries = Object.entries(stated).filter(([channel]) => !["*", "group"].includes(channel));
  return isAuto ? { ...proposal.map, ...Object.fromEntries(entries) } : Object.fromEntries(entries);
}

const bare = (text) => text.replace(/(\s*\[[^\]]*\])+$/, "").trim();
function columnOf(text) {
  const number = /^#(\d+)/.exec(text);
  if (number) return columns[Number(number[1]) - 1] || null;
  return columns.find((column) => column.name === text) || columns.find((column) => bare(column.name) === bare(text)) || null;
}

function showColumns() {
  const channelOf = new Map();
  for (const [channel, text] of Object.entries(mapNow())) if (columnOf(text)) channelOf.set(columnOf(text).index, channel);
  byId("columns").replaceChildren(...columns.map((column) => {
    const channel = channelOf.get(column.index) || "";
    const values = column.line.filter((value) => value !== null);
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const picture = column.line.map((value) => (value === null ? null : (value - low) / (high - low || 1)));
    const select = make("select", { "aria-label": `${column.name} is` }, make("option", { value: "", text: "not used" }), ...byId("channel-options").content.cloneNode(true).children);
    select.value = channel;
    select.addEventListener("change", () => assign(select.value, column, channel));
    const card = make("div", { class: `column-card${channel ? " used" : ""}`, draggable: "true", "data-index": column.index }, make("strong", { text: column.name }), select, miniature({ [channel || "column"]: picture }, `Course of ${column.name}`),
      make("span", { class: "quiet", text: values.length ? `${Number(low.toPrecision(5))} to ${Number(high.toPrecision(5))}` : "no numbers" }));
    card.addEventListener("dragstart", (event) => { held = column; event.dataTransfer.setData("text/plain", column.name); });
    card.addEventListener("dragend", () => (held = null));
    return card;
  }));
}

function place(target, channel) {
  target.setAttribute("tabindex", "0");
  target.setAttribute("role", "button");
  const column = mapNow()[channel];
  target.setAttribute("aria-label", `${channel}: ${column || "not recorded"}`);
  target.addEventListener("dragover", (event) => { event.preventDefault(); target.classList.add("over"); });
  target.addEventListener("dragleave", () => target.classList.remove("over"));
  target.addEventListener("drop", (event) => { event.preventDefault(); target.classList.remove("over"); if (held) assign(channel, held, ""); });
  const find = () => {
    const card = byId("columns").querySelector(`[data-index="${column ? columnOf(column)?.index : ""}"]`) || byId("columns").firstChild;
    if (card) card.querySelector("select").focus();
  };
  target.addEventListener("click", find);
  target.addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); find(); } });
}

function assign(channel, column, earlier) {
  const same = columns.filter((other) => bare(other.name) === bare(column.name)).length > 1 || / \(column \d+\)$/.test(column.name);
  const drops = earlier && earlier !== channel;
  return change(() => {
    const map = drops ? { ...mapNow() } : statedMap();
    if (drops) delete map[earlier];
    return { map: channel ? { ...map, [channel]: same ? `#${column.index + 1}` : column.name } : map };
  });
}
const statedMap = () => (Object.keys(machineNow().map).length ? { ...machineNow().map } : { "*": "auto" });
// one change after the other, each of what the one before has left
function change(values) {
  changing = changing.then(async () => {
    const done = await attempt(() => tell("machine", { machine: app.machine, values: values() }));
    if (done && done.name !== app.machine) go("channels", app.file, done.name);
    else if (done) { showColumns(); await showMap(); }
  }).catch((error) => say(error.message));
  return changing;
}

async function showMap() {
  const machine = machineNow();
  const map = mapNow();
  const rows = Object.entries(map).map(([channel, text]) => {
    const input = make("input", { value: text, "aria-label": `column or formula of ${channel}` });
    input.addEventListener("change", () => change(() => ({ map: { ...statedMap(), [channel]: input.value } })));
    return make("tr", {}, make("th", { scope: "row", text: channel }), make("td", {}, input), make("td", {}, make("span", { class: "quiet", text: machine.map[channel] ? "by hand" : "proposed" })));
  });
  const adder = make("select", { "aria-label": "add a channel" }, make("option", { value: "", text: "add a channel by a formula …" }), ...[...byId("channel-options").content.cloneNode(true).children].filter((option) => !map[option.value]));
  adder.addEventListener("change", () => {
    const input = make("input", { placeholder: "ch2*0.0625-0.625 bar", "aria-label": `formula of ${adder.value}` });
    const channel = adder.value;
    input.addEventListener("change", () => change(() => ({ map: { ...statedMap(), [channel]: input.value } })));
    byId("map-table").tBodies[0].append(make("tr", {}, make("th", { scope: "row", text: channel }), make("td", {}, input), make("td")));
    input.focus();
  });
  byId("map-table").tBodies[0].replaceChildren(...rows, make("tr", {}, make("td", { colspan: "3" }, adder)));
  seen = await ask("channels", { machine: machine.name, file: app.file }).catch((error) => ({ error: error.message, channels: [], findings: [] }));
  const { svg } = await ask("drawing", { machine: machine.name, channels: seen.channels.join(",") });
  const parsed = new DOMParser().parseFromString(svg, "text/html").querySelector("svg");
  const title = parsed.querySelector("title");
  parsed.setAttribute("role", "group");
  parsed.removeAttribute("aria-labelledby");
  parsed.setAttribute("aria-label", `${title ? title.textContent : "The machine"}: places of its channels`);
  byId("drawing").replaceChildren(parsed);
  const inDrawing = new Set();
  for (const target of parsed.querySelectorAll("[data-channel]")) { inDrawing.add(target.dataset.channel); place(target, target.dataset.channel); }
  const others = [...byId("channel-options").content.children].map((option) => option.value).filter((channel) => !inDrawing.has(channel) && channel !== "q_comp");
  byId("places").replaceChildren(...others.map((channel) => {
    const button = make("button", { type: "button", class: "small", text: `${channel}${map[channel] ? ` = ${map[channel]}` : ""}` });
    place(button, channel);
    return button;
  }));
  showChecks();
}

function showChecks() {
  const list = byId("checks");
  if (seen.error) {
    list.replaceChildren(make("li", { class: "bad", text: seen.error }));
    link.close();
    byId("check-charts").replaceChildren();
    drawnFor = "";
    return;
  }
  const items = seen.findings.map((finding) => make("li", { class: finding.severity }, make("span", { text: `${finding.severity}: ${finding.text} ` }),
    finding.t === null ? null : make("button", { type: "button", class: "small", text: "show", "aria-label": `show ${finding.text}`, onclick: () => link.move(finding.t - 2, finding.t + 2) })));
  list.replaceChildren(make("li", { class: "fine", text: `Read: ${seen.channels.map((channel) => `${channel} [${seen.units[channel]}]`).join(", ")}` }), ...items, ...(items.length ? [] : [make("li", { class: "fine", text: "No defect of the data was found." })]));
  draw();
}

async function draw() {
  const machine = machineNow();
  const now = JSON.stringify([app.file, machine, seen.channels]);
  if (now === drawnFor) return;
  drawnFor = now;
  link.close();
  link = new Linked();
  const place = byId("check-charts");
  place.replaceChildren();
  byId("compared").replaceChildren();
  const base = { file: app.file, machine: machine.name };
  const head = await ask("window", { ...base, table: "channels", columns: "", pixels: 10 });
  if (now !== drawnFor) return;
  const groups = {};
  head.names.forEach((name, column) => (groups[/\[(.*)\]$/.exec(name)?.[1] || ""] ||= []).push({ name: bare(name), column }));
  const tones = { p_A: "--side-a", p_B: "--side-b", p_1: "--d1", p_2: "--d4", x: "--piston", omega: "--d3", theta: "--d2", u: "--d4", T_oil: "--oil" };
  const marks = seen.findings.flatMap((finding) => finding.places.map((t, k) => ({ t, label: k ? "" : finding.text.slice(0, 40), channel: finding.channel })));
  const query = (table, wanted) => (begin, end, pixels) => ask("window", { ...base, table, columns: wanted.join(","), pixels, ...(begin === null ? {} : { from: begin, to: end }) });
  const volumes = make("div"), checks = make("div", { class: "checks-drawn" }, make("p", { class: "quiet", text: "Comparing the channels …" }));
  place.append(checks, volumes);
  for (const [unit, members] of Object.entries(groups)) {
    const lines = members.map((member, k) => ({ name: member.name, colour: tones[member.name] || "--ink", column: k }));
    new Trace(place, link, { title: members.map((member) => member.name).join(", "), unit, lines, fetch: query("channels", members.map((member) => member.column)), marks: marks.filter((mark) => members.some((member) => member.name === mark.channel) || mark.channel === null), height: 150 });
  }
  if (!head.names.length) place.append(make("p", { class: "quiet", text: head.error || "Nothing to draw." }));
  const list = byId("compared"), note = (text, kind) => list.append(make("li", { class: kind || "fine", text }));
  try {
    const { about, error } = await settled({ ...base, table: "balance" }, () => drawnFor === now);
    if (drawnFor !== now) return;
    checks.replaceChildren();
    if (error || about.problem) note(error || about.problem, "warning");
    for (const check of about.checks || []) {
      const plot = checkPlot(check);
      if (plot) checks.append(plot);
      if (!plot || check.severity) note(check.text, check.severity);
    }
    for (const { chamber, names, first, moved_by: moved, closure, leaked } of about.groups || []) {
      if (closure === null) continue;
      const where = chamber ? ` of chamber ${chamber}` : "", title = `Volume${where}: ${names[0]} and ${moved} must close`;
      note(`${title}; they do within ${Number((100 * closure).toPrecision(2))} % of the largest volume, beside ${litres(leaked)} ${about.volume_unit} that leaks.`, closure < 0.05 ? "fine" : "warning");
      const lines = [{ name: names[0], colour: "--total", column: 0, width: 2 }, { name: moved, colour: "--side-b", column: 1, dash: [6, 4] }];
      new Trace(volumes, link, { title, unit: about.volume_unit, lines, fetch: query("volumes", [first, first + names.indexOf(moved)]), height: 200 });
    }
  } catch (error) { note(error.message, "warning"); }
}

function fillSizes(machine) {
  const fields = byId("sizes").elements;
  for (const name of ["name", "bore", "rod", "rods", "displacement", "limit", "rate"]) if (document.activeElement !== fields[name]) fields[name].value = machine[name] ?? "";
  [fields.area_a.value, fields.area_b.value] = [machine.area[0] || "", machine.area[1] || ""];
}
byId("channels-done").addEventListener("click", () => go("healthy"));
byId("channel-file").addEventListener("change", (event) => go("channels", event.target.value));
byId("sizes").addEventListener("submit", (event) => event.preventDefault());
byId("sizes").addEventListener("change", async (event) => {
  const fields = byId("sizes").elements;
  const name = event.target.name;
  if (name === "rpm" || name === "limit") {
    try {
      const limit = await ask("limit", { text: fields.limit.value, machine: app.machine, rpm: fields.rpm.value });
      byId("limit-words").textContent = `Repair at ${limit.words}${limit.lpm === null ? "" : `, ${Number(limit.lpm.toPrecision(3))} L/min`}.`;
      await change(() => ({ limit: limit.text || "" }));
    } catch (error) { byId("limit-words").textContent = error.message; }
    return;
  }
  const values = name.startsWith("area") ? { area: [fields.area_a.value, fields.area_b.value].filter(Boolean) } : { [name]: event.target.value };
  await change(() => values);
  if (machineNow()) fillSizes(machineNow());
});
