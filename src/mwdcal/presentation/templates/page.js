"use strict";
// Help for a closer look. A page says all that it says without this script too.

// Long tables are sorted by a click on a head: upwards, downwards, as it was.
const SORTED_FROM = 8;
const ORDERS = { none: "ascending", ascending: "descending", descending: "none" };
const EXPONENTS = "⁰¹²³⁴⁵⁶⁷⁸⁹";
const collator = new Intl.Collator("en", { numeric: true });

function value(text) {
  const plain = text
    .replace(/×10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)/, (_, power) => "e" + [...power].map((c) => (c === "⁻" ? "-" : EXPONENTS.indexOf(c))).join(""))
    .replace(/−/g, "-");
  const found = /^[<>≤≥±]?\s*([-+]?\d[\d\u2009]*\.?\d*(?:e-?\d+)?)/.exec(plain);
  return found ? Number(found[1].replaceAll("\u2009", "")) : NaN;
}

function sort(body, rows, column, order) {
  const cells = new Map(rows.map((row) => [row, row.cells[column].textContent.trim()]));
  const blank = (row) => /^[–—-]?$/.test(cells.get(row));
  const numeric = rows.every((row) => blank(row) || !Number.isNaN(value(cells.get(row))));
  const compare = (a, b) =>
    (numeric && value(cells.get(a)) - value(cells.get(b))) || collator.compare(cells.get(a), cells.get(b));
  const sign = order === "ascending" ? 1 : -1;
  const sorted = order === "none" ? rows : rows.toSorted((a, b) => blank(a) - blank(b) || sign * compare(a, b));
  body.append(...sorted);
}

// The column of every head of one column, below heads that span several.
function columns(head) {
  const taken = [], found = new Map();
  [...head.rows].forEach((row, y) => {
    let x = 0;
    for (const cell of row.cells) {
      while (taken[y]?.[x]) x++;
      for (let down = 0; down < cell.rowSpan; down++)
        for (let along = 0; along < cell.colSpan; along++) (taken[y + down] ??= [])[x + along] = true;
      if (cell.colSpan === 1 && cell.textContent.trim()) found.set(cell, x);
    }
  });
  return found;
}

for (const table of document.querySelectorAll("table")) {
  const [body] = table.tBodies, rows = [...(body?.rows ?? [])];
  if (rows.length < SORTED_FROM || !table.tHead || body.querySelector("[rowspan], [colspan]")) continue;
  const heads = columns(table.tHead);
  for (const [head, column] of heads) {
    const button = document.createElement("span"); // Chromium leaves a `button` out where print repeats the head
    button.role = "button";
    button.tabIndex = 0;
    button.append(...head.childNodes);
    head.append(button);
    head.ariaSort = "none";
    button.onkeydown = (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      button.click();
    };
    button.onclick = () => {
      const order = ORDERS[head.ariaSort];
      for (const other of heads.keys()) other.ariaSort = "none";
      head.ariaSort = order;
      sort(body, rows, column, order);
    };
  }
}

// A point of a picture says its name under the pointer, and step by step by the arrow keys. The same station is marked
// in all pictures and tables; a click, or Enter, goes to its row.
const REACH = 14;
const tip = document.createElement("div");
tip.className = "tip";
tip.role = "status";
document.querySelector("main").append(tip);
const places = new Map(); // what is named: its points and its rows
const named = (point) => point.dataset.name.split(":")[0];
const place = (name, element) => places.set(name, [...(places.get(name) ?? []), element]);
for (const row of document.querySelectorAll("tr[data-point]")) place(row.dataset.point, row);

function link(name) {
  for (const element of document.querySelectorAll(".linked")) element.classList.remove("linked");
  for (const element of places.get(name) ?? []) element.classList.add("linked");
}

function go(name) {
  const row = places.get(name)?.find((element) => element.matches("tr"));
  if (!row) return;
  for (let fold = row.closest("details"); fold; fold = fold.parentElement.closest("details")) fold.open = true;
  row.scrollIntoView({ block: "center" });
  link(name);
}

function tell(point) {
  tip.replaceChildren();
  link(point && named(point));
  if (!point) return;
  const box = point.getBoundingClientRect(), label = document.createElement("span");
  label.textContent = point.dataset.name;
  tip.append(label);
  const x = (box.left + box.right) / 2, y = (box.top + box.bottom) / 2;
  tip.style.left = `${x + scrollX}px`;
  tip.style.top = `${y + scrollY}px`;
  tip.classList.toggle("before", x > document.documentElement.clientWidth / 2);
}

for (const picture of document.querySelectorAll("figure svg")) {
  const points = [...picture.querySelectorAll("use > title")].map((title) => {
    const point = title.parentElement;
    point.dataset.name = title.textContent;
    title.remove();
    place(named(point), point);
    return point;
  });
  if (!points.length) continue;
  let at = -1;
  picture.setAttribute("aria-description", "Arrow keys go from point to point, Enter to the row of a table.");
  const near = (event) => {
    const far = points.map((point) => {
      const box = point.getBoundingClientRect();
      return Math.hypot(event.clientX - (box.left + box.right) / 2, event.clientY - (box.top + box.bottom) / 2);
    });
    const least = Math.min(...far);
    return least <= REACH ? points[far.indexOf(least)] : null;
  };
  picture.onpointermove = (event) => tell(near(event));
  picture.onclick = (event) => {
    const point = near(event);
    if (point) go(named(point));
  };
  picture.onkeydown = (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (event.key === "Escape") tell(null);
    if (event.key === "Enter" && at >= 0) go(named(points[at]));
    if (!step) return;
    event.preventDefault();
    at = Math.min(Math.max(at + step, 0), points.length - 1);
    points[at].scrollIntoView({ block: "nearest", inline: "nearest" });
    tell(points[at]);
  };
  picture.onpointerleave = picture.onblur = () => tell(null);
}

for (const row of document.querySelectorAll("tr[data-point]")) {
  row.onpointerenter = () => link(row.dataset.point);
  row.onpointerleave = () => link(null);
}

// Paper shows what is folded, in browsers too that do not know how from the style.
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((fold) => (fold.open = true)));
