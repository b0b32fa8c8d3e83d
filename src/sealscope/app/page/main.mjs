// The frame of the workbench: its state, its screens, the jobs, and the commands that do the same.
import * as logs from "./logs.mjs";
import * as channels from "./channels.mjs";
import * as healthy from "./healthy.mjs";
import * as verdict from "./verdict.mjs";
import * as trend from "./trend.mjs";
import * as hold from "./hold.mjs";
const screens = { logs, channels, healthy, verdict, trend, hold };
export const app = { version: -1, rows: new Map(), keys: [], machines: [], jobs: [], sources: [], problems: [], screen: "logs", machine: "", file: "" };

export function make(kind, values = {}, ...children) {
  const made = element(kind, values.class, values.text);
  for (const [name, value] of Object.entries(values)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (!["class", "text"].includes(name) && value !== undefined && value !== null && value !== false) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined && child !== ""));
  return made;
}

export function drawn(kind, values = {}, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", kind);
  for (const [name, value] of Object.entries(values)) if (value !== undefined && value !== null) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

export function say(problem) { byId("problem").textContent = problem || ""; byId("problem").hidden = !problem; }

async function answerOf(request) {
  let answer;
  try {
    answer = await request;
  } catch { throw new Error("the workbench does not answer: start it anew with sealscope app"); }
  const values = await answer.json().catch(() => ({ error: `the answer cannot be read (${answer.status})` }));
  if (!answer.ok) throw new Error(values.error || `refused (${answer.status})`);
  return values;
}
export const ask = (what, query = {}) => answerOf(fetch(`/api/${what}?${new URLSearchParams(query)}`));
export const tell = (what, values = {}) =>
  answerOf(fetch(`/api/${what}`, { method: "POST", headers: { "Content-Type": "application/json", "X-Sealscope": "app" }, body: JSON.stringify(values) }));
// do what a person asked for; an error is shown above the screen
export async function attempt(work) {
  say("");
  try {
    const value = await work();
    await refresh();
    return value === undefined ? true : value;
  } catch (error) { say(error.message); return null; }
}
export const machineNow = () => app.machines.find((machine) => machine.name === app.machine) || null;
export const rowsRead = () => app.keys.map((key) => app.rows.get(key)).filter((row) => row && row.state === "read");
// a small picture of minima and maxima, 0 .. 1, of each line
export function miniature(picture, label) {
  const svg = drawn("svg", { class: "mini", viewBox: "0 0 100 100", preserveAspectRatio: "none", role: "img", "aria-label": label });
  const lines = Object.entries(picture || {});
  const pressures = lines.filter(([name]) => name.startsWith("p_"));
  for (const [name, line] of pressures.length ? pressures : lines) {
    let path = "";
    line.forEach((value, k) => {
      if (value === null) return;
      const lifted = path && line[k - 1] !== null ? "L" : "M";
      path += `${lifted}${((100 * k) / Math.max(1, line.length - 1)).toFixed(1)} ${(95 - 90 * value).toFixed(1)}`;
    });
    svg.append(drawn("path", { class: /^(p_A|p_B|x)$/.test(name) ? name : "column", d: path || "M0 0" }));
  }
  return svg;
}

export function fillSelect(select, entries, value) {
  const wanted = JSON.stringify(entries);
  if (select.dataset.entries !== wanted) {
    select.dataset.entries = wanted;
    select.replaceChildren(...entries.map(([key, text]) => make("option", { value: key, text })));
  }
  if (entries.some(([key]) => key === value)) select.value = value;
}

export function go(screen, file = app.file, machine = app.machine) { location.hash = [screen, machine, file].map(encodeURIComponent).join("|"); }

let shown = "";
function follow() {
  const [screen, machine, file] = location.hash.slice(1).split("|").map(decodeURIComponent);
  app.screen = screen in screens ? screen : "logs";
  if (machine && app.machines.some((known) => known.name === machine)) app.machine = machine;
  if (file && app.rows.has(file)) app.file = file;
  for (const link of byId("screens").querySelectorAll("a")) {
    if (link.dataset.screen === app.screen) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
    link.href = `#${[link.dataset.screen, app.machine, app.file].map(encodeURIComponent).join("|")}`;
  }
  for (const name of Object.keys(screens)) byId(name).hidden = name !== app.screen;
  const now = [app.screen, app.machine, app.file].join("|");
  if (shown !== now) {
    shown = now;
    say("");
    document.title = `${byId(`${app.screen}-title`).textContent} – Sealscope workbench`;
    Promise.resolve(screens[app.screen].show()).catch((error) => say(error.message));
    showScript();
  }
}

async function showScript() {
  const wanted = shown, script = byId("script").open && await ask("script", { screen: app.screen, machine: app.machine, file: app.file }).catch((error) => ({ command: error.message, python: "", folder: "" }));
  if (!script || wanted !== shown) return; // closed, or another screen's
  byId("script-command").textContent = script.command;
  byId("script-python").textContent = script.python;
  byId("script-folder").textContent = script.folder;
}

function showJobs() {
  const busy = app.jobs.filter((job) => ["running", "waiting"].includes(job.state));
  const ended = app.jobs.filter((job) => job.state === "failed").slice(-1);
  const place = byId("jobs");
  place.replaceChildren(
    ...busy.map((job) => {
      const bar = make("progress", { max: Math.max(1, job.total), "aria-label": `progress: ${job.kind}` });
      if (job.state === "running") bar.value = job.done;
      const text = `${job.kind} ${job.subject}: ${job.state === "waiting" ? "waits" : `${job.done} of ${job.total} ${job.note}`}`;
      return make("div", {}, bar, make("span", { text }), make("button", { type: "button", class: "small", text: "Cancel", onclick: () => attempt(() => tell("cancel", { number: job.number, kind: job.kind })) }));
    }),
    ...ended.map((job) => make("div", { class: "bad", text: `${job.kind} ${job.subject}: ${job.error}` })),
  );
}

export async function refresh() {
  const state = await ask("state", { since: app.version });
  const changed = state.version !== app.version;
  for (const row of state.rows) app.rows.set(row.key, row);
  for (const key of [...app.rows.keys()]) if (!state.keys.includes(key)) app.rows.delete(key);
  Object.assign(app, { version: state.version, keys: state.keys, machines: state.machines, jobs: state.jobs, sources: state.sources, problems: state.problems });
  byId("folder").textContent = `Session in ${state.folder}`;
  if (!machineNow()) app.machine = app.machines.length ? app.machines[0].name : "";
  fillSelect(byId("machine"), app.machines.length ? app.machines.map((machine) => [machine.name, machine.name]) : [["", "none yet"]], app.machine);
  if (!app.rows.has(app.file)) app.file = app.keys[0] || "";
  showJobs();
  follow();
  if (changed) screens[app.screen].update();
  if (changed) showScript();
}

async function poll() {
  try {
    await refresh();
  } catch (error) { say(error.message); }
  const busy = app.jobs.some((job) => ["running", "waiting"].includes(job.state));
  setTimeout(poll, document.hidden ? 5000 : busy ? 500 : 2000);
}

export async function ensureMachine() {
  if (machineNow()) return machineNow();
  const made = await tell("machine", { machine: "machine", values: {} });
  app.machine = made.name;
  await refresh();
  return machineNow();
}
byId("machine").addEventListener("change", (event) => go(app.screen, app.file, event.target.value));
byId("new-machine").addEventListener("click", () =>
  attempt(async () => {
    const names = app.machines.map((machine) => machine.name);
    let number = 1;
    while (names.includes(`machine ${number}`)) number += 1;
    const made = await tell("machine", { machine: `machine ${number}`, values: {} });
    await refresh();
    go("channels", app.file, made.name);
  }),
);
byId("script").addEventListener("toggle", showScript);
for (const button of document.querySelectorAll("[data-copy]")) {
  button.addEventListener("click", async () => {
    await navigator.clipboard.writeText(byId(button.dataset.copy).textContent);
    byId("copied").textContent = "Copied.";
  });
}
addEventListener("hashchange", follow);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => screens[app.screen].show());
poll();
