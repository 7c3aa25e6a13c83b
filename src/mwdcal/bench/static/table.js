// A table goes to the bench by drag and drop, or by the file field; decisions on it go as forms.
"use strict";
const note = document.getElementById("message");

// One decision at a time: while the bench works on one, and until its page has come, no other is taken.
function accept(decisions) {
  for (const each of document.querySelectorAll("button, input[type=file]")) each.disabled = !decisions;
}

addEventListener("pageshow", () => accept(true));

async function ask(address, body, token) {
  const focus = document.activeElement;
  accept(false);
  const headers = { Accept: "text/plain", ...(token ? { "X-Bench-Token": token } : {}) };
  try {
    const answer = await fetch(address, { method: "POST", body, headers });
    if (answer.ok) return location.assign("/table");
    note.textContent = await answer.text();
  } catch {
    note.textContent = note.dataset.lost;
  }
  accept(true);
  focus.focus();
}

function give(form, file) {
  if (!file) return;
  note.textContent = note.dataset.reading || "";
  ask(`${form.dataset.drop}?name=${encodeURIComponent(file.name)}`, file, form.dataset.token);
}

const area = (event) => event.target.closest("[data-drop]") || document.querySelector("[data-drop]");

document.addEventListener("change", (event) => {
  if (event.target.matches("[data-drop] input[type=file]")) give(area(event), event.target.files[0]);
});

document.addEventListener("submit", (event) => {
  if (!event.target.action.includes("/table/")) return;
  event.preventDefault();
  note.textContent = note.dataset.working;
  ask(event.target.action, new URLSearchParams(new FormData(event.target, event.submitter)));
});

for (const kind of ["dragenter", "dragover", "dragleave", "drop"]) {
  document.addEventListener(kind, (event) => {
    const form = area(event);
    if (!form) return;
    event.preventDefault();
    form.classList.toggle("over", kind === "dragenter" || kind === "dragover");
    if (kind === "drop") give(form, event.dataTransfer.files[0]);
  });
}
