// The table of runs: its columns, and the keys by which it is used. Whatever people wrote is set as text, never as HTML.

import { Tabulator } from "./vendor/tables.js";

export function steps(count) {
  if (count < 1e4) return String(count);
  return count < 1e6 ? `${Math.round(count / 1e3)} k` : `${(count / 1e6).toFixed(2)} M`;
}

export function number(value) {
  const text = value.toFixed(Math.abs(value) < 10 ? 2 : Math.abs(value) < 1000 ? 1 : 0);
  return text.replace("-", Number(text) === 0 ? "" : "−");
}

export function made(tag, className, text) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text !== undefined) element.textContent = text;
  return element;
}

function lines(...texts) {
  const box = made("div");
  for (const text of texts) if (text) box.append(Object.assign(made("div", "line", text), { title: text }));
  return box;
}

// What the server says of a run, flat as the table wants it.
export function flat(row) {
  const { last, best, env_steps, seconds } = row.outcome;
  return {
    ...row, ...row.marks,
    label: row.marks.name || row.id,
    success: last?.success ?? row.success,
    return: last?.episode_return ?? null,
    best, steps: env_steps, duration: seconds,
    text: [row.id, row.marks.name, row.marks.note, ...row.marks.tags, row.task, row.method, row.status, row.reason].join("\n").toLowerCase(),
  };
}

const measured = (format, field) => (cell) => {
  const row = cell.getData(), value = cell.getValue();
  if (value === null || value === undefined) return made("div");
  return lines(format(value), row.best ? `best ${format(row.best[field])}` : "");
};

function plain(format) {
  return (cell) => (cell.getValue() === null ? made("div") : lines(format(cell.getValue())));
}

const BROKEN = ["failed", "lost", "unreadable"]; // whose reason is read without a pointer resting on it
const longest = (a, b) => a.join("\n").localeCompare(b.join("\n"));
const numeric = { sorter: "number", sorterParams: { alignEmptyValues: "bottom" }, cssClass: "number", headerHozAlign: "right", headerSortStartingDir: "desc" };

function columns({ onStar, onOpen }, all) {
  return [
    { formatter: "rowSelection", titleFormatter: () => all, headerSort: false, width: 38, cssClass: "middle", resizable: false, responsive: 0 },
    {
      title: "★", field: "starred", width: 36, cssClass: "middle", sorter: "boolean", headerSortStartingDir: "desc", headerTooltip: "Starred", responsive: 0,
      formatter: (cell) => {
        const button = Object.assign(made("button", "star", cell.getValue() ? "★" : "☆"), { type: "button", tabIndex: -1 });
        button.setAttribute("aria-pressed", String(cell.getValue()));
        button.setAttribute("aria-label", `Star ${cell.getData().label}`);
        button.addEventListener("click", () => onStar(cell.getData()));
        return button;
      },
    },
    {
      title: "best design", field: "best", width: 98, headerSort: false, cssClass: "middle", responsive: 1,
      formatter: (cell) => {
        const row = cell.getData();
        if (row.status === "unreadable") return made("div");
        const button = Object.assign(made("button", "open"), { type: "button", tabIndex: -1, title: "Open in the 3-D viewer" });
        const picture = Object.assign(made("img", "thumb"), { loading: "lazy", alt: `Open ${row.label} in the 3-D viewer`, width: 84, height: 63 });
        picture.addEventListener("error", () => button.remove());
        picture.src = `api/runs/${encodeURIComponent(row.id)}/thumbnail.png?design=best&of=${row.best?.iteration ?? 0}`;
        button.append(picture);
        button.addEventListener("click", () => onOpen(row));
        return button;
      },
    },
    {
      title: "run", field: "label", minWidth: 150, widthGrow: 3, responsive: 0,
      formatter: (cell) => {
        const { name, id, status, reason, success } = cell.getData(), box = made("div");
        box.append(name ? lines(name, id) : Object.assign(made("div", "two whole", id), { title: id }));
        // On a phone this column tells the state, too, which has none of its own there.
        if (BROKEN.includes(status) && reason) {
          const why = Object.assign(made("div", "why"), { title: reason });
          why.append(made("span", "brief", `${status}: `), reason);
          box.append(why);
        } else box.append(made("div", "line brief", success === null ? status : `${status}, success ${percent(success)}`));
        return box;
      },
    },
    {
      title: "state", field: "status", width: 106, responsive: 1,
      formatter: (cell) => {
        const chip = made("span", "chip");
        chip.dataset.status = cell.getValue();
        chip.title = cell.getData().reason;
        chip.append(made("i"), made("b", "", cell.getValue()));
        const row = cell.getData(), box = made("div");
        box.append(chip);
        if (row.eta_seconds !== null) box.append(made("div", "line", ""), made("div", "line", `${duration(row.eta_seconds)} left`));
        else if (row.archived) box.append(made("div", "line", ""), made("div", "line", "archived"));
        return box;
      },
    },
    { title: "task", field: "task", width: 92, responsive: 4, formatter: plain(String) },
    { title: "method", field: "method", width: 96, responsive: 4, formatter: plain(String) },
    { title: "seed", field: "seed", width: 56, responsive: 6, ...numeric, formatter: plain(String) },
    { title: "success", field: "success", width: 78, responsive: 2, ...numeric, headerTooltip: "Share of episodes that reached the goal on Hw-Phy, sampled policy, at the last evaluation; below, at the best one", formatter: measured(percent, "success") },
    { title: "return", field: "return", width: 82, responsive: 3, ...numeric, headerTooltip: "Mean return of the same episodes; below, at the best evaluation", formatter: measured(number, "episode_return") },
    { title: "steps", field: "steps", width: 70, responsive: 5, ...numeric, headerTooltip: "Environment steps of the trajectories", formatter: plain(steps) },
    { title: "time", field: "duration", width: 92, responsive: 5, ...numeric, headerTooltip: "How long trainers were at work, pauses included", formatter: plain(duration) },
    {
      title: "tags", field: "tags", minWidth: 80, widthGrow: 1, responsive: 7, sorter: longest, cssClass: "apart",
      formatter: (cell) => {
        const box = made("div", "tags");
        for (const tag of cell.getValue()) box.append(Object.assign(made("span", "", tag), { title: tag }));
        return box;
      },
    },
    { title: "note", field: "note", minWidth: 90, widthGrow: 2, responsive: 8, formatter: (cell) => Object.assign(made("div", "two", cell.getValue()), { title: cell.getValue() }) },
  ];
}

// The box that selects all runs that fit the filters, on every page.
function boxForAll() {
  const box = Object.assign(made("input"), { type: "checkbox" });
  box.setAttribute("aria-label", "Select all runs that fit the filters");
  return box;
}

function keepBox(box, table) {
  const fitting = () => table.getRows("active");
  box.addEventListener("change", () => (box.checked ? table.selectRow(fitting()) : table.deselectRow(fitting())));
  const show = () => {
    const rows = fitting(), selected = rows.filter((row) => row.isSelected()).length;
    box.checked = selected > 0 && selected === rows.length;
    box.indeterminate = selected > 0 && selected < rows.length;
  };
  for (const event of ["rowSelectionChanged", "renderComplete"]) table.on(event, show);
}

const WORDS = {
  pagination: {
    first: "First", prev: "Back", next: "Next", last: "Last", first_title: "First page", prev_title: "Page before", next_title: "Next page", last_title: "Last page",
    page_size: "runs a page", page_title: "Show page", counter: { showing: "", of: "of", rows: "runs", pages: "pages" },
  },
};

let held = null; // the run whose row has the focus, or has it again as soon as the rows are drawn

/** Return the row that keys are meant for while the focus is on a row, or on none as the rows are drawn anew. */
export function heldRow(table) {
  return table.getRows("display").find((one) => one.getData().id === held);
}

export function makeTable(element, pages, wishes) {
  const all = boxForAll();
  const table = new Tabulator(element, {
    index: "id", columns: columns(wishes, all), layout: "fitColumns", responsiveLayout: "hide", height: "100%", rowHeight: 66,
    pagination: true, paginationSize: 50, paginationSizeSelector: [25, 50, 100, 200], paginationCounter: "rows",
    selectableRows: "highlight", selectableRowsPersistence: true, placeholder: "No run fits the filters", locale: "en", langs: { en: WORDS },
    columnDefaults: { headerSortTristate: true, vertAlign: "middle" },
    rowFormatter: (row) => {
      row.getElement().classList.toggle("archived", row.getData().archived);
      if (!row.getElement().hasAttribute("tabindex")) row.getElement().tabIndex = -1;
      const box = row.getElement().querySelector("input[type=checkbox]"); // Space on the row does the same: one stop for all rows
      if (box) Object.assign(box, { tabIndex: -1, ariaLabel: `Select ${row.getData().label}` });
    },
  });
  keepBox(all, table);
  table.on("tableBuilt", () => {
    // A grid holds rows and nothing else: its pages stand beside it, and what scrolls is reached through its rows.
    pages.append(element.querySelector(".tabulator-footer"));
    element.querySelector(".tabulator-tableholder").removeAttribute("tabindex");
    for (const column of element.querySelectorAll(".tabulator-col.tabulator-sortable")) column.tabIndex = 0;
  });
  element.addEventListener("focusout", (event) => {
    if (event.relatedTarget) held = null;
  });
  document.addEventListener("pointerdown", (event) => {
    if (!element.contains(event.target)) held = null;
  });
  // Rows that are drawn anew, as when the bar above them comes or goes, lose the focus: it goes back to where it was.
  const keepFocus = () => {
    offerFirstRow(element);
    if (held === null || document.activeElement !== document.body) return;
    const row = heldRow(table)?.getElement();
    (row?.isConnected ? row : element.querySelector('.tabulator-row[tabindex="0"]'))?.focus({ preventScroll: true });
  };
  for (const event of ["renderComplete", "dataFiltered", "pageLoaded"]) table.on(event, () => requestAnimationFrame(keepFocus));
  element.addEventListener("focusin", (event) => {
    const row = event.target.closest(".tabulator-row");
    if (!row) return;
    for (const other of element.querySelectorAll('.tabulator-row[tabindex="0"]')) other.tabIndex = -1;
    row.tabIndex = 0;
    held = table.getRows("display").find((one) => one.getElement() === row)?.getData().id ?? null;
  });
  return table;
}

// One row can be reached by Tab: the one that was focused last, or the first.
function offerFirstRow(element) {
  const rows = element.querySelectorAll(".tabulator-row");
  if (rows.length && !element.querySelector('.tabulator-row[tabindex="0"]')) rows[0].tabIndex = 0;
}

export function moveFocus(table, row, by) {
  const shown = table.getRows("display");
  const next = shown[Math.min(shown.length - 1, Math.max(0, shown.indexOf(row) + by))];
  if (!next) return;
  held = next.getData().id; // at once: the next key may come before the row is in sight
  table.scrollToRow(next, "nearest", false).catch(() => null).then(() => next.getElement().focus({ preventScroll: true }));
}
