// The screen of the healthy days: what duty they cover, commissioning, and what was learnt.
import { app, ask, attempt, dateOf, ensureMachine, go, lengthOf, machineNow, make, miniature, rowsRead, tell } from "./main.mjs";
const BINS = 6;
const DUTIES = [
  ["oil_degC", "Oil temperature", "°C"],
  ["load_bar", "Load", "bar"],
  ["speed", "Speed", ""],
  ["moving", "Share in motion", "%"],
  ["minutes", "Length", "min"],
];
let learntFor = "";

export async function show() {
  await ensureMachine();
  learntFor = "";
  update();
}

const valueOf = (row, name) => (row.duty[name] === null ? null : name === "moving" ? 100 * row.duty.moving : row.duty[name]);

export function update() {
  const machine = machineNow();
  if (!machine) return;
  const rows = rowsRead();
  const ticked = new Set(machine.healthy);
  const healthy = rows.filter((row) => ticked.has(row.key));
  byId("commission").textContent = `Commission ${machine.name} from ${healthy.length} ${healthy.length === 1 ? "day" : "days"}`;
  byId("commission").disabled = !healthy.length || app.jobs.some((job) => job.kind === "commission" && ["running", "waiting"].includes(job.state));
  showCoverage(rows, ticked);
  showDays(rows, machine, ticked);
  showLearnt(machine);
}

function showCoverage(rows, ticked) {
  byId("coverage").replaceChildren(...DUTIES.map(([name, words, stated]) => {
    const known = rows.filter((row) => valueOf(row, name) !== null);
    const unit = name === "speed" ? known[0]?.duty.speed_unit || "" : stated;
    const figure = make("figure", {}, make("figcaption", { text: words }));
    if (!known.length) { figure.append(make("p", { class: "quiet", text: "not recorded" })); return figure; }
    const values = known.map((row) => valueOf(row, name));
    // at least a fifth of the largest value wide: equal days are equal
    const [least, most] = [Math.min(...values), Math.max(...values)];
    const half = Math.max(most - least, 0.2 * Math.max(Math.abs(least), Math.abs(most)), 1e-9) / 2;
    const [low, high] = [(least + most) / 2 - half, (least + most) / 2 + half];
    const width = (high - low) / BINS || 1;
    const bin = (value) => Math.max(0, Math.min(BINS - 1, Math.floor((value - low) / width)));
    const counts = Array.from({ length: BINS }, () => [0, 0]);
    for (const row of known) counts[bin(valueOf(row, name))][ticked.has(row.key) ? 0 : 1] += 1;
    const cells = make("div", { class: "cells", role: "img", "aria-label": `${words}: ${counts.map(([yes, no], k) => `${(low + k * width).toPrecision(3)} to ${(low + (k + 1) * width).toPrecision(3)} ${unit}: ${yes} healthy, ${no} other`).join("; ")}` },
      ...counts.map(([yes, no]) => make("span", { class: yes ? "" : no ? "empty missing" : "empty", text: yes || "", title: yes ? `${yes} healthy days` : no ? `${no} logs, no healthy day` : "never seen" })));
    figure.append(cells, make("div", { class: "ends" }, make("span", { text: `${Number(low.toPrecision(3))} ${unit}` }), make("span", { text: `${Number(high.toPrecision(3))} ${unit}` })));
    return figure;
  }), make("p", { class: "quiet legend", text: "Number of healthy days; hatched: never seen healthy; red frame: other logs lie there, so that they are judged with less certainty." }));
}

function showDays(rows, machine, ticked) {
  const rejected = new Set(machine.rejected);
  byId("day-count").textContent = `${rows.length} logs, ${ticked.size} ticked as healthy`;
  byId("day-table").tBodies[0].replaceChildren(...rows.map((row) => {
    const box = make("input", { type: "checkbox", "aria-label": `${row.name} is healthy`, "data-key": row.key });
    box.checked = ticked.has(row.key);
    box.addEventListener("change", () => mark([row.key], box.checked ? "healthy" : ""));
    const duty = DUTIES.map(([name, , unit]) => {
      const value = valueOf(row, name);
      if (value === null) return "–";
      return name === "minutes" ? lengthOf(60 * value) : `${Number(value.toPrecision(3))} ${name === "speed" ? row.duty.speed_unit : unit}`;
    }).join(" · ");
    const reject = make("button", { type: "button", class: "small", text: rejected.has(row.key) ? "Rejected: take back" : "Reject", "aria-label": `${rejected.has(row.key) ? "take back" : "reject"} ${row.name}`, onclick: () => mark([row.key], rejected.has(row.key) ? "" : "rejected") });
    return make("tr", {}, make("td", {}, box), make("th", { scope: "row" }, make("span", { class: "name", text: row.name }), make("span", { class: "quiet", text: dateOf(row) })), make("td", {}, miniature(row.picture, `Course of ${row.name}`)), make("td", { text: duty }), make("td", {}, reject));
  }));
}

const mark = (files, value) => attempt(() => tell("mark", { machine: app.machine, files, mark: value }));

async function showLearnt(machine) {
  const now = `${machine.name}|${machine.commissioned}|${app.version}`;
  if (learntFor === now) return;
  learntFor = now;
  const place = byId("learnt");
  const learnt = machine.commissioned ? await ask("learnt", { machine: machine.name }).catch((error) => ({ known: false, error: error.message })) : { known: false };
  place.hidden = !learnt.known;
  if (!learnt.known) return;
  const smallest = learnt.smallest;
  const share = smallest ? `${Number((100 * smallest.share).toPrecision(2))} % of the pump’s flow` : "";
  const size = !smallest ? "not known" : smallest.lpm === null ? share : `${Number((1000 * smallest.lpm).toPrecision(2))} mL/min`;
  const half = !smallest ? "" : smallest.halved_by === null ? "More healthy days alone do not halve this: twice the load does." : `${smallest.halved_by * learnt.count} healthy days instead of ${learnt.count} would halve this.`;
  const keyOf = (file) => app.keys.find((key) => key === file || key.endsWith(`/${file}`) || app.rows.get(key)?.name === file);
  const outliers = [...learnt.left_out.map((text) => [text.split(":")[0], text, true]), ...Object.entries(learnt.problems).flatMap(([file, texts]) => texts.map((text) => [file, `${file}: ${text}`, false]))];
  place.replaceChildren(
    make("h3", { text: `${machine.name} is commissioned from ${learnt.count} days` }),
    make("div", { class: "figures" }, make("span", {}, make("span", { class: "quiet", text: "Smallest leak that the next recording will show: " }), make("span", { class: "big", text: size }), make("span", { class: "quiet", text: smallest && smallest.lpm !== null ? ` (${share})` : "" })), make("span", { text: half })),
    outliers.length ? make("h4", { text: "Days that stand out" }) : make("p", { class: "fine", text: "No day stands out of the others." }),
    make("ul", {}, ...outliers.map(([file, text, out]) => make("li", { class: out ? "bad" : "warning" }, make("span", { text: `${text} ` }), keyOf(file) ? make("button", { type: "button", class: "small", text: "see where", "aria-label": `see where ${file} stands out`, onclick: () => judgeAndGo(keyOf(file)) }) : null))),
    make("p", {}, make("span", { text: `Saved as ${learnt.file} beside the session. Save a copy: ` }), make("a", { href: `/machine/${encodeURIComponent(learnt.file)}`, download: learnt.file, text: learnt.file }), make("span", { text: ", " }), make("a", { href: `/machine/${encodeURIComponent(learnt.file.replace(/toml$/, "healthy"))}`, download: "", text: "its summaries" })),
    make("details", {}, make("summary", { text: "What was learnt" }), make("pre", { text: learnt.text, tabindex: "0", "aria-label": "What was learnt" })),
    make("button", { type: "button", class: "main", text: "Go on to the verdicts", onclick: () => go("verdict") }),
  );
}

const judgeAndGo = (key) => attempt(async () => { await tell("judge", { machine: app.machine, files: [key] }); go("verdict", key); });
byId("commission").addEventListener("click", () => attempt(() => tell("commission", { machine: app.machine })));
byId("tick-all").addEventListener("click", () => mark(rowsRead().filter((row) => !machineNow().rejected.includes(row.key)).map((row) => row.key), "healthy"));
byId("tick-none").addEventListener("click", () => mark(rowsRead().map((row) => row.key), ""));
