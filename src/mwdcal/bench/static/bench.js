// Live figures and fragments come by server-sent events; decisions go as forms.
"use strict";
const main = document.getElementById("main");
const message = document.getElementById("message");
const events = new EventSource("/events");

events.addEventListener("page", (event) => {
  const active = document.activeElement;
  const id = active && main.contains(active) ? active.id : "";
  const typed = new Map();
  for (const field of main.querySelectorAll("input[type=text], textarea")) typed.set(field.id, field.value);
  main.innerHTML = JSON.parse(event.data);
  for (const [name, value] of typed) {
    const field = document.getElementById(name);
    if (field && value) field.value = value;
  }
  const again = id && document.getElementById(id);
  if (again) again.focus({ preventScroll: true });
});

events.addEventListener("live", (event) => {
  const live = JSON.parse(event.data);
  for (const place of document.querySelectorAll("[data-live]")) {
    const text = live[place.dataset.live];
    if (text !== undefined && place.textContent !== text) place.textContent = text;
  }
  for (const needle of document.querySelectorAll("[data-turn]")) {
    const angle = live["turn_" + needle.dataset.turn];
    if (angle !== undefined) needle.setAttribute("transform", `rotate(${angle})`);
  }
  document.body.dataset.state = live.state;
});

events.onerror = () => { message.textContent = message.dataset.lost; };
events.onopen = () => { if (message.textContent === message.dataset.lost) message.textContent = ""; };

async function send(form, submitter) {
  const body = new URLSearchParams(new FormData(form, submitter));
  const answer = await fetch(form.action, { method: "POST", body, headers: { Accept: "text/plain" } });
  message.textContent = answer.ok ? "" : await answer.text();
}

document.addEventListener("submit", (event) => {
  event.preventDefault();
  send(event.target, event.submitter);
});

document.addEventListener("change", (event) => {
  if (event.target.matches("input[type=checkbox]")) send(event.target.form);
});

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, textarea, button, a, summary")) {
    if (!(event.key === " " && event.target.matches("button[data-key]"))) return;
  }
  const button = main.querySelector(`button[data-key="${CSS.escape(event.key.toLowerCase())}"]:not(:disabled)`);
  if (!button) return;
  event.preventDefault();
  button.click();
});
