// The screen of the hold test: a clock, what is stated, the result against the limit, and its page.
import { app, ask, attempt, ensureMachine, fillSelect, go, machineNow, make, tell } from "./main.mjs";
import { Linked, Trace } from "./charts.mjs";
let link = new Linked(), ticking = 0, withoutLog = false, filled = "";

export async function show() {
  const machine = await ensureMachine();
  if (machine.name !== filled) for (const input of byId("hold-form").querySelectorAll("input")) input.value = machine.hold[input.name] || "";
  filled = machine.name; // another log keeps what was typed
  update();
}

function clear() {
  link.close();
  link = new Linked();
  byId("hold-results").replaceChildren();
  byId("hold-state").textContent = "";
}

export function update() { fillSelect(byId("hold-file"), [["", "no log"], ...app.keys.map((key) => [key, app.rows.get(key)?.name || key])], withoutLog ? "" : app.file); }

async function judge(again) {
  const file = byId("hold-file").value;
  const machine = machineNow();
  const { results } = await ask("hold", { machine: machine.name, file });
  clear();
  const place = byId("hold-results");
  for (const result of results) {
    const words = { pass: "passes", fail: "fails", undecided: "undecided" }[result.result] || "no limit stated";
    const page = make("p", { role: "status" });
    const write = () => attempt(async () => {
      const written = await tell("hold-page", { machine: machine.name, file });
      page.replaceChildren(make("a", { href: written.address, target: "_blank", rel: "noopener", text: `reports/${written.page}` }));
    });
    const tone = { pass: "fine", fail: "bad", undecided: "warning" }[result.result] || "";
    place.append(make("div", { class: "panel" }, make("p", { class: `verdict-line ${tone}`, text: `${words}${result.limit ? `, limit ${result.limit}` : ""}` }), make("p", { text: result.reason }), make("pre", { text: result.text, tabindex: "0", "aria-label": "Result" }), make("button", { type: "button", text: "Write the page", onclick: write }), page));
    if (!result.curve) continue;
    const { t, values, fit, low, high, channel, unit } = result.curve;
    const held = new Linked();
    Object.assign(held, { first: t[0], last: t[t.length - 1], begin: t[0], end: t[t.length - 1] });
    const lines = [["read", "--total"], ["fit", "--leak"], ["lower bound", "--quiet"], ["upper bound", "--quiet"]].map(([name, tone], column) => ({ name, colour: tone, column, dash: column > 1 ? [3, 3] : undefined }));
    link.charts.push(new Trace(place, held, { title: `${channel === "x" ? "Travel of the held load, positive as it sinks" : `${channel} of the held load`}, and its fit`, unit, lines, fetch: async () => ({ t, lines: [values, fit, low, high], first: held.first, last: held.last, complete: true }) }));
  }
  const lacksArea = results.some((result) => result.leak_lpm === null && result.creep_mm_per_min !== null);
  const done = again ? "Judged again while the log grows." : `${results.length} ${results.length === 1 ? "hold" : "holds"} judged.`;
  byId("hold-state").textContent = done + (lacksArea ? " For mL/min state the piston's area, on the screen Channels." : "");
}
byId("hold-form").addEventListener("submit", (event) => {
  event.preventDefault();
  clear(); // an error must not stand above the result of another log
  const hold = Object.fromEntries([...byId("hold-form").querySelectorAll("input")].map((input) => [input.name, input.value]));
  attempt(async () => { await tell("machine", { machine: app.machine, values: { hold } }); await judge(false); });
});
byId("hold-file").addEventListener("change", ({ target }) => { clear(); withoutLog = !target.value; if (target.value) go("hold", target.value); });
byId("hold-start").addEventListener("click", () => {
  clearInterval(ticking);
  const end = Date.now() + 60000 * (Number(byId("hold-minutes").value.replace(",", ".")) || 10);
  let count = 0;
  ticking = setInterval(() => {
    const left = Math.max(0, Math.round((end - Date.now()) / 1000));
    byId("hold-clock").textContent = `${Math.floor(left / 60)}:${String(left % 60).padStart(2, "0")}`;
    const live = byId("hold-file").value && byId("hold-results").childElementCount;
    if (live && (++count % 15 === 0 || !left)) judge(true).catch((error) => (byId("hold-state").textContent = error.message));
    if (!left) { clearInterval(ticking); byId("hold-state").textContent = "The time is over: judge the hold."; }
  }, 1000);
});
