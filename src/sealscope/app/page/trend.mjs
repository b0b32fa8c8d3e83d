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
  const recorded = byId("trend-kind").value === "recorded";
  const names = app.machines.map((machine) => machine.name).filter((name) => chosen.has(name));
  const trends = await Promise.all(names.map((name) => ask("trend", { machine: name })));
  byId("trend-charts").replaceChildren(...names.flatMap((name, k) => {
    const trend = trends[k];
    const repairs = [...trend.repairs.map((date) => Date.parse(date) / 1000), ...(trend.seen || [])].filter(Number.isFinite);
    const points = recorded
      ? trend.recorded.map((point) => ({ t: point.start, value: point.leak, bound: point.bound, leak: point.verdict === "leak", label: `${point.file}: ${point.leak === null ? (point.bound === null ? point.verdict : `below ${litres(point.bound)} L/min`) : `${litres(point.leak)} L/min`}` }))
      : (trend.points || []).filter((point) => point.value !== null).map((point) => ({ t: point.start, value: point.value, low: point.low, high: point.high, leak: trend.verdict === "leak" && trend.limit !== null && point.low > trend.limit, label: `${point.file}: ${litres(point.value)} ${trend.unit}` }));
    const unit = recorded || !trend.known ? "L/min" : `${trend.unit}${trend.pressure ? ` at ${litres(trend.pressure / 1e5)} bar` : ""}`;
    const leaking = trend.recorded.filter((point) => point.verdict === "leak").map((point) => point.file.split("/").pop()), single = leaking.length ? `Judged a leak by itself: ${leaking.join(", ")}; see Verdict. The trend compares means of whole recordings. ` : "";
    const words = single + (trend.known ? `${trend.verdict}: ${trend.reason}. ${leaking.length ? "" : trend.next}` : recorded ? "" : "Not estimated yet.");
    const page = make("p", { role: "status" }), left = (trend.points || []).filter((point) => point.note);
    return [
      make("h3", { text: name }),
      dotPlot(points, { title: `Leakage of ${name}`, unit, limit: recorded ? null : trend.limit, log: byId("trend-log").checked, join: true, repairs }),
      make("p", { text: words }),
      left.length ? make("details", {}, make("summary", { text: `${left.length} remarks` }), make("ul", {}, ...left.map((point) => make("li", { text: `${point.file}: ${point.note}` })))) : "",
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
