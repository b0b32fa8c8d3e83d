// The screen of the healthy days: what duty they cover, commissioning, and what was learnt.
import { app, ask, attempt, ensureMachine, go, machineNow, make, miniature, rowsRead, tell } from "./main.mjs";
let learntFor = "";

export async function show() {
  await ensureMachine();
  learntFor = "";
  update();
}

export function update() {
  const machine = machineNow();
  if (!machine) return;
  const rows = rowsRead();
  const ticked = new Set(machine.healthy);
  const healthy = rows.filter((row) => ticked.has(row.key));
  byId("commission").textContent = `Commission ${machine.name} from ${healthy.length} ${healthy.length === 1 ? "day" : "days"}`;
  byId("commission").disabled = !healthy.length || app.jobs.some((job) => job.kind === "commission" && ["running", "waiting"].includes(job.state));
  showCoverage(machine.cover);
  showDays(rows, machine, ticked);
  showLearnt(machine);
}

function showCoverage(cover) {
  byId("coverage").replaceChildren(...cover.map(({ name, unit, edges, counts }) => {
    const figure = make("figure", {}, make("figcaption", { text: name }));
    if (!counts.length) { figure.append(make("p", { class: "quiet", text: "not recorded" })); return figure; }
    const cells = make("div", { class: "cells", role: "img", "aria-label": `${name}: ${counts.map(([yes, no], k) => `${edges[k]} to ${edges[k + 1]} ${unit}: ${yes} healthy, ${no} other`).join("; ")}` },
      ...counts.map(([yes, no]) => make("span", { class: yes ? "" : no ? "empty missing" : "empty", text: yes || "", title: yes ? `${yes} healthy days` : no ? `${no} logs, no healthy day` : "never seen" })));
    figure.append(cells, make("div", { class: "ends" }, make("span", { text: `${edges[0]} ${unit}` }), make("span", { text: `${edges[edges.length - 1]} ${unit}` })));
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
    const reject = make("button", { type: "button", class: "small", text: rejected.has(row.key) ? "Rejected: take back" : "Reject", "aria-label": `${rejected.has(row.key) ? "take back" : "reject"} ${row.name}`, onclick: () => mark([row.key], rejected.has(row.key) ? "" : "rejected") });
    return make("tr", {}, make("td", {}, box), make("th", { scope: "row" }, make("span", { class: "name", text: row.name }), make("span", { class: "quiet", text: row.date })), make("td", {}, miniature(row.picture, `Course of ${row.name}`)), make("td", { text: row.duty_words }), make("td", {}, reject));
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
  byId("commission").classList.toggle("main", !learnt.known); // one next step on a screen
  if (!learnt.known) return;
  const keyOf = (file) => app.keys.find((key) => key === file || key.endsWith(`/${file}`) || app.rows.get(key)?.name === file);
  const outliers = [...learnt.left_out.map((text) => [text.split(":")[0], text, true]), ...Object.entries(learnt.problems).flatMap(([file, texts]) => texts.map((text) => [file, `${file}: ${text}`, false]))];
  place.replaceChildren(
    make("h3", { text: `${machine.name} is commissioned from ${learnt.count} days` }),
    make("div", { class: "figures" }, make("span", {}, make("span", { class: "quiet", text: "Smallest leak that the next recording will show: " }), make("span", { class: "big", text: learnt.size })), make("span", { text: learnt.half })),
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
