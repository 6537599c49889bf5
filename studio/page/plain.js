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
let begun = false;

const runAddress = (rest) => `api/runs/${encodeURIComponent(view.run)}${rest}`;
const command = (content) => act(() => post(runAddress("/commands"), content));

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
  act(async () => keepView({ run: (await post("api/runs", { task, method, seed, iterations })).id, iteration: null }));
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
    button.addEventListener("click", () => (deed === "go on" ? act(() => post(runAddress("/resume"), {})) : command({ type: deed })));
    return button;
  }));
}

const shortly = (value) => String(Number(value.toPrecision(4)));

function rowOf(parameter, value, atWork) {
  const bound = (end) => element("input", { type: "number", step: "any", value: parameter[end], disabled: !atWork, ariaLabel: `${end === "lo" ? "lowest" : "highest"} ${parameter.name}` });
  const [lo, hi] = [bound("lo"), bound("hi")];
  const held = element("input", { type: "checkbox", checked: parameter.locked_at !== null, disabled: !atWork, ariaLabel: `hold ${parameter.name}` });
  const set = element("button", { type: "button", textContent: "Set", disabled: !atWork, ariaLabel: `Set the bounds of ${parameter.name}` });
  held.addEventListener("change", () => command({ type: held.checked ? "lock" : "unlock", name: parameter.name }));
  set.addEventListener("click", () => command({ type: "set_bound", name: parameter.name, lo: Number(lo.value), hi: Number(hi.value) }));
  const cells = [shortly(value), lo, hi, parameter.unit, held, set].map((content) => element("td", {}, content));
  return element("tr", {}, element("th", { scope: "row", textContent: parameter.name }), ...cells);
}

async function showDesign(run) {
  const seen = JSON.stringify([run.id, run.status, run.iteration, refused]);
  if (seen === drawn || find("plain-design").contains(document.activeElement)) return;
  drawn = seen;
  const { parameters, phi } = await ask(runAddress(""));
  const atWork = AT_WORK.includes(run.status);
  find("plain-design").tBodies[0].replaceChildren(...(parameters ?? []).map((one, i) => rowOf(one, phi[i], atWork)));
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
