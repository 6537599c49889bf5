// The studio where a browser shows no 3-D: a run is started, watched, steered and exported by a form and a table.

const DEEDS = {
  pause: ["Pause", ["starting", "running"]],
  resume: ["Resume", ["pausing", "paused"]],
  step: ["One iteration", ["paused"]],
  checkpoint: ["Save a checkpoint", ["running", "pausing", "paused"]],
  stop: ["Stop", ["starting", "running", "pausing", "paused", "queued"]],
  "go on": ["Go on", ["stopped", "failed", "lost"]],
};
const AT_WORK = ["starting", "running", "pausing", "paused"];

let plainTasks = [];
let drawn = ""; // what the table of the design was drawn from
let designRows = []; // one for each entry of phi
let begun = false;

const runAddress = (rest) => `api/runs/${encodeURIComponent(view.run)}${rest}`;
const command = (content) => act(() => post(runAddress("/commands"), content));

// Do what a button says once, however often it is pressed meanwhile.
async function once(button, doing) {
  button.disabled = true;
  await act(doing);
  button.disabled = false;
}

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

async function openPlain() {
  loading.hidden = viewer.hidden = true;
  find("plain").hidden = false;
  const told = await ask("api/tasks");
  plainTasks = told.tasks;
  find("plain-task").replaceChildren(...told.tasks.map((task) => option(task.name, task.title, "", false)));
  find("plain-method").replaceChildren(...told.methods.map((name) => option(name, `${name}: ${told.method_titles[name]}`, "", false)));
  find("plain-method").value = "morph";
  find("plain-go").disabled = false;
}

find("plain-start").addEventListener("submit", (event) => {
  event.preventDefault();
  const [task, method] = [find("plain-task").value, find("plain-method").value];
  const [seed, iterations] = [Number(find("plain-seed").value), Number(find("plain-iterations").value)];
  once(find("plain-go"), async () => keepView({ run: (await post("api/runs", { task, method, seed, iterations })).id, iteration: null }));
});

find("plain-alpha").addEventListener("submit", (event) => {
  event.preventDefault();
  command({ type: "set_alpha", alpha: Number(find("plain-alpha-value").value) });
});

function showDeeds(status) {
  const offered = Object.entries(DEEDS).filter(([, [, when]]) => when.includes(status));
  const signature = offered.map(([deed]) => deed).join();
  if (find("plain-deeds").dataset.signature === signature) return;
  find("plain-deeds").dataset.signature = signature;
  find("plain-deeds").replaceChildren(...offered.map(([deed, [words]]) => {
    const button = element("button", { type: "button", textContent: words });
    button.addEventListener("click", () => once(button, () => (deed === "go on" ? post(runAddress("/resume"), {}) : post(runAddress("/commands"), { type: deed }))));
    return button;
  }));
}

const shortly = (value) => String(Number(value.toPrecision(4)));

function rowOf({ name, unit }) {
  const bound = (end) => element("input", { type: "number", step: "any", required: true, ariaLabel: `${end} ${name}` });
  const [value, lo, hi] = [element("td"), bound("lowest"), bound("highest")];
  const held = element("input", { type: "checkbox", ariaLabel: `hold ${name}` });
  const set = element("button", { type: "button", textContent: "Set", ariaLabel: `Set the bounds of ${name}` });
  held.addEventListener("change", () => command({ type: held.checked ? "lock" : "unlock", name }));
  set.addEventListener("click", () => {
    if (![lo, hi].every((input) => input.reportValidity())) return;
    for (const input of [lo, hi]) input.defaultValue = input.value; // what is in force shows from now on
    command({ type: "set_bound", name, lo: Number(lo.value), hi: Number(hi.value) });
  });
  const show = (parameter, phi, atWork) => {
    value.textContent = shortly(phi);
    for (const [input, inForce] of [[lo, String(parameter.lo)], [hi, String(parameter.hi)]]) {
      if (input.value === input.defaultValue) input.value = inForce; // else somebody is typing: it stays until it is set
      input.defaultValue = inForce;
    }
    if (held !== document.activeElement) held.checked = parameter.locked_at !== null;
    for (const control of [lo, hi, held, set]) control.disabled = !atWork;
  };
  const cells = [lo, hi, unit, held, set].map((content) => element("td", {}, content));
  return { row: element("tr", {}, element("th", { scope: "row", textContent: name }), value, ...cells), show };
}

async function showDesign(run) {
  const seen = JSON.stringify([run.id, run.status, run.iteration, refused]);
  if (seen === drawn) return;
  drawn = seen;
  const detail = await ask(runAddress(""));
  if (drawn !== seen) return; // a later look has asked anew
  const parameters = detail.parameters ?? [];
  const table = find("plain-design");
  if (table.dataset.run !== run.id || designRows.length !== parameters.length) {
    table.dataset.run = run.id;
    designRows = parameters.map(rowOf);
    table.tBodies[0].replaceChildren(...designRows.map(({ row }) => row));
  }
  designRows.forEach(({ show }, i) => show(parameters[i], detail.phi[i], AT_WORK.includes(run.status)));
  find("plain-picture").src = runAddress(`/thumbnail.png?design=latest&${run.iteration}`);
}

addEventListener("looked", ({ detail: run }) => {
  if (has3d) return;
  if (!begun && view.run === null) {
    const current = [...runs.values()].find((one) => one.current);
    if (current) keepView({ run: current.id, iteration: null });
    if (current) setTimeout(look);
  }
  begun = true;
  keepView({ run: view.run, iteration: null });
  find("plain-run").hidden = !run || run.status === "unreadable";
  if (find("plain-run").hidden) return;
  find("plain-name").textContent = run.id;
  find("plain-words").textContent = [`${plainTasks.find((task) => task.name === run.task)?.title ?? run.task}, method ${run.method}, seed ${run.seed}: ${run.status}`, describe(run)].filter(Boolean).join("  ·  ");
  find("plain-alpha").hidden = !AT_WORK.includes(run.status);
  find("plain-export").href = runAddress(`/designs/${find("plain-which").value}/export`);
  showDeeds(run.status);
  showDesign(run).catch(() => (drawn = ""));
});
find("new").addEventListener("click", () => has3d || find("plain-task").focus());
find("plain-which").addEventListener("change", () => {
  find("plain-export").href = runAddress(`/designs/${find("plain-which").value}/export`);
});

async function openUntilThere() {
  await openPlain().catch(() => setTimeout(openUntilThere, 2000));
}

if (!has3d) addEventListener("DOMContentLoaded", openUntilThere);
