// The runs page: every run of the folder, found again by search and filters, kept in order, and compared.

import { Designs, Traces } from "./runs-charts.js";
import { flat, heldRow, made, makeTable, moveFocus, number } from "./runs-table.js";

const INTERVAL = 2000;
const HIDDEN_INTERVAL = 15000;
const WAIT = 15; // seconds for which the server holds the question for news while there are none
const MOST_ASKED = 100; // rows that are asked for one by one
const TOLD = 12000;
const MOST_COMPARED = 100;
const MOST_BESIDE = 4; // runs in one page of their evolution
const FILTERS = ["search", "status", "task", "method", "tag", "starred", "archived"];
const ALL = { status: "any state", task: "any task", method: "any method", tag: "any tag" };

const find = (id) => document.getElementById(id);
const address = (run, rest = "") => `api/runs/${encodeURIComponent(run)}${rest}`;
const counted = (count, word = "run") => `${count} ${count === 1 ? word : `${word}s`}`;

let table = null;
let boot = null;
let heard = null; // the mark of the last news, by which the server knows what this page has
let known = new Map(); // id -> the row as it came
let undoLast = null;
let hushing = 0;
let compared = null;
let drawing = 0;
let traces = null;
let designs = null;

// --- the server ------------------------------------------------------------------------------------------------------

async function ask(path, method = "GET", body) {
  const wish = { method, cache: "no-store", signal: AbortSignal.timeout(20000) };
  if (body !== undefined) Object.assign(wish, { body: JSON.stringify(body), headers: { "Content-Type": "application/json" } });
  const response = await fetch(path, wish);
  const answer = await response.json().catch(() => null);
  if (!response.ok) throw new Error(answer?.detail ?? `${path} answered ${response.status}`);
  return answer;
}

async function look(wait = 0) {
  try {
    const words = new URLSearchParams(heard ? { wait, after: heard } : { wait });
    const response = await fetch(`api/news?${words}`, { cache: "no-store", signal: AbortSignal.timeout(20000 + 1000 * wait) });
    if (response.status === 401) return say("The server was started anew: open the link it printed in its terminal.");
    if (!response.ok) throw new Error(`api/news answered ${response.status}`);
    const news = await response.json();
    if (news.is_new || !table) await hear(news);
    [boot, heard] = [news.boot, news.mark];
    return say("");
  } catch {
    heard = null;
    return say("The server does not answer; trying again. Runs go on without it.");
  }
}

// Ask for the rows that have changed, or for all where that is shorter, and show the table as it is now.
async function hear(news) {
  const changed = news.runs.map((run) => run.id);
  const some = news.boot === boot && heard !== null && changed.length < MOST_ASKED;
  const words = new URLSearchParams(some ? changed.map((run) => ["run", run]) : []);
  const rows = some && !changed.length ? [] : await ask(some ? `api/table?${words}` : "api/table");
  const lines = new Map([...(some ? known : []), ...rows.map((row) => [row.id, row])]);
  await show((news.ids ?? [...lines.keys()]).filter((run) => lines.has(run)).map((run) => lines.get(run)));
}

async function watch() {
  const began = performance.now();
  await look(document.hidden || heard === null ? 0 : WAIT);
  setTimeout(watch, document.hidden ? HIDDEN_INTERVAL : Math.max(0, INTERVAL - (performance.now() - began)));
}

function say(sentence) {
  find("banner").hidden = !sentence;
  find("words").textContent = sentence;
}

// --- the table -------------------------------------------------------------------------------------------------------

async function show(rows) {
  const before = known;
  known = new Map(rows.map((row) => [row.id, row]));
  find("reading").hidden = true;
  find("empty").hidden = rows.length > 0;
  find("all").hidden = find("filters").hidden = rows.length === 0;
  offerFilters(rows);
  if (!table) return build(rows.map(flat));
  const fresh = rows.filter((row) => !before.has(row.id));
  const changed = rows.filter((row) => before.has(row.id) && JSON.stringify(before.get(row.id)) !== JSON.stringify(row));
  const hadFocus = find("table").contains(document.activeElement);
  const gone = [...before.keys()].filter((id) => !known.has(id));
  if (changed.length) await table.updateData(changed.map(flat));
  for (const row of changed) table.getRow(row.id)?.reformat();
  if (gone.length) await table.deleteRow(gone);
  if (fresh.length) await table.addData(fresh.map(flat), true);
  // Filtering draws all rows anew, at the top: only where another set of rows is to be seen.
  if (fresh.length || changed.some((row) => fits(flat(row)) !== fits(flat(before.get(row.id))))) filter();
  tellCount(table.getDataCount("active"));
  if (hadFocus && !find("table").contains(document.activeElement)) focusFirst();
  return tellChosen();
}

function build(rows) {
  return new Promise((done) => {
    table = makeTable(find("table"), find("pages"), { onStar: (row) => mark([row], { starred: !row.starred }), onOpen: (row) => open(row.id) });
    table.on("rowSelectionChanged", tellChosen);
    table.on("dataFiltered", (_, shown) => tellCount(shown.length));
    table.on("tableBuilt", async () => {
      await table.setData(rows);
      recall();
      filter();
      done();
    });
  });
}

function offerFilters(rows) {
  const present = { status: rows.map((r) => r.status), task: rows.map((r) => r.task), method: rows.map((r) => r.method), tag: rows.flatMap((r) => r.marks.tags) };
  for (const [name, values] of Object.entries(present)) {
    const choices = [...new Set(values.filter(Boolean))].sort(), select = find(name);
    if (select.dataset.choices === JSON.stringify(choices)) continue;
    const chosen = select.value;
    select.dataset.choices = JSON.stringify(choices);
    select.replaceChildren(new Option(ALL[name], ""), ...choices.map((choice) => new Option(choice, choice)));
    select.value = choices.includes(chosen) ? chosen : "";
  }
}

// Return whether a row fits what was asked for when it was last filtered.
let fits = () => true;

function filter() {
  const wanted = Object.fromEntries(FILTERS.map((name) => [name, find(name).type === "checkbox" ? find(name).checked : find(name).value]));
  const words = wanted.search.toLowerCase().split(/\s+/).filter(Boolean);
  fits = (row) =>
    words.every((word) => row.text.includes(word)) &&
    (!wanted.status || row.status === wanted.status) && (!wanted.task || row.task === wanted.task) &&
    (!wanted.method || row.method === wanted.method) && (!wanted.tag || row.tags.includes(wanted.tag)) &&
    (!wanted.starred || row.starred) && (wanted.archived === "show" || row.archived === (wanted.archived === "only"));
  find("unfilter").hidden = !filtered().length;
  table.setFilter(fits);
}

function tellCount(shown) {
  find("count").textContent = shown === known.size ? counted(known.size) : `${shown} of ${counted(known.size)}`;
}

const chosenRows = () => table.getSelectedData();

function tellChosen() {
  const rows = chosenRows();
  find("actions").hidden = rows.length === 0;
  find("chosen").textContent = `${rows.length} selected`;
  find("star").textContent = rows.every((row) => row.starred) ? "Unstar" : "Star";
  find("archive").textContent = rows.every((row) => row.archived) ? "Bring back" : "Archive";
  find("edit").textContent = rows.length === 1 ? "Name, tags, note" : "Add tags";
  find("compare").disabled = rows.length > MOST_COMPARED;
  find("compare").title = rows.length > MOST_COMPARED ? `At most ${MOST_COMPARED} runs are compared at once` : "";
  find("evolution").disabled = rows.length > MOST_BESIDE;
  find("evolution").title = rows.length > MOST_BESIDE ? `At most ${MOST_BESIDE} runs stand side by side`
    : "Download bodies, traces and episodes of all iterations as one page, which needs no network";
  remember();
}

// Return what is asked for, each filter that leaves something out with its value.
function filtered() {
  return FILTERS.map((name) => [name, find(name).type === "checkbox" ? (find(name).checked ? "1" : "") : find(name).value]).filter(([, value]) => value && value !== "hide");
}

// Filters and what is compared stand in the address, so that the way back from the viewer leads to the same picture.
function remember() {
  const words = new URLSearchParams(filtered());
  for (const run of compared?.runs ?? []) words.append("compare", run);
  history.replaceState(null, "", words.size ? `#${words}` : location.pathname);
}

function recall() {
  const words = new URLSearchParams(location.hash.slice(1));
  for (const name of FILTERS) {
    const input = find(name);
    if (!words.has(name)) continue;
    if (input.type === "checkbox") input.checked = true;
    else input.value = words.get(name);
    if (input.tagName === "SELECT" && input.selectedIndex < 0) input.selectedIndex = 0;
  }
  const runs = words.getAll("compare").filter((run) => known.has(run)).slice(0, MOST_COMPARED);
  if (!runs.length) return;
  table.selectRow(runs);
  compare(runs);
}

// --- what is done to runs --------------------------------------------------------------------------------------------

function tell(sentence, undo) {
  undoLast = undo ?? null;
  find("told").textContent = sentence;
  find("undo").hidden = !undo;
  find("toast").hidden = false;
  clearTimeout(hushing);
  hushing = setTimeout(() => (find("toast").hidden = true), TOLD);
}

// Do something to each of some runs; what is refused is told, and the rest stays done.
async function each(runs, act) {
  const done = [], refused = [];
  for (const run of runs) {
    try {
      await act(run);
      done.push(run);
    } catch (error) {
      refused.push(error.message);
    }
  }
  await look();
  return { done, refused };
}

function report(what, { done, refused }, undo) {
  const said = done.length ? [`${what} ${counted(done.length)}`] : [];
  if (refused.length) said.push(refused.length > 1 ? `${refused[0]} (and ${refused.length - 1} more refused)` : refused[0]);
  tell(said.join(". "), done.length ? undo : null);
}

const marksOf = (row) => ({ starred: row.starred, name: row.name, note: row.note, tags: row.tags, archived: row.archived });

async function mark(rows, change, what = "Changed") {
  const before = new Map(rows.map((row) => [row.id, marksOf(row)]));
  const changes = (run) => (typeof change === "function" ? change(before.get(run)) : change);
  const result = await each([...before.keys()], (run) => ask(address(run, "/marks"), "PATCH", changes(run)));
  report(what, result, async () => {
    await each(result.done, (run) => ask(address(run, "/marks"), "PATCH", before.get(run)));
    tell("Undone");
  });
  return result;
}

function star(rows) {
  const starred = !rows.every((row) => row.starred);
  return mark(rows, { starred }, starred ? "Starred" : "Unstarred");
}

function archive(rows) {
  const archived = !rows.every((row) => row.archived);
  if (archived && find("archived").value === "hide") table.deselectRow(rows.map((row) => row.id));
  return mark(rows, { archived }, archived ? "Archived" : "Brought back");
}

async function restore(runs) {
  const result = await each(runs, (run) => ask(`api/trash/${encodeURIComponent(run)}/restore`, "POST"));
  report("Restored", result);
  return result;
}

function askDelete(rows) {
  find("delete-title").textContent = `Delete ${counted(rows.length)}?`;
  const named = rows.slice(0, 12).map((row) => row.label);
  if (rows.length > 12) named.push(`and ${rows.length - 12} more`);
  find("delete-list").replaceChildren(...named.map((name) => made("li", "", name)));
  asked(find("ask-delete"), async () => {
    const result = await each(rows.map((row) => row.id), (run) => ask(address(run), "DELETE"));
    report("Deleted", result, () => restore(result.done));
  });
}

function focusFirst() {
  setTimeout(() => find("table").querySelector('.tabulator-row[tabindex="0"]')?.focus(), 50); // once the rows are drawn
}

// Show a dialog, and act if it was closed by the button "yes"; then the focus goes back to where it was.
function asked(dialog, act) {
  const before = document.activeElement;
  dialog.returnValue = "";
  dialog.addEventListener("close", async () => {
    if (dialog.returnValue === "yes") await act();
    if (before?.isConnected) before.focus();
    else focusFirst();
  }, { once: true });
  dialog.showModal();
}

const listed = (text) => text.split(",").map((tag) => tag.trim()).filter(Boolean);

function edit(rows) {
  const [row] = rows, alone = rows.length === 1;
  find("marks-title").textContent = alone ? row.id : `Add tags to ${counted(rows.length)}`;
  find("name-row").hidden = find("note-row").hidden = !alone;
  find("tags-word").textContent = alone ? "Tags" : "Tags to add";
  find("marks-name").value = row.name;
  find("marks-tags").value = alone ? row.tags.join(", ") : "";
  find("marks-note").value = row.note;
  find("marks-why").textContent = "";
  asked(find("ask-marks"), () => null);
  find("save").onclick = async (event) => {
    event.preventDefault(); // it stays open with the reason where something is refused
    const tags = listed(find("marks-tags").value);
    const change = alone
      ? { name: find("marks-name").value, tags, note: find("marks-note").value }
      : (before) => ({ tags: [...before.tags, ...tags] });
    const { refused } = await mark(rows, change);
    if (refused.length) find("marks-why").textContent = refused[0];
    else find("ask-marks").close("done");
  };
}

async function listTrash() {
  const trashed = await ask("api/trash");
  find("trash-list").replaceChildren(...trashed.map((one) => {
    const item = made("li"), name = made("span", "", one.id), button = Object.assign(made("button", "", "Restore"), { type: "button" });
    name.append(made("br"), made("small", "", `deleted ${new Date(one.deleted * 1000).toLocaleString()}`));
    button.setAttribute("aria-label", `Restore ${one.id}`);
    button.addEventListener("click", async () => {
      const { refused } = await restore([one.id]);
      find("trash-why").textContent = refused[0] ?? "";
      await listTrash();
    });
    item.append(name, button);
    return item;
  }));
  if (!trashed.length) find("trash-list").append(made("li", "", "The trash is empty."));
  find("empty-trash").disabled = !trashed.length;
  find("empty-trash").textContent = "Empty the trash";
}

function open(run, iteration) {
  location.assign(`./?${new URLSearchParams(iteration === undefined ? { run } : { run, iteration })}`);
}

// --- the comparison --------------------------------------------------------------------------------------------------

async function compare(chosen) {
  const number = ++drawing, runs = chosen.filter((run) => known.get(run)?.status !== "unreadable");
  if (!runs.length) return tell("There is nothing to compare: what was selected can't be read. Choose other runs.");
  try {
    const words = new URLSearchParams(runs.map((run) => ["run", run]));
    const overlay = await ask(`api/traces?${words}`);
    if (number !== drawing) return;
    compared = { runs, overlay };
    find("comparison").hidden = false;
    draw();
    find("comparison").scrollIntoView({ block: "nearest" }); // on a phone it begins below what is seen
    remember();
    const left = chosen.length - runs.length;
    if (left) tell(`${counted(left)} that can't be read ${left === 1 ? "is" : "are"} left out.`);
  } catch (error) {
    tell(error.message);
  }
}

// Download one page with the whole evolution of some runs, which the server puts together in a few seconds.
async function evolution([run, ...beside]) {
  const button = find("evolution"), words = new URLSearchParams(beside.map((other) => ["beside", other]));
  button.disabled = true;
  tell("Putting the evolution together…");
  try {
    const response = await fetch(address(run, `/evolution.html?${words}`), { cache: "no-store" });
    if (!response.ok) throw new Error((await response.json().catch(() => null))?.detail ?? `it answered ${response.status}`);
    const page = URL.createObjectURL(await response.blob());
    Object.assign(document.createElement("a"), { href: page, download: `${run}-evolution.html` }).click();
    setTimeout(() => URL.revokeObjectURL(page), 60000);
    tell("The page is among your downloads: it opens without a network.");
  } catch (error) {
    tell(error.message);
  }
  tellChosen();
}

function draw() {
  if (!compared) return;
  traces ??= new Traces(find("traces"));
  designs ??= new Designs(find("parallel"), { onSee: see, onOpen: (design) => open(design.run, design.iteration), onBrush: tellBrushed });
  see(null);
  for (const { chart } of [traces, designs]) chart.resize();
  const evaluated = compared.overlay.traces.filter((trace) => trace.iteration.length);
  find("compared").textContent = `${counted(compared.runs.length)} compared${evaluated.length < compared.runs.length ? `, ${compared.runs.length - evaluated.length} without an evaluation` : ""}`;
  const overlay = { ...compared.overlay, traces: evaluated };
  const sure = percent(overlay.confidence);
  find("meant").textContent = overlay.means.length ? `thick: mean of a method's runs; shaded: its ${sure} interval` : "";
  traces.draw(overlay, { measure: find("measure").value, single: find("single").checked });
  const left = evaluated.length ? designs.draw(overlay, { which: find("designs").value }) : 0;
  compared.left = left ? `; ${counted(left)} of another task or with other parameters left out` : "";
  tellBrushed(designs.designs.length, designs.designs.length);
}

function tellBrushed(active, all) {
  find("brushed").textContent = all === 0 ? "No run has been evaluated yet"
    : `${active === all ? counted(all, "design") : `${active} of ${counted(all, "design")}`}${compared.left}. Drag along an axis to brush, click a line to see it in 3-D`;
}

function see(design) {
  find("design").hidden = !design;
  if (!design) return;
  find("picture").src = address(design.run, `/thumbnail.png?design=${design.iteration}`);
  const row = known.get(design.run);
  find("caption").textContent = `${row?.marks.name || design.run}\niteration ${design.iteration}, success ${percent(design.success)}, return ${number(design.return)}`;
}

function closeComparison() {
  drawing += 1;
  compared = null;
  find("comparison").hidden = true;
  remember();
}

// --- what people do --------------------------------------------------------------------------------------------------

for (const name of FILTERS) {
  find(name).addEventListener(name === "search" ? "input" : "change", () => {
    filter();
    remember();
  });
}
find("filters").addEventListener("submit", (event) => event.preventDefault());
find("unfilter").addEventListener("click", () => {
  find("filters").reset();
  find("search").focus(); // the button that had the focus is gone
  filter();
  remember();
});
find("compare").addEventListener("click", () => compare(chosenRows().map((row) => row.id)));
find("evolution").addEventListener("click", () => evolution(chosenRows().map((row) => row.id)));
find("star").addEventListener("click", () => star(chosenRows()));
find("edit").addEventListener("click", () => edit(chosenRows()));
find("archive").addEventListener("click", () => archive(chosenRows()));
find("delete").addEventListener("click", () => askDelete(chosenRows()));
find("clear").addEventListener("click", () => table.deselectRow());
find("close").addEventListener("click", closeComparison);
for (const name of ["measure", "single", "designs"]) find(name).addEventListener("change", draw);
find("undo").addEventListener("click", undo);
find("hush").addEventListener("click", () => (find("toast").hidden = true));
find("cancel").addEventListener("click", () => find("ask-marks").close());
find("help").addEventListener("click", () => find("show-help").showModal());
find("open-trash").addEventListener("click", async () => {
  find("trash-why").textContent = "";
  await listTrash().catch((error) => (find("trash-why").textContent = error.message));
  asked(find("show-trash"), () => null);
});
find("empty-trash").addEventListener("click", async () => {
  if (find("empty-trash").textContent === "Empty the trash") {
    find("empty-trash").textContent = "Remove all for good?";
    return;
  }
  await ask("api/trash", "DELETE").catch((error) => (find("trash-why").textContent = error.message));
  await listTrash();
});
find("theme").addEventListener("click", () => {
  const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  document.documentElement.dataset.theme = next;
  localStorage.setItem("morph-theme", next);
  draw();
});

async function undo() {
  const again = undoLast;
  undoLast = null;
  find("toast").hidden = true;
  if (again) await again();
}

const keys = {
  ArrowDown: (row) => moveFocus(table, row, 1),
  ArrowUp: (row) => moveFocus(table, row, -1),
  Enter: (row) => row && open(row.getData().id),
  " ": (row) => row?.toggleSelect(),
  s: (row) => star(meant(row)),
  e: (row) => edit(meant(row)),
  a: (row) => archive(meant(row)),
  Delete: (row) => askDelete(meant(row)),
  c: () => chosenRows().length && !find("compare").disabled && compare(chosenRows().map((row) => row.id)),
  v: () => chosenRows().length && !find("evolution").disabled && evolution(chosenRows().map((row) => row.id)),
  z: () => undo(),
  "/": () => find("search").focus(),
  "?": () => find("show-help").showModal(),
  PageDown: () => table.nextPage().catch(() => null),
  PageUp: () => table.previousPage().catch(() => null),
  Escape: () => (compared ? closeComparison() : table.deselectRow()),
};
const ON_A_ROW = ["Enter", " ", "s", "e", "a", "Delete"];

// The runs that a key is meant for: the selected ones if the focused one is among them, or the focused one.
function meant(row) {
  return row.isSelected() ? chosenRows() : [row.getData()];
}

document.addEventListener("keydown", (event) => {
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key, { target } = event;
  if (!table || document.querySelector("dialog[open]") || event.ctrlKey || event.metaKey || event.altKey) return;
  if (target === find("search") && key === "Escape") focusFirst();
  if (target.matches("input:not([type=checkbox]), select, textarea") || !(key in keys)) return;
  if (target.matches(".tabulator-col") && ["Enter", " "].includes(key)) {
    event.preventDefault();
    target.click();
    return;
  }
  if (target.matches("button, a, input") && ["Enter", " "].includes(key)) return;
  const row = target === document.body || target.closest(".tabulator-row") ? heldRow(table) : undefined;
  if (!row && ON_A_ROW.includes(key)) return;
  event.preventDefault();
  keys[key](row);
});

new ResizeObserver(() => [traces, designs].forEach((part) => part?.chart.resize())).observe(find("comparison"));
document.addEventListener("visibilitychange", () => document.hidden || look());
watch();
