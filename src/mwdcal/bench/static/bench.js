// Live figures and the page come by server-sent events; decisions go as forms.
"use strict";
const main = document.getElementById("main");
const message = document.getElementById("message");
const events = new EventSource("/events");
const shown = new Map();
let live = {};

// Only parts that differ are replaced: what has the focus, or is read aloud, stays.
events.addEventListener("page", (event) => {
  const fresh = document.createElement("template");
  fresh.innerHTML = JSON.parse(event.data);
  for (const part of fresh.content.querySelectorAll("[data-part]")) {
    const name = part.dataset.part;
    const old = main.querySelector(`[data-part="${name}"]`);
    if (shown.get(name) !== part.innerHTML) {
      shown.set(name, part.innerHTML);
      replace(old, part.innerHTML);
    }
    old.className = part.className;
    old.hidden = part.hidden;
  }
  refresh();
});

function replace(old, html) {
  const active = document.activeElement;
  const inside = active && old.contains(active);
  const id = inside ? active.id : "";
  const typed = new Map();
  for (const field of old.querySelectorAll("input[type=text], textarea, select")) typed.set(field.id, [field.value, field.dataset.chosen]);
  old.innerHTML = html;
  for (const [name, [value, chosen]] of typed) {
    const field = document.getElementById(name);
    if (field && value && field.dataset.chosen === chosen) field.value = value;
  }
  if (!inside) return;
  const again = document.getElementById(id) || document.getElementById("order");
  again.focus({ preventScroll: true });
}

function refresh() {
  for (const place of document.querySelectorAll("[data-live]")) {
    const text = live[place.dataset.live];
    if (text !== undefined && place.textContent !== text) place.textContent = text;
  }
  for (const needle of document.querySelectorAll("[data-turn]")) {
    const angle = live["turn_" + needle.dataset.turn];
    if (angle !== undefined) needle.setAttribute("transform", `rotate(${angle})`);
  }
  document.body.dataset.state = live.state || "";
}

events.addEventListener("live", (event) => {
  live = JSON.parse(event.data);
  refresh();
});

events.onerror = () => { message.textContent = message.dataset.lost; };
events.onopen = () => { if (message.textContent === message.dataset.lost) message.textContent = ""; };

async function send(form, submitter) {
  const body = new URLSearchParams(new FormData(form, submitter));
  for (const field of form.querySelectorAll("input[data-text]")) {
    if (!field.files[0]) continue;
    body.set(field.dataset.text, await field.files[0].text());
    body.set(`${field.dataset.text}_name`, field.files[0].name);
  }
  try {
    const answer = await fetch(form.action, { method: "POST", body, headers: { Accept: "text/plain" } });
    message.textContent = answer.ok ? "" : await answer.text();
    if (answer.ok) for (const field of form.querySelectorAll("textarea")) field.value = "";
  } catch {
    message.textContent = message.dataset.lost;
  }
}

document.addEventListener("submit", (event) => {
  if (event.target.matches("[data-drop]")) return;
  event.preventDefault();
  send(event.target, event.submitter);
});

document.addEventListener("change", (event) => {
  if (event.target.matches("input[type=checkbox]")) send(event.target.form);
});

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  if (event.target.matches("textarea") && event.key === "Enter" && !event.shiftKey) {
    event.preventDefault();
    event.target.form.requestSubmit();
    return;
  }
  if (event.target.matches("input, textarea, select, a, summary")) return;
  if (event.target.matches("button") && [" ", "Enter"].includes(event.key)) return;
  const button = main.querySelector(`button[data-key="${CSS.escape(event.key.toLowerCase())}"]`);
  if (!button) return;
  event.preventDefault();
  button.click();
});
