// The page of a spectator: what the presenter's browser shows, and nothing that changes it.

import { init } from "./vendor/charts.js";

const find = (id) => document.getElementById(id);
const AGAIN = 5000; // milliseconds until it is tried again where there was no place, or no server

const key = crypto.randomUUID ? crypto.randomUUID() : Array.from(crypto.getRandomValues(new Uint8Array(16)), (b) => b.toString(16).padStart(2, "0")).join("");
const has3d = Boolean(document.createElement("canvas").getContext("webgl2"));
const scene = find("scene");

let events = null;
let curves = null; // the newest ones, to be drawn again in other colours
let follows = true;
let seated = false;
let alone = false; // looking at a run by oneself, in place of what the presenter shows
let shown = null; // the run that the presenter shows

// --- what is said ----------------------------------------------------------------------------------------------------

// Say in the middle of the scene why nothing is seen there; `busy` where that may change by itself, `sheer` where what was
// seen last stays in sight.
function say(sentence, busy, sheer = false) {
  find("curtain").hidden = !sentence;
  find("camera").hidden = Boolean(sentence) || !has3d;
  find("curtain").classList.toggle("still", !busy);
  find("curtain").classList.toggle("sheer", sheer);
  find("sentence").textContent = sentence;
}

const seconds = (value) => value.toFixed(1);

function number(value, words) {
  const small = document.createElement("small");
  small.textContent = words;
  return [value, small];
}

function showStage({ phase, watching, seen, runs }) {
  shown = seen.run;
  offer(runs);
  find("theirs").textContent = seen.run ? `The presenter is at iteration ${seen.iteration}${seen.run === find("which").value ? "" : " of another run"}.` : "";
  find("title").textContent = seen.title || "MORPH Studio";
  find("doing").textContent = [seen.method && `method ${seen.method}`, seen.doing, seen.status].filter(Boolean).join(" · ");
  document.title = seen.run ? `${seen.title} · iteration ${seen.iteration}` : "Watching · MORPH Studio";
  find("numbers").hidden = !seen.run;
  find("iteration").replaceChildren(...number(String(seen.iteration), seen.planned ? ` of ${seen.planned}` : ""));
  find("success").replaceChildren(...(seen.success === null ? ["–"] : number(whole.format(100 * seen.success), " %")));
  const time = seen.duration ? number(seconds(seen.time), ` of ${seconds(seen.duration)} s${seen.playing ? "" : ", paused"}`) : ["–"];
  find("clock").replaceChildren(...time);
  find("run").textContent = seen.run ?? "";
  find("watching").textContent = watching === 1 ? "You alone are watching." : `${watching} people are watching.`;
  showLegend(seen.legend);
  if (phase === "waiting") say("Waiting for the presenter", true);
  else if (phase === "left") say("The presenter has left. This page goes on when they come back.", true, true);
  else say("", false);
}

function showLegend(entries) {
  const said = JSON.stringify(entries);
  if (find("legend").dataset.said === said) return;
  find("legend").dataset.said = said;
  find("legend").replaceChildren(...entries.map(({ colour, words }) => {
    const line = document.createElement("li"), swatch = document.createElement("i");
    swatch.style.background = colour;
    line.append(swatch, words);
    return line;
  }));
}

// --- curves ----------------------------------------------------------------------------------------------------------

const charts = new Map();

function chartIn(element) {
  if (!charts.has(element)) charts.set(element, init(element));
  return charts.get(element);
}

function draw(element, series, { name, min, max }) {
  const css = (word) => getComputedStyle(document.documentElement).getPropertyValue(word).trim();
  const axis = { type: "value", nameTextStyle: { color: css("--faint"), fontSize: 12 }, axisLabel: { color: css("--faint"), fontSize: 12, hideOverlap: true, formatter: (v) => String(+v.toPrecision(4)).replace("-", "−") }, axisLine: { lineStyle: { color: css("--faint") } }, splitLine: { lineStyle: { color: css("--line") } } };
  chartIn(element).setOption({
    animation: false, textStyle: { fontFamily: getComputedStyle(document.body).fontFamily, color: css("--text") },
    grid: { left: 46, right: 14, top: series.length > 1 ? 34 : 26, bottom: 40 },
    legend: { show: series.length > 1, top: 2, left: 60, right: 0, padding: 4, itemGap: 12, icon: "roundRect", itemWidth: 12, itemHeight: 4, textStyle: { color: css("--text"), fontSize: 12 } },
    xAxis: { ...axis, name: "iteration", nameLocation: "middle", nameGap: 24, splitLine: { show: false }, min: "dataMin", max: "dataMax" },
    yAxis: { ...axis, name, nameLocation: "end", nameGap: 8, min, max, scale: min === undefined },
    series: series.map(({ label, colour, points }) => ({ type: "line", name: label, data: points, color: colour, symbol: points.length > 1 ? "none" : "circle", lineStyle: { width: 2.2 } })),
  }, true);
}

function drawCurves() {
  const there = Boolean(curves?.iteration.length);
  find("few").hidden = there;
  find("curves").hidden = !there;
  const { iteration = [], success = [], phi = [] } = there ? curves : {};
  const wanted = phi.map(({ name }) => name).join("\n");
  if (find("phi-charts").dataset.names !== wanted) {
    find("phi-charts").dataset.names = wanted;
    for (const element of charts.keys()) if (element.id !== "success-chart") charts.get(element).dispose(), charts.delete(element);
    find("phi-charts").replaceChildren(...phi.flatMap(({ name }) => {
      const title = document.createElement("h3"), element = document.createElement("div");
      title.textContent = name;
      Object.assign(element, { className: "chart", role: "img", ariaLabel: `${name} over the iterations` });
      return [title, element];
    }));
  }
  if (!there) return;
  const css = getComputedStyle(document.documentElement).getPropertyValue("--accent").trim();
  draw(find("success-chart"), [{ label: "success", colour: css, points: iteration.map((x, i) => [x, 100 * success[i]]) }], { name: "%", min: 0, max: 100 });
  phi.forEach(({ unit, curves: entries }, i) => {
    draw(find("phi-charts").children[2 * i + 1], entries.map(({ name, colour, values }) => ({ label: name, colour, points: iteration.map((x, j) => [x, values[j]]) })), { name: unit });
  });
}

addEventListener("resize", () => charts.forEach((chart) => chart.resize()));

// --- the scene -------------------------------------------------------------------------------------------------------

function openScene() {
  if (!has3d || alone) return;
  scene.src = `audience/viewer/${key}/${document.documentElement.dataset.theme === "dark" ? "?darkMode" : ""}`;
}

async function setFollowing(wanted) {
  follows = wanted;
  find("follow").hidden = wanted;
  find("whose").textContent = wanted ? "Presenter's view. Drag to look round." : "Your own view";
  await fetch(`audience/seats/${key}`, { method: "PUT", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ follows: wanted }) }).catch(() => null);
}

scene.addEventListener("load", () => {
  for (const kind of ["pointerdown", "wheel", "keydown"]) {
    scene.contentDocument.addEventListener(kind, () => follows && setFollowing(false), { capture: true, passive: true });
  }
});

find("follow").addEventListener("click", () => setFollowing(true));
find("theme").addEventListener("click", () => {
  const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  document.documentElement.dataset.theme = next;
  localStorage.setItem("morph-theme", next);
  drawCurves();
  openScene();
});

// --- on one's own ----------------------------------------------------------------------------------------------------

function offer(runs) {
  const which = find("which"), chosen = which.value, said = runs.join("\n");
  find("alone").hidden = alone || !runs.length;
  if (which.dataset.said === said) return;
  which.dataset.said = said;
  which.replaceChildren(...runs.map((run) => new Option(run, run)));
  if (runs.includes(chosen)) which.value = chosen;
}

// Show the evolution of the run that is chosen: a page that holds all of it, and asks the server for nothing.
function openEvolution() {
  find("opening").hidden = false;
  find("evolution").src = `audience/runs/${encodeURIComponent(find("which").value)}/evolution.html?${Date.now()}#${document.documentElement.dataset.theme}`;
}

function setAlone(wanted) {
  if (alone === wanted) return;
  alone = wanted;
  document.body.classList.toggle("alone", wanted);
  find("own").hidden = !wanted;
  find("alone").hidden = wanted;
  if (wanted) {
    if (shown) find("which").value = shown;
    scene.removeAttribute("src"); // one scene at a time: a phone has no room for two
    openEvolution();
    find("back").focus();
  } else {
    find("evolution").removeAttribute("src");
    openScene();
    charts.forEach((chart) => chart.resize());
    find("alone").focus();
  }
}

find("alone").addEventListener("click", () => setAlone(true));
find("back").addEventListener("click", () => setAlone(false));
find("anew").addEventListener("click", openEvolution);
find("which").addEventListener("change", openEvolution);
find("evolution").addEventListener("load", () => { find("opening").hidden = Boolean(find("evolution").getAttribute("src")); });

// --- the server ------------------------------------------------------------------------------------------------------

function listen() {
  events = new EventSource(`audience/events?seat=${key}`);
  events.addEventListener("stage", ({ data }) => {
    if (!seated) {
      seated = true;
      openScene();
      setFollowing(follows);
    }
    showStage(JSON.parse(data));
  });
  events.addEventListener("curves", ({ data }) => {
    curves = JSON.parse(data);
    drawCurves();
  });
  events.addEventListener("ended", ({ data }) => stop(JSON.parse(data), null));
  events.addEventListener("full", ({ data }) => stop(JSON.parse(data), AGAIN));
  events.addEventListener("error", () => {
    seated = false;
    if (events.readyState === EventSource.CLOSED) ask();
    else say(navigator.onLine ? "The studio does not answer. It is tried again." : "This device is offline. It is tried again.", true, true);
  });
}

// Leave, say why, and come again after a time in milliseconds, or never.
function stop(sentence, again) {
  events.close();
  seated = false;
  setAlone(false);
  offer([]);
  scene.removeAttribute("src");
  find("watching").textContent = "";
  say(sentence, again !== null);
  if (again !== null) setTimeout(listen, again);
}

// The browser has given the events up: because the server refuses them, or because there is no server.
async function ask() {
  const answer = await fetch(`audience/events?seat=${key}`, { cache: "no-store" }).catch(() => null);
  answer?.body?.cancel();
  if (answer?.status === 401) stop("This link lets nobody in any more. Ask the presenter for a new one.", null);
  else stop("The studio does not answer. It is tried again.", AGAIN);
}

find("no3d").hidden = has3d;
listen();
