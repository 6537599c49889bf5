// The shell round the viewer: which run is shown and how it fares, and what to do when the server goes away.

const INTERVAL = 1000;
const HIDDEN_INTERVAL = 5000;
const WAIT = 10; // seconds for which the server holds the question for news while there are none
const PATIENCE = 15000; // milliseconds until it is said that the viewer takes long
const AT_LAST = 60000; // and until what there is of it is shown
const GIVEN_UP = "__given_up__";
const UNCONNECTED = 8000; // milliseconds after which a viewer that has lost its server is opened anew

const find = (id) => document.getElementById(id);
const [chooser, chip, statusWord, doing, progress] = ["chooser", "chip", "status", "doing", "progress"].map(find);
const [banner, words, dismiss, viewer, loading, theme] = ["banner", "words", "dismiss", "viewer", "loading", "theme"].map(find);
const [preview, first, title, plan] = ["preview", "first", "title", "plan"].map(find);

const BROKEN = { failed: "has failed", lost: "is lost", unreadable: "is unreadable" };

const has3d = Boolean(document.createElement("canvas").getContext("webgl2"));

let boot = null;
let mark = null; // of the last news, by which the server knows what this page has
const runs = new Map(); // id -> its line of the list, in the order of the list
const recorded = new Map(); // id -> what is known of a recorded run, which comes with the studio and is nobody's own
let reachable = true;
let dismissed = "";
let choosing = 0;
let opening = 0;
let openings = 0; // since the viewer was connected last
let refused = ""; // why what was done last on this page could not be done
let connected = performance.now();
let attached = false; // whether the viewer was connected when last heard of

// What this page shows: run and iteration stand in its address, what is ticked in this browser's storage. The viewer of
// this page has a key, under which the server tells and is told what is shown.
const key = crypto.randomUUID ? crypto.randomUUID() : Array.from(crypto.getRandomValues(new Uint8Array(16)), (b) => b.toString(16).padStart(2, "0")).join("");
const address = new URLSearchParams(location.search);
let view = {
  run: address.get("run"),
  iteration: /^\d{1,6}$/.test(address.get("iteration") ?? "") ? Number(address.get("iteration")) : null,
  ticks: remembered("morph-ticks") ?? {},
  presents: address.has("present"),
};

function remembered(name) {
  try {
    return JSON.parse(localStorage.getItem(name));
  } catch {
    return null;
  }
}

// A viewer that is there knows better than this page what was ticked a moment ago: only a new one is told of that.
async function putView(wanted, isNew = !attached) {
  view = { ...view, ...wanted };
  const body = JSON.stringify(isNew ? view : { ...view, ticks: {} });
  await fetch(`api/desks/${key}`, { method: "PUT", headers: { "Content-Type": "application/json" }, body }).catch(() => null);
}

function keepView(seen) {
  view = { run: seen.run, iteration: seen.iteration, ticks: { ...view.ticks, ...seen.ticks }, presents: seen.presents };
  localStorage.setItem("morph-ticks", JSON.stringify(view.ticks));
  const query = new URLSearchParams();
  if (view.run !== null) query.set("run", view.run);
  if (view.iteration !== null) query.set("iteration", view.iteration);
  if (view.presents) query.set("present", "1");
  const wanted = query.size ? `?${query}` : "";
  if (wanted !== location.search) history.replaceState(null, "", location.pathname + wanted);
}

// --- the viewer ------------------------------------------------------------------------------------------------------

// While the viewer's client loads, which can take seconds, the page itself shows the task and offers the start.
async function showPreview() {
  const { tasks } = await ask("api/tasks");
  const current = runs.get(view.run) ?? [...runs.values()].find((run) => run.current);
  const task = tasks.find((each) => each.name === current?.task) ?? tasks[0];
  preview.src = `api/tasks/${task.name}/preview.svg`;
  preview.hidden = false;
  title.textContent = task.title;
  plan.textContent = "method morph, seed 0, 100 iterations: change them in the viewer, or start at once";
  first.dataset.task = task.name;
  first.hidden = Boolean(current);
}

first.addEventListener("submit", async (event) => {
  event.preventDefault();
  const button = first.querySelector("button");
  button.disabled = true;
  first.hidden = await act(async () => putView({ run: (await post("api/runs", { task: first.dataset.task })).id, iteration: null }));
  button.disabled = false;
});

async function post(path, content) {
  const response = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(content) });
  const answer = await response.json();
  if (!response.ok) throw new Error(answer.detail);
  return answer;
}

// Do something and look what has become of it; a refusal is said. Return whether it was done.
async function act(doing) {
  refused = dismissed = "";
  await doing().catch((error) => (refused = error.message));
  await look();
  return !refused;
}

async function openViewer() {
  if (!has3d) return;
  loading.hidden = false;
  connected = performance.now() + Math.min(240000, PATIENCE * 2 ** openings++); // a slow machine is given more time, not another start
  showPreview().catch(() => null); // the banner says what is wrong with the server
  await putView({}, true);
  viewer.src = `viewer/${key}/${document.documentElement.dataset.theme === "dark" ? "?darkMode" : ""}`;
  const started = performance.now();
  clearInterval(opening);
  opening = setInterval(() => {
    // The canvas comes early and stays empty until the server's panels and scene have arrived, or why there are none.
    const [page, waited] = [viewer.contentDocument, performance.now() - started];
    const arrived = page?.querySelector("canvas") && page.querySelector("[role=tab], [role=alert]:not(.mantine-Notification-root)");
    find("opening").textContent = waited < PATIENCE ? "Opening the 3-D viewer" : "Opening the 3-D viewer takes longer than usual: this machine or the network is busy";
    if (arrived || waited > AT_LAST) {
      clearInterval(opening);
      loading.hidden = true;
      focusViewer();
      dispatchEvent(new Event("viewer-opened"));
    }
  }, 100);
}

// The viewer's client looks for a lost server only while it has the focus.
function focusViewer() {
  if (!has3d) return;
  if ([document.body, viewer, null].includes(document.activeElement)) viewer.contentWindow?.focus();
}

theme.addEventListener("click", () => {
  const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  document.documentElement.dataset.theme = next;
  localStorage.setItem("morph-theme", next);
  openViewer();
});

// --- keys ------------------------------------------------------------------------------------------------------------

const typing = (event) => event.target instanceof event.view.Element && event.target.closest("input, textarea, select, [contenteditable=true], dialog[open]");

function hearHelp(event) {
  if (event.key !== "?" || typing(event)) return false;
  event.preventDefault();
  find("keys").showModal();
  return true;
}

// A key that nothing on this page takes is meant for the viewer.
document.addEventListener("keydown", (event) => {
  if (hearHelp(event) || !has3d || typing(event) || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.target.closest("button, a, #tour") && [" ", "Enter", "Tab", "Escape"].includes(event.key)) return;
  const { key, code, shiftKey } = event;
  viewer.contentDocument?.documentElement.dispatchEvent(new KeyboardEvent("keydown", { key, code, shiftKey, bubbles: true }));
  focusViewer();
});

// In presenter's mode there is nothing beside the scene but the words of this page: see #caption in its style.
const SCENE = "[data-dock-root] > :has(canvas):not([data-dock-region])";
const ALONE = `:root[data-presents] :is([data-dock-root] > :not(:has(canvas)), [data-dock-region], #root .mantine-Paper-root, #webgl-software-rendering) { display: none !important; }
:root[data-presents] ${SCENE} { inset: 0 0 0 38% !important; }
@media (max-aspect-ratio: 1/1) { :root[data-presents] ${SCENE} { inset: 0 0 38% 0 !important; } }`;

// Of viser's own colours, those on which or with which words are too pale to be read.
const READABLE = `:root[data-mantine-color-scheme="light"] {
  --mantine-color-dimmed: #5b6570 !important; --mantine-color-gray-filled: #5b6570 !important;
  --mantine-color-blue-filled: #2467ad !important;
  --mantine-color-custom-filled: #2467ad !important; --mantine-color-custom-outline: #2467ad !important;
  --mantine-primary-color-filled: #2467ad !important;
}
:root[data-mantine-color-scheme="dark"] {
  --mantine-color-dimmed: #a9b1ba !important; --mantine-primary-color-filled: #5ba3ea !important;
  --mantine-color-blue-filled: #2467ad !important;
}
.mantine-Notification-description { color: var(--mantine-color-text) !important; }
#webgl-software-rendering { margin-top: 44px; }
:root[data-mantine-color-scheme="dark"] .mantine-Button-root:not([style*="--button-bg"]) { background: #2467ad !important; }`;

// On a phone viser's sheet of panels leaves a strip at its left in which nothing can be seen: it takes the whole width.
const SHEET = `@media (max-width: 560px) {
  .mantine-Paper-root[style*="position: fixed"][style*="width: 20em"] { width: 100% !important; max-height: 50% !important; }
  .mantine-Paper-root[style*="position: fixed"] [style*="width: 20em"] { width: 100% !important; }
}`;

viewer.addEventListener("load", () => {
  const style = viewer.contentDocument.createElement("style");
  style.textContent = READABLE + ALONE + SHEET;
  viewer.contentDocument.head.append(style);
  viewer.contentDocument.addEventListener("keydown", hearHelp);
  // An arrow moves the slider that has the focus, and not the timeline too.
  viewer.contentDocument.body.addEventListener("keydown", (event) => {
    if (event.key.startsWith("Arrow") && event.target.closest("[role=slider], [role=tab]")) event.stopPropagation();
  });
});

find("help").addEventListener("click", () => find("keys").showModal());
find("close").addEventListener("click", () => find("keys").close());
find("keys").addEventListener("close", focusViewer);

// --- the bar ---------------------------------------------------------------------------------------------------------

function describe(run) {
  const parts = [];
  if (run.iterations) parts.push(`iteration ${run.iteration} of ${run.iterations}`);
  if (run.eta_seconds !== null && run.status === "running") parts.push(`${duration(run.eta_seconds)} left`);
  if (run.success !== null) parts.push(`success ${percent(run.success)}`);
  if (run.stage && run.stage !== run.status) parts.push(run.stage); // the last one is what a narrow page cuts off
  return parts.join("  ·  ");
}

function option(value, text, title, disabled) {
  const made = document.createElement("option");
  Object.assign(made, { value, textContent: text, title, disabled });
  return made;
}

function listRuns(current) {
  if (document.activeElement === chooser || Date.now() - choosing < 1500) return; // not while it is open
  const prompt = runs.size ? "a new run" : "no runs yet";
  const options = [...runs.values()].map((run) => option(run.id, `${run.id}  ·  ${run.status}`, run.reason, run.status === "unreadable"));
  if (!current) options.unshift(option("", view.run ? `${view.run}  ·  gone` : prompt, "", true));
  const shipped = [...recorded.values()].map((each) => option(each.run, `${each.run}  ·  ${each.label}`, each.problem, Boolean(each.problem)));
  const signature = [...options, ...shipped].map((o) => o.textContent).join("\n");
  if (chooser.dataset.signature !== signature) {
    const group = document.createElement("optgroup");
    group.label = "Recorded, comes with the studio";
    group.append(...shipped);
    chooser.replaceChildren(...options, ...(shipped.length ? [group] : []));
    chooser.dataset.signature = signature;
  }
  chooser.disabled = runs.size + recorded.size === 0;
  chooser.value = current ? current.id : "";
}

chooser.addEventListener("change", async () => {
  choosing = Date.now();
  await putView({ run: chooser.value, iteration: null });
  chooser.blur();
  focusViewer();
  await look();
});

find("new").addEventListener("click", async () => {
  await putView({ run: null, iteration: null });
  focusViewer();
  await look();
});

function showRun(run) {
  chip.hidden = progress.hidden = !run;
  doing.textContent = run ? describe(run) : "";
  doing.title = run ? run.reason : "";
  document.title = run ? `${run.status} ${run.iterations ? `${run.iteration}/${run.iterations} ` : ""}· MORPH Studio` : "MORPH Studio";
  if (!run) return;
  chip.dataset.status = statusWord.textContent = run.status;
  chip.title = run.reason;
  progress.hidden = !run.iterations;
  progress.max = run.iterations || 1;
  progress.value = Math.min(run.iteration, progress.max);
}

// --- the banner ------------------------------------------------------------------------------------------------------

function say(sentence, kind) {
  banner.hidden = !sentence || sentence === dismissed;
  banner.dataset.kind = kind;
  words.textContent = sentence;
  dismiss.hidden = kind === "server";
}

dismiss.addEventListener("click", () => {
  dismissed = words.textContent;
  refused = "";
  banner.hidden = true;
});

function sayRun(run) {
  if (refused) return say(refused, "run");
  const reason = run?.reason ? `: ${run.reason}` : "";
  if (run && run.status in BROKEN) say(`${run.id} ${BROKEN[run.status]}${reason}`, "run");
  else if (run?.status === "paused" && run.stage !== "paused") say(`paused${reason}`, "note");
  else if (!run && view.run) say(`${view.run} is no longer in the folder of runs: it was deleted or moved. Choose another run, or bring it back on the page of all runs.`, "note");
  else say("", "run");
}

// --- the server ------------------------------------------------------------------------------------------------------

async function ask(path, wait = 0) {
  const response = await fetch(path, { cache: "no-store", signal: AbortSignal.timeout(4000 + 1000 * wait) });
  if (response.status === 401) return GIVEN_UP;
  if (!response.ok) throw new Error(`${path} answered ${response.status}`);
  return response.json();
}

function askNews(wait) {
  const query = new URLSearchParams({ wait });
  if (has3d) query.set("desk", key);
  if (mark) query.set("after", mark);
  return ask(`api/news?${query}`, wait);
}

function hear(news) {
  if (boot !== news.boot) runs.clear();
  const lines = new Map([...runs, ...news.runs.map((run) => [run.id, run])]);
  if (news.ids) runs.clear(); // they come in another order
  for (const id of news.ids ?? lines.keys()) if (lines.has(id)) runs.set(id, lines.get(id));
  [boot, mark] = [news.boot, news.mark];
}

async function look(wait = 0) {
  try {
    const news = await askNews(wait);
    if (news === GIVEN_UP) {
      say("The server was started anew: open the link it printed in its terminal.", "server");
      return;
    }
    const restarted = boot !== null && news.boot !== boot;
    hear(news);
    if (!recorded.size) await learnRecorded();
    if (restarted) await openViewer();
    else if (!reachable) focusViewer();
    reachable = true;
    if (has3d) await follow(news.seen);
    const current = runs.get(view.run) ?? recorded.get(view.run);
    listRuns(current);
    showRun(current);
    sayRun(current);
    dispatchEvent(new CustomEvent("looked", { detail: current }));
  } catch {
    reachable = false;
    const where = navigator.onLine ? "The server does not answer" : "This device is offline";
    say(`${where}; trying again. Runs go on without this page, and it comes back to where it was.`, "server");
  }
}

// A recorded run stands in the bar like any other, but for its state.
async function learnRecorded() {
  for (const each of await ask("api/recorded")) {
    recorded.set(each.run, { ...each, id: each.run, status: "recorded", reason: each.origin?.chosen ?? each.problem, stage: each.label.replace("recorded: ", ""), iteration: 0, iterations: null, success: null });
  }
}

// Note what the viewer shows, or open it anew where it has lost the server: after a sleep, or a lost network.
async function follow(seen) {
  attached = seen.connected;
  if (attached) {
    openings = 0;
    connected = Math.max(connected, performance.now());
    keepView(seen);
  } else if (performance.now() - connected > UNCONNECTED) await openViewer();
}

async function watch() {
  const began = performance.now();
  await look(document.hidden || !reachable || boot === null || (has3d && !attached) ? 0 : WAIT);
  if (!reachable) focusViewer();
  setTimeout(watch, document.hidden ? HIDDEN_INTERVAL : Math.max(0, INTERVAL - (performance.now() - began)));
}

document.addEventListener("visibilitychange", () => document.hidden || look());
for (const change of ["online", "offline"]) addEventListener(change, () => look());
addEventListener("DOMContentLoaded", () => {
  openViewer();
  watch();
});
