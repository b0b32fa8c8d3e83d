// What the scripts of all pages share. Whatever comes from the wire goes into the document as text, never as markup.
"use strict";

const byId = (id) => document.getElementById(id);

function element(kind, className, text) {
  const made = document.createElement(kind);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

const litres = (value) => (value === null || value === undefined ? "–" : Number(value.toPrecision(3)).toString());

// the local time in the form of ISO 8601, whatever the browser's language; for files the time that they state
function isoTime(t, byFiles) {
  const zone = byFiles ? 0 : new Date(t * 1000).getTimezoneOffset() * 60000;
  const local = new Date(t * 1000 - zone);
  return local.toISOString().slice(0, 19).replace("T", " ");
}

// uPlot's templates of dates, the American ones as ISO 8601 writes them
function isoTemplate(template) {
  const iso = template
    .replace("{M}/{D}/{YY}", "{YYYY}-{MM}-{DD}")
    .replace("{M}/{D}", "{MM}-{DD}")
    .replace("{h}{aa}", "{HH}:00")
    .replace("{h}", "{HH}")
    .replace("{aa}", "");
  return uPlot.fmtDate(iso);
}

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// the state of NE 107 as a badge: its letter, and its name for who cannot see colours
function badge(state) {
  const made = element("span", `badge ${state.symbol}`, state.name);
  made.prepend(element("b", "", state.symbol));
  return made;
}
