// The actuator drawn as it moves: from the channels that there are, at the speed at which it moved.
"use strict";

// the barrel's inner ends, the piston's width and the middle of the drawing, in its own units
const BORE = { left: 62, right: 338, piston: 14, middle: 200 };
const still = matchMedia("(prefers-reduced-motion: reduce)");
const twin = { name: null, motion: null, end: 0, at: 0, last: 0, frame: 0, flowed: 0, most: 1, reach: 1, machine: null, leak: null };

function showMachine(machine, summary, alarm) {
  twin.machine = machine;
  const known = summary.leak_lpm !== null && (alarm || (summary.leak_interval_lpm && summary.leak_interval_lpm[0] > 0));
  twin.leak = known ? { text: flow(summary.leak_lpm, summary.leak_interval_lpm), cause: alarm ? alarm.cause : "" } : null;
  byId("twin-rod-a").toggleAttribute("hidden", !machine.rods.includes("A"));
  byId("twin-rod-b").toggleAttribute("hidden", !machine.rods.includes("B"));
  byId("twin-pump").toggleAttribute("hidden", machine.valve);
  byId("twin-valve").toggleAttribute("hidden", !machine.valve);
  const leak = twin.leak;
  const outside = leak && leak.cause === "external leak";
  const pump = leak && leak.cause === "pump leak";
  byId("twin-leak").toggleAttribute("hidden", !leak || outside || pump);
  byId("twin-leak-pump").toggleAttribute("hidden", !pump);
  byId("twin-leak-out").toggleAttribute("hidden", !outside);
  const inside = "past the piston, or through the pump";
  const where = outside ? "to the outside" : pump ? "through the pump" : leak && leak.cause === "internal or external leak" ? `${inside}, or to the outside` : inside;
  byId("twin-leak-text").textContent = leak ? `leak ${leak.text}` : "";
  byId("twin-where").textContent = leak ? `Oil leaks ${leak.cause === "piston leak" ? "past the piston" : where}.` : "";
}

// a new actuator begins anew; else the drawing goes on from where it is to the newest samples
function showTwin(live) {
  const motion = live.motion && live.motion.t.length ? live.motion : null;
  if (live.name !== twin.name) Object.assign(twin, { name: live.name, at: -Infinity, most: 1, reach: 1 });
  twin.motion = motion;
  twin.end = live.t;
  const missing = [];
  if (motion) {
    if (!motion.x) missing.push("No position is recorded: the piston is drawn at mid-stroke and does not move.");
    if (!motion.v && !motion.rpm) missing.push("Neither position nor pump speed is recorded: the flow is not known.");
    for (const name of ["p_A", "p_B"]) {
      const most = Math.max(0, ...(motion[name] || []).filter((value) => value !== null));
      // the scale grows in steps of 1, 2, 5, 10, ... bar
      while (twin.most < most) twin.most *= twin.most.toString()[0] === "2" ? 2.5 : 2;
    }
    twin.reach = Math.max(twin.reach, ...(motion.x || []).filter((value) => value !== null).map(Math.abs));
    const newest = live.t, first = live.t + motion.t[0];
    // outside the recorded span the drawing goes on 1.5 s before the newest sample
    if (!(twin.at >= first && twin.at <= newest)) twin.at = Math.max(first, newest - 1.5);
    if (still.matches) twin.at = newest;
  }
  byId("twin-missing").textContent = missing.join(" ");
  byId("twin-scale-most").textContent = `${twin.most} bar`;
  // the text and the drawing change together, not the drawing a frame later
  cancelAnimationFrame(twin.frame);
  moveTwin(performance.now());
  describeTwin();
}

const between = (values, k, share) =>
  !values || values[k] === null || values[k + 1] === null ? null : values[k] + share * (values[k + 1] - values[k]);

function state() {
  const motion = twin.motion;
  if (!motion) return { x: null, p_A: null, p_B: null, rpm: null, flow: null };
  const past = twin.at - twin.end;
  let k = 0;
  while (k < motion.t.length - 2 && motion.t[k + 1] <= past) k += 1;
  const share = Math.min(1, Math.max(0, (past - motion.t[k]) / (motion.t[k + 1] - motion.t[k])));
  const value = (name) => between(motion[name], k, share);
  const speed = value("v");
  const rpm = value("rpm");
  const machine = twin.machine;
  // flow into chamber A [L/min], by the speed of the piston, else by that of the pump
  const litresAMinute = !machine ? null : speed !== null ? speed * machine.area : rpm !== null && !machine.valve ? rpm * machine.displacement : null;
  return { x: value("x"), p_A: value("p_A"), p_B: value("p_B"), rpm, flow: litresAMinute };
}

// draw the actuator at the time of this frame, and go on until the newest samples are drawn
function moveTwin(now) {
  twin.frame = 0;
  const passed = Math.min(0.1, Math.max(0, (now - twin.last) / 1000));
  twin.last = now;
  if (document.hidden) return;
  const newest = twin.motion ? twin.end + twin.motion.t[twin.motion.t.length - 1] : twin.at;
  if (!still.matches) twin.at = Math.min(newest, twin.at + passed);
  const is = state();
  const half = (BORE.right - BORE.left - BORE.piston) / 2;
  const stroke = Math.max(twin.machine ? twin.machine.stroke / 2 : 0, twin.reach);
  const at = BORE.middle + (is.x === null ? 0 : (half * Math.max(-stroke, Math.min(stroke, is.x))) / stroke);
  byId("twin-moving").setAttribute("transform", `translate(${at.toFixed(2)} 0)`);
  byId("twin-leak").setAttribute("transform", `translate(${at.toFixed(2)} 0)`);
  byId("twin-chamber-a").setAttribute("width", Math.max(0, at - BORE.piston / 2 - BORE.left).toFixed(2));
  byId("twin-chamber-b").setAttribute("x", (at + BORE.piston / 2).toFixed(2));
  byId("twin-chamber-b").setAttribute("width", Math.max(0, BORE.right - at - BORE.piston / 2).toFixed(2));
  for (const side of ["A", "B"]) {
    const pressure = is[`p_${side}`];
    const tone = pressure === null ? 0 : Math.max(0, Math.min(1, pressure / twin.most));
    for (const part of document.querySelectorAll(`[data-side="${side}"]`)) part.setAttribute("opacity", (0.06 + 0.94 * tone).toFixed(3));
    byId(`twin-p-${side.toLowerCase()}`).textContent = pressure === null ? (twin.motion ? "not recorded" : "–") : `${bar(pressure)} bar`;
  }
  byId("twin-x").textContent = is.x === null ? "x –" : `x ${is.x.toFixed(1)} mm`;
  const still_ = is.flow === null || Math.abs(is.flow) < 1e-3;
  byId("twin-flow").textContent = is.flow === null ? "flow –" : `${still_ ? "" : is.flow > 0 ? "to A " : "to B "}${litres(Math.abs(is.flow))} L/min`;
  byId("twin-rpm").textContent = is.rpm === null ? "" : `${Math.round(is.rpm)} rpm`;
  byId("twin-to-a").toggleAttribute("hidden", still_ || is.flow < 0);
  byId("twin-to-b").toggleAttribute("hidden", still_ || is.flow > 0);
  if (!still_ && !still.matches) {
    // dashes run with the oil, faster with more of it
    const full = twin.machine ? Math.max(0.1, twin.machine.displacement * 1000) : 1;
    twin.flowed = (twin.flowed + 60 * passed * Math.sign(is.flow) * Math.min(1.5, 0.3 + Math.abs(is.flow) / full)) % 24;
    for (const line of document.querySelectorAll(".twin-run")) line.setAttribute("stroke-dashoffset", (-twin.flowed).toFixed(1));
  }
  for (const line of document.querySelectorAll(".twin-run")) line.toggleAttribute("hidden", still_);
  if (twin.at < newest) twin.frame = requestAnimationFrame(moveTwin);
}

// describe the drawing to screen readers, each time that samples come
function describeTwin() {
  const is = state();
  const parts = ["The actuator as it moves"];
  for (const side of ["A", "B"]) if (is[`p_${side}`] !== null) parts.push(`p_${side} ${bar(is[`p_${side}`])} bar`);
  if (is.x !== null) parts.push(`piston at ${is.x.toFixed(0)} mm`);
  if (twin.leak) parts.push(byId("twin-leak-text").textContent);
  byId("twin").setAttribute("aria-label", parts.join(", "));
}
