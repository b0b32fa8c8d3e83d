// The screen of the hold test.
import { make } from "./main.mjs";

export function show() {
  byId("hold-body").replaceChildren(make("p", { class: "quiet", text: "The hold test is not built in yet." }));
}

export function update() {}
