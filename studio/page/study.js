// The page round the report of a study: it asks whether there is a newer one, and shows it where the reader was.

const INTERVAL = 3000;
const HIDDEN_INTERVAL = 20000;

const find = (id) => document.getElementById(id);
const [report, age, banner, words, open, theme] = ["report", "age", "banner", "words", "open", "theme"].map(find);
const sections = { "no study": find("empty"), writing: find("writing"), failed: find("failed") };

let shown = 0;

function show(state) {
  for (const [name, section] of Object.entries(sections)) section.hidden = state.state !== name;
  find("why-empty").textContent = state.reason;
  find("why-failed").textContent = state.reason;
  report.hidden = open.hidden = state.state !== "ready";
  if (state.state === "ready" && state.version !== shown) load(state.version);
  say(state.state === "ready" && state.reason ? `The newest report could not be written: ${state.reason}` : "");
  age.textContent = state.state === "ready" ? ageOf(state) : "";
}

function load(version) {
  const before = report.contentWindow?.scrollY ?? 0;
  const opened = shown ? [...report.contentDocument.querySelectorAll("details")].map((part) => part.open) : [];
  shown = version;
  report.addEventListener("load", () => {
    paint();
    report.contentDocument.querySelectorAll("details").forEach((part, i) => (part.open = opened[i] ?? part.open));
    report.contentWindow.scrollTo(0, before);
  }, { once: true });
  report.contentWindow.location.replace(`study/report/report.html?${version}`);
}

function paint() {
  report.contentDocument.documentElement.dataset.theme = document.documentElement.dataset.theme;
}

function ageOf(state) {
  const seconds = Math.max(0, Date.now() / 1000 - state.written);
  const words = seconds < 90 ? `${Math.round(seconds)} s` : seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`;
  return `runs as they were ${words} ago${state.writing ? "  ·  writing a newer report" : ""}`;
}

function say(sentence) {
  banner.hidden = !sentence;
  words.textContent = sentence;
}

theme.addEventListener("click", () => {
  const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  document.documentElement.dataset.theme = next;
  localStorage.setItem("morph-theme", next);
  if (shown) paint();
});

async function look() {
  try {
    const response = await fetch("api/study", { cache: "no-store", signal: AbortSignal.timeout(8000) });
    if (response.status === 401) say("The server was started anew: open the link it printed in its terminal.");
    else if (!response.ok) throw new Error(`api/study answered ${response.status}`);
    else show(await response.json());
  } catch {
    say("The server does not answer; trying again. Runs go on without it.");
  }
}

async function watch() {
  await look();
  setTimeout(watch, document.hidden ? HIDDEN_INTERVAL : INTERVAL);
}

document.addEventListener("visibilitychange", () => document.hidden || look());
watch();
