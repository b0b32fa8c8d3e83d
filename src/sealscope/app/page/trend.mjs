// The screen of the trends: machines beside each other, repairs, and the folder that is watched from now on.
import { app, ask, attempt, ensureMachine, machineNow, make, tell } from "./main.mjs";
import { dotPlot } from "./charts.mjs";
const chosen = new Set();

export async function show() {
  await ensureMachine();
  if (!chosen.size && app.machine) chosen.add(app.machine);
  await update();
}

export async function update() {
  byId("trend-machines").replaceChildren(...app.machines.map((machine) => {
    const box = make("input", { type: "checkbox" });
    box.checked = chosen.has(machine.name);
    box.addEventListener("change", () => { if (box.checked) chosen.add(machine.name); else chosen.delete(machine.name); update(); });
    return make("label", {}, box, make("span", { text: machine.name }));
  }));
  const kind = byId("trend-kind").value, names = app.machines.map((machine) => machine.name).filter((name) => chosen.has(name));
  const trends = await Promise.all(names.map((name) => ask("trend", { machine: name, kind })));
  byId("trend-charts").replaceChildren(...names.flatMap((name, k) => {
    const trend = trends[k], page = make("p", { role: "status" });
    const repairs = [...trend.repairs.map((date) => Date.parse(date) / 1000), ...trend.seen].filter(Number.isFinite);
    return [
      dotPlot(trend.points, { title: `Leakage of ${name}`, unit: trend.unit, limit: trend.limit, log: byId("trend-log").checked, join: true, repairs }),
      make("p", { text: trend.words }), make("p", { class: "quiet", text: trend.limit_words }),
      trend.remarks.length ? make("details", {}, make("summary", { text: `${trend.remarks.length} remarks` }), make("ul", {}, ...trend.remarks.map((text) => make("li", { text })))) : "",
      trend.known ? make("button", { type: "button", text: `Write the page of ${name}’s trend`, onclick: () => attempt(async () => {
        const written = await tell("trend-page", { machine: name });
        page.replaceChildren(make("a", { href: written.address, target: "_blank", rel: "noopener", text: `reports/${written.page}` }));
      }) }) : "",
      page,
    ];
  }));
}
byId("trend-form").addEventListener("submit", (event) => { event.preventDefault(); attempt(() => tell("trend", { machines: [...chosen] })); });
byId("trend-kind").addEventListener("change", update);
byId("trend-log").addEventListener("change", update);
byId("repair-form").addEventListener("submit", (event) => {
  event.preventDefault();
  const machine = machineNow();
  attempt(() => tell("machine", { machine: machine.name, values: { repairs: [...machine.repairs, byId("repair-date").value] } }));
});
byId("watch-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const answer = await attempt(() => tell("watch", { machine: app.machine, folder: byId("watch-folder").value }));
  if (answer) byId("watch-answer").textContent = `Written: sealscope monitor '${answer.file}'`;
});
