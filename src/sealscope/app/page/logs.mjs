// The screen of the logs: folders and dropped files, what each holds, and logs that are read differently.
import { app, ask, attempt, go, make, miniature, refresh, say, tell } from "./main.mjs";
const PIECE = 4_000_000;
let mended = "", previewed = null, typing = 0;

export function show() { update(); }

export function update() {
  const body = byId("log-table").tBodies[0];
  const kept = new Map([...body.rows].map((row) => [row.dataset.key, row]));
  const wanted = app.keys.map((key) => app.rows.get(key)).filter(Boolean);
  const rows = wanted.map((row) => { const known = kept.get(row.key); return known && known.dataset.version === String(row.version) ? known : rowOf(row); });
  const unchanged = rows.length === body.rows.length && rows.every((row, k) => body.rows[k] === row);
  if (!unchanged) body.replaceChildren(...rows);
  const bad = wanted.filter((row) => row.state === "unreadable").length;
  const unread = wanted.filter((row) => !["read", "unreadable"].includes(row.state)).length;
  byId("log-count").textContent = wanted.length ? `${wanted.length} logs${unread ? `, ${unread} not read yet` : ""}${bad ? `, ${bad} cannot be read` : ""}` : "No logs yet.";
  byId("sources").replaceChildren(
    ...app.sources.map((source) => make("span", { text: source === "." ? "this folder" : source }, make("button", { type: "button", text: "✕", "aria-label": `Close ${source}`, onclick: () => attempt(() => tell("close", { source })) }))),
    ...app.problems.map(([source, problem]) => make("span", { class: "bad", text: `${source}: ${problem}` })),
  );
}

function rowOf(row) {
  const made = make("tr", { "data-key": row.key, "data-version": row.version });
  const name = make("th", { scope: "row" }, make("span", { class: "name", text: row.name }), row.mended ? make("span", { class: "quiet", text: "read differently" }) : null);
  const open = make("button", { type: "button", class: "small", text: "See", "aria-label": `See ${row.name}`, onclick: () => go("channels", row.key) });
  const mend = make("button", { type: "button", class: "small", text: "Read differently", "aria-label": `Read ${row.name} differently`, onclick: () => showMend(row.key) });
  if (row.state === "unreadable") {
    made.append(make("td", { text: "–" }), name, make("td", { colspan: "4", class: "bad", text: row.error }), make("td", {}, mend));
    return made;
  }
  if (row.state !== "read") {
    made.append(make("td", { text: "…" }), name, make("td", { text: row.date }), make("td", { text: `${(row.size / 1e6).toFixed(1)} MB` }), make("td", { text: "reading" }), make("td"), make("td", {}, mend));
    return made;
  }
  const grave = row.findings.filter((finding) => finding.severity !== "note");
  const findings = make("td", { "data-head": "Findings" });
  if (!row.findings.length) findings.append(make("span", { class: "fine", text: "none" }));
  else {
    const list = make("ul", {}, ...row.findings.map((finding) => make("li", { class: finding.severity, text: `${finding.severity}: ${finding.text}` })));
    const count = grave.length ? `${grave.length} to check` : `${row.findings.length} notes`;
    findings.append(make("details", {}, make("summary", { class: grave.length ? "warning" : "", text: count }), list));
  }
  const unused = row.unused.length ? make("span", { class: "quiet", text: ` not used: ${row.unused.join(", ")}` }) : null;
  made.append(make("td", {}, miniature(row.picture, `Course of ${Object.keys(row.picture).join(", ")} in ${row.name}`)), name, make("td", { text: row.date }), make("td", { text: `${row.length} at ${Number(row.rate.toPrecision(5))} Hz` }), make("td", { text: row.channels.join(", ") }, unused), findings, make("td", {}, open, " ", mend));
  return made;
}
// ---- files that are dropped: in pieces, each at its offset, resumed after a break

async function take(file) {
  const item = make("li", {}, make("span", { text: `${file.name} ` }));
  const bar = make("progress", { max: file.size || 1, value: "0", "aria-label": `taking in ${file.name}` });
  item.append(bar);
  byId("uploads").append(item);
  const query = (offset) => new URLSearchParams({ name: file.name, size: file.size, ...(offset === undefined ? {} : { offset }) });
  let failures = 0;
  let offset = null;
  while (offset === null || offset < file.size) {
    try {
      if (offset === null) ({ offset } = await ask("drop", Object.fromEntries(query())));
      if (offset >= file.size) break;
      const answer = await fetch(`/api/drop?${query(offset)}`, { method: "PUT", headers: { "X-Sealscope": "app" }, body: file.slice(offset, offset + PIECE) });
      const values = await answer.json();
      if (!answer.ok && answer.status !== 409) throw Object.assign(new Error(values.error), { final: answer.status < 500 });
      offset = values.offset;
      failures = 0;
      bar.value = offset;
    } catch (error) {
      failures += 1;
      if (error.final || failures > 20) { item.append(make("span", { class: "bad", text: ` ${error.message}` })); return; }
      offset = null;
      await new Promise((later) => setTimeout(later, 300 * failures));
    }
  }
  item.remove();
}

async function takeAll(files) { say(""); for (const file of files) await take(file); await refresh(); }
byId("drop-files").addEventListener("change", (event) => takeAll([...event.target.files]).finally(() => (event.target.value = "")));
const drop = byId("drop");
for (const kind of ["dragover", "dragleave", "drop"]) {
  drop.addEventListener(kind, (event) => {
    event.preventDefault();
    drop.classList.toggle("over", kind === "dragover");
    if (kind === "drop") takeAll([...event.dataTransfer.files]);
  });
}
byId("open").addEventListener("submit", async (event) => {
  event.preventDefault();
  if (await attempt(() => tell("open", { path: byId("open-path").value }))) byId("open-path").value = "";
});
// ---- a log that is read differently

function openMend(open) { byId("mend").hidden = !open; byId("open").lastElementChild.classList.toggle("main", !open); }
async function showMend(key) {
  mended = key;
  openMend(true);
  byId("mend-title").textContent = `Read ${app.rows.get(key).name} differently`;
  byId("mend-form").reset();
  await preview();
  byId("mend").scrollIntoView({ block: "start" });
  byId("mend-form").elements.first_row.focus();
}

const layout = () => Object.fromEntries(new FormData(byId("mend-form")));

async function preview() {
  try {
    const asked = (previewed = Symbol()), seen = await ask("preview", { file: mended, ...layout() });
    if (asked !== previewed) return; // the fields were changed meanwhile
    const { first_row: first, heading_row: heading } = seen.layout;
    byId("mend-lines").replaceChildren(...seen.lines.map((line, k) => make("li", { class: k + 1 === first ? "first" : k + 1 === heading ? "heading" : "", text: line || " ", "data-line": k + 1 })));
    byId("mend-rows").replaceChildren(
      make("caption", { text: `from line ${first}, headings in line ${heading || "none"}` }),
      make("thead", {}, make("tr", {}, ...seen.heading.map((name) => make("th", { scope: "col", text: name })))),
      make("tbody", {}, ...seen.rows.map((row) => make("tr", {}, ...row.map((cell) => make("td", { text: cell }))))),
    );
    byId("mend-problem").textContent = seen.problem;
    byId("mend-problem").className = seen.problem ? "bad" : "";
  } catch (error) { byId("mend-problem").textContent = error.message; byId("mend-problem").className = "bad"; }
}

byId("mend-form").addEventListener("input", () => { clearTimeout(typing); typing = setTimeout(preview, 250); });
byId("mend-lines").addEventListener("click", (event) => {
  if (!event.target.dataset.line) return;
  byId("mend-form").elements.first_row.value = event.target.dataset.line;
  preview();
});
byId("mend-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  if (await attempt(() => tell("mend", { file: mended, layout: layout() }))) openMend(false);
});
byId("mend-close").addEventListener("click", () => openMend(false));
