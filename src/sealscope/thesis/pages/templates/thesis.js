(function () {
  "use strict";
  var box = document.getElementById("find");
  var field = document.getElementById("find-text");
  var count = document.getElementById("find-count");
  var parts = Array.prototype.map.call(document.querySelectorAll("[data-words]"), function (node) {
    return { node: node, words: node.getAttribute("data-words") || node.textContent.toLowerCase(), kind: node.getAttribute("data-kind") };
  });
  var sections = document.querySelectorAll("section[data-part]");
  var timer = 0;
  function look() {
    var wanted = field.value.toLowerCase().split(/\s+/).filter(Boolean);
    var hits = 0;
    parts.forEach(function (part) {
      var fits = wanted.every(function (word) { return part.words.indexOf(word) >= 0; });
      part.node.classList.toggle("away", !fits);
      if (fits && part.kind !== "link") { hits += 1; }
    });
    Array.prototype.forEach.call(sections, function (section) {
      var some = section.querySelector("[data-words]:not(.away)");
      section.classList.toggle("away", wanted.length > 0 && !some);
    });
    Array.prototype.forEach.call(document.querySelectorAll("nav details"), function (one) {
      var some = one.querySelector("[data-words]:not(.away)");
      one.classList.toggle("away", wanted.length > 0 && !some);
      if (wanted.length > 0) { one.open = Boolean(some); }
    });
    count.textContent = wanted.length ? hits + (hits === 1 ? " match" : " matches") : "";
  }
  function shown() {
    var target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    if (target && target.closest(".away")) { field.value = ""; look(); target.scrollIntoView(); }
    var all = document.getElementById("only-all");
    if (target && target.tagName === "TR" && target.offsetParent === null && all) { all.checked = true; target.scrollIntoView(); }
  }
  box.hidden = false;
  field.addEventListener("input", function () { clearTimeout(timer); timer = setTimeout(look, 80); });
  field.addEventListener("keydown", function (event) { if (event.key === "Escape") { field.value = ""; look(); } });
  window.addEventListener("hashchange", shown);
  look();
  shown();
}());
