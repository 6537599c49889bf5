// The page: one place in the evolution for all runs, which is scrubbed, played and drawn; and what is written of it.

const RUN_COLOURS = ["#0f7dc2", "#e07b00", "#17a673", "#c2459b"]; // told apart on white and on black
const LINE_COLOURS = ["#0f7dc2", "#e07b00", "#17a673", "#c2459b", "#8a6be0", "#c9a400"];
const DASHES = ["", "5 3", "2 2"];
const LETTERS = "ABCD";
const MARKS = {
  command: ["command", "#8a6be0"], freeze: ["φ frozen", "#5aa9e6"], restart: ["policy from scratch", "#d0342c"],
  resume: ["trainer started again", "#7a828e"], best: ["best evaluation", "#17a673"], starred: ["starred", "#c9a400"],
  episode: ["recorded episode", "#9aa4ae"],
};
const AXES = { iterations: "iteration", env_steps: "environment steps" };
const FLAT = 0.25; // a scene that is lower than this share of its shorter side is seen from above
const ABOVE = [0, -0.3, 1], OBLIQUE = [0.55, -1.1, 0.5];
const NARROW = 280; // px: a view that is less wide has small captions
const TELL_EVERY = 100; // ms between two changes of what stands beside the picture while the evolution plays
const PAUSE = 0.7; // s between the end of an episode and its next beginning
const GOOD = 0.95; // success that is told in green

const percent = (share) => `${Math.round(100 * share)} %`;

/** One run at a place of the evolution. */
class Runner {
  constructor(run, index, several) {
    Object.assign(this, { run, index, several, colour: RUN_COLOURS[index] });
    this.course = run.course;
    this.caption = document.createElement("div");
    this.caption.className = "caption";
  }

  /** Go to a place along an axis: the last iteration that is no further. */
  go(axis, place) {
    this.row = Math.max(0, lastUpTo(this.course[axis], place));
    const here = this.course[axis][this.row], there = this.course[axis][this.row + 1];
    this.share = there === undefined ? 0 : Math.min(1, Math.max(0, (place - here) / (there - here)));
  }

  get iteration() { return this.course.iterations[this.row]; }
  get last() { return this.course.iterations[this.course.iterations.length - 1]; }
  get design() { return this.course.design[this.row]; }

  /** Return the recorded episode of the shown iteration, or the last one before it, or the first. */
  get episode() {
    const { episodes } = this.run;
    return episodes[Math.max(0, lastUpTo(episodes.map(({ iteration }) => iteration), this.iteration))];
  }

  get duration() { return this.episode ? (this.episode.instants - 1) * this.run.control_dt : 0; }

  /** Draw the body, `between` two iterations or at one; or the episode at a time in s. */
  draw(actors, time, between) {
    if (!this.run.designs) return actors.clear();
    if (time !== null && this.episode) return actors.play(this.episode, time);
    const next = between ? this.course.design[Math.min(this.row + 1, this.course.design.length - 1)] : this.design;
    actors.stand(this.design, next, between ? this.share : 0);
  }

  write(time) {
    const { course, run } = this, { evaluations } = course, at = lastUpTo(evaluations.iterations, this.iteration);
    const line = (text, name = "") => {
      const node = document.createElement("p");
      node.textContent = text;
      node.className = name;
      return node;
    };
    const heading = document.createElement("p"), count = document.createElement("b");
    if (this.several) {
      const swatch = document.createElement("span");
      swatch.className = "swatch";
      swatch.style.background = this.colour;
      const name = document.createElement("span");
      name.className = "name";
      name.textContent = ` · ${run.name}`;
      heading.append(swatch, LETTERS[this.index], name, document.createElement("br"));
    }
    count.textContent = this.row ? `Iteration ${this.iteration} of ${this.last}` : "Initial design";
    heading.append(count, this.row ? ` · ${steps(course.env_steps[this.row])} steps` : "");
    const lines = [heading];
    if (at < 0) lines.push(line("no evaluation so far", "faint"));
    else {
      const from = evaluations.iterations[at], when = from === this.iteration ? "" : `, in iteration ${from}`;
      const result = line(`success ${percent(evaluations.sampled[at])} sampled, ${percent(evaluations.deterministic[at])} with the mean action${when}`, "result");
      result.dataset.good = evaluations.sampled[at] >= GOOD;
      lines.push(result);
    }
    const reason = run.designs?.reasons[this.design];
    if (!run.designs) lines.push(line("no body: the task can't be made here", "faint"));
    else if (time !== null && this.episode) lines.push(line(`plays the episode of iteration ${this.episode.iteration}, ${Math.min(time, this.duration).toFixed(1)} of ${this.duration.toFixed(1)} s`));
    else if (time !== null) lines.push(line("no episode was recorded", "faint"));
    else if (reason) lines.push(line(`no body: ${reason}`, "faint"));
    else if (!course.exact[this.row]) lines.push(line(`body of iteration ${course.design_iterations[this.design]}`, "faint"));
    this.caption.replaceChildren(...lines);
  }

  /** Return entry `i` of phi in the shown iteration, with the bounds that are in force, in the parameter's unit. */
  parameter(i) {
    const { course } = this, at = i * course.iterations.length + this.row;
    return { value: course.phi[at], lo: course.lo[at], hi: course.hi[at], initial: course.initial[i] };
  }
}

class Evolution {
  constructor({ runs, missing }) {
    this.missing = missing;
    this.runners = runs.map((run, i) => new Runner(run, i, runs.length > 1));
    this.several = runs.length > 1;
    this.axis = "iterations";
    this.place = this.span[0];
    this.told = 0; // ms
    this.mode = ""; // "evolution" or "episode" while one of them plays
    this.time = null; // s into the episodes; null where bodies stand
    this.charts = this.makeCharts();
    this.makeTable();
    this.makeMarks();
    $("captions").append(...this.runners.map(({ caption }) => caption));
    this.turn();
  }

  get span() {
    const ends = this.runners.map(({ course }) => course[this.axis]);
    return [Math.min(...ends.map((x) => x[0])), Math.max(...ends.map((x) => x[x.length - 1]))];
  }

  /** Show the bodies in 3-D too. */
  perform(canvas, drawn) {
    const low = [0, 1, 2].map((i) => Math.min(...this.runners.map(({ run }) => run.low[i])));
    const high = [0, 1, 2].map((i) => Math.max(...this.runners.map(({ run }) => run.high[i])));
    const flat = high[2] - low[2] < FLAT * Math.min(high[0] - low[0], high[1] - low[1]);
    this.actors = this.runners.map(({ run }) => new Actors(run, flat));
    this.stage = new Stage(canvas, drawn, aroundBox(flat ? ABOVE : OBLIQUE, low, high));
    this.stage.show(this.actors);
    this.haunt($("ghost").checked);
    this.writeScale();
    new ResizeObserver(() => this.arrange()).observe(canvas);
    this.arrange();
  }

  arrange() {
    this.runners.forEach(({ caption }, i) => {
      const { left, top, width } = this.stage.rectangle(i);
      caption.classList.toggle("narrow", width < NARROW);
      Object.assign(caption.style, { left: `${left}px`, top: `${top}px`, maxWidth: `${width}px` });
    });
    this.stage?.touch();
  }

  haunt(on) {
    for (const actors of this.actors ?? []) actors.haunt(on);
    this.stage?.touch();
  }

  // --- the place ------------------------------------------------------------------------------------------------------

  /** Go to a place; what plays goes on only if it is what moves it. */
  seek(place, { playing = false } = {}) {
    const [lo, hi] = this.span;
    this.place = Math.min(hi, Math.max(lo, place));
    if (!playing) {
      this.mode = "";
      this.time = null;
      if (this.axis === "iterations") this.place = Math.round(this.place);
    }
    this.turn();
  }

  /** Go some iterations on, of the run that has most of them. */
  step(count) {
    const { course } = this.runners.reduce((most, runner) => (runner.last > most.last ? runner : most)), x = course[this.axis];
    const at = Math.min(x.length - 1, Math.max(0, lastUpTo(x, this.place) + count));
    this.seek(x[at]);
  }

  /** Go to the recorded episode after the shown place, or before it, and stay there. */
  leap(way) {
    const stops = this.stops(), next = way > 0 ? stops.find((x) => x > this.place + 1e-6) : stops.findLast((x) => x < this.place - 1e-6);
    if (next !== undefined) this.seek(next);
  }

  /** Return where an iteration of a run is on the axis. */
  at({ course }, iteration) {
    return course[this.axis][Math.max(0, lastUpTo(course.iterations, iteration))];
  }

  stops() {
    return this.runners.flatMap((runner) => runner.run.episodes.map(({ iteration }) => this.at(runner, iteration))).sort((a, b) => a - b);
  }

  best() {
    const [first] = this.runners.filter(({ course }) => course.best !== null).sort((a, b) => merit(b) - merit(a));
    if (first) this.seek(this.at(first, first.course.best));
  }

  change(axis) {
    const [first] = this.runners, { iteration } = first;
    this.axis = axis;
    this.place = this.at(first, iteration);
    this.makeMarks();
    this.drawCharts();
    this.turn();
  }

  /** Show everything at the place. */
  turn() {
    for (const runner of this.runners) runner.go(this.axis, this.place);
    this.stage?.touch();
    if (this.mode !== "evolution" || performance.now() - this.told > TELL_EVERY) this.tell();
  }

  /** Write and mark the place: what stands beside the picture costs more than the picture where a processor draws. */
  tell() {
    this.told = performance.now();
    for (const chart of this.charts) if (chart.cursor) chart.move(this.place);
    const slider = $("place"), [lo, hi] = this.span;
    Object.assign(slider, { min: lo, max: hi, step: this.axis === "iterations" ? 1 : "any", value: this.place });
    slider.setAttribute("aria-valuetext", this.runners.map((runner) => `${this.several ? `${LETTERS[runner.index]}: ` : ""}iteration ${runner.iteration} of ${runner.last}`).join(", "));
    this.write();
  }

  write() {
    const written = [this.mode, this.time?.toFixed(1), ...this.runners.map(({ row }) => row)].join();
    if (written === this.written) return;
    this.written = written;
    for (const runner of this.runners) runner.write(this.time);
    this.writeTable();
    const evolving = this.mode === "evolution", episode = this.mode === "episode";
    $("evolve").textContent = evolving ? "❚❚ Pause" : "▶ Evolution";
    $("episode").textContent = episode ? "❚❚ Pause" : "▶ Episode";
  }

  // --- what plays -----------------------------------------------------------------------------------------------------

  evolve() {
    if (this.mode === "evolution") this.seek(this.place);
    else {
      if (this.place >= this.span[1] - 1e-6) this.seek(this.span[0]);
      this.mode = "evolution";
      this.time = null;
      this.write();
    }
  }

  /** Play the episodes of the shown place from their start, go on with them, or pause them. */
  playEpisode() {
    if (this.mode === "episode") this.mode = "";
    else if (this.runners.some(({ episode }) => episode)) {
      this.mode = "episode";
      this.time ??= 0;
    }
    this.halt = false;
    this.write();
    this.stage?.touch();
  }

  get duration() { return Math.max(...this.runners.map(({ duration }) => duration)); }

  advance(seconds) {
    if (this.mode === "episode") {
      this.time += seconds * Number($("speed").value);
      if (this.time > this.duration + PAUSE) {
        if (this.halt) Object.assign(this, { mode: "evolution", time: null, halt: false });
        else this.time = 0;
      }
      this.stage?.touch();
      this.write();
    } else if (this.mode === "evolution") {
      const [lo, hi] = this.span, before = this.place, place = before + ((hi - lo) * seconds) / Number($("pace").value);
      const stop = $("halts").checked ? this.stops().find((x) => x > before + 1e-9 && x <= place) : undefined;
      this.seek(stop ?? place, { playing: true });
      if (stop !== undefined) Object.assign(this, { mode: "episode", time: 0, halt: true });
      else if (place >= hi) {
        this.mode = "";
        if (this.runners.some(({ episode }) => episode)) this.playEpisode();
      }
      if (this.mode !== "evolution") this.tell();
    }
  }

  frame(ms) {
    const passed = this.last === undefined ? 0 : Math.min(0.25, (ms - this.last) / 1000);
    this.last = ms;
    this.advance(passed);
    if (!this.stage) return;
    this.stage.orbit.update();
    const drawn = this.stage.present(ms, Boolean(this.mode), () => this.runners.forEach((runner, i) => {
      const time = this.time === null ? null : Math.min(this.time, runner.duration);
      runner.draw(this.actors[i], time, this.mode === "evolution");
    }));
    if (drawn && this.mode && passed < 0.25) this.stage.pace(1000 * passed);
    this.frames += drawn;
  }

  frames = 0;

  // --- what is written ------------------------------------------------------------------------------------------------

  makeCharts() {
    const made = new Map();
    for (const runner of this.runners) {
      for (const chart of runner.run.course.charts) {
        const apart = this.several && chart.design ? chart.lines.map((line) => ({ ...chart, title: `${chart.title}, ${line.label}`, lines: [line] })) : [chart];
        for (const one of apart) {
          const known = made.get(one.title) ?? made.set(one.title, { ...one, lines: [] }).get(one.title);
          known.lines.push(...one.lines.map((line, i) => this.line(runner, line, i, one)));
        }
      }
    }
    const charts = [...made.values()].map((chart) => new Chart(chart, (place) => this.seek(place)));
    $("charts").append(...charts.map(({ node }) => node));
    new ResizeObserver(() => this.drawCharts()).observe($("charts"));
    return charts;
  }

  line({ course, colour, index }, { label, at, colour: own, values }, i, { design }) {
    const x = at === "rows" ? course : course.evaluations;
    const name = this.several ? `${LETTERS[index]}${design ? "" : ` ${label}`}` : label;
    return { label: name, x, y: values, colour: this.several ? colour : own || LINE_COLOURS[i], dash: this.several ? DASHES[i % DASHES.length] : "" };
  }

  drawCharts() {
    for (const chart of this.charts) {
      chart.draw(this.axis, AXES[this.axis], this.span);
      chart.move(this.place);
    }
  }

  makeMarks() {
    const [lo, hi] = this.span, parts = [], kinds = new Set(), thumb = 8; // px: half the slider's thumb
    for (const runner of this.runners) {
      for (const { iteration, kind, words } of runner.course.marks) {
        if (!MARKS[kind]) continue;
        kinds.add(kind);
        const share = (this.at(runner, iteration) - lo) / (hi - lo || 1), small = kind === "episode";
        const mark = svg("circle", { cx: `${100 * share}%`, cy: small ? 10 : 4, r: small ? 2 : 4, fill: MARKS[kind][1], transform: `translate(${thumb - 2 * thumb * share} 0)` });
        mark.append(svg("title", {}, this.several ? `${LETTERS[runner.index]}: ${words}` : words));
        mark.addEventListener("click", () => this.seek(this.at(runner, iteration)));
        parts.push(mark);
      }
    }
    $("marks").replaceChildren(...parts);
    const entry = (colour, text, name) => {
      const node = document.createElement("li"), swatch = document.createElement("span");
      swatch.className = name;
      swatch.style.background = colour;
      node.append(swatch, text);
      return node;
    };
    const runs = this.several ? this.runners.map(({ run, colour, index }) => entry(colour, `${LETTERS[index]}: ${run.name}, ${run.method}, seed ${run.seed}`, "swatch")) : [];
    const marks = Object.keys(MARKS).filter((kind) => kinds.has(kind)).map((kind) => entry(MARKS[kind][1], MARKS[kind][0], "tick"));
    $("legend").replaceChildren(...runs, ...marks);
    this.writeScale();
  }

  /** Say how large the squares on the floor are, once there are bodies. */
  writeScale() {
    if (!this.actors) return;
    const { cell } = this.actors[0], entry = document.createElement("li"), printed = this.runners[0].run.cast.printed;
    const bodies = printed ? "bodies as printed; they touch as capsules" : "bodies as simulated, not as printed";
    entry.textContent = `squares of ${cell < 1 ? `${number(100 * cell)} cm` : `${number(cell)} m`}; ${bodies}; pale: initial design`;
    $("legend").append(entry);
  }

  makeTable() {
    const [head] = $("phi").tHead.rows, names = this.several ? this.runners.map(({ index }) => LETTERS[index]) : ["value", "initial"];
    const cell = (tag, text) => Object.assign(document.createElement(tag), { textContent: text });
    head.replaceChildren(...["parameter", "between its bounds", ...names, "unit"].map((text) => Object.assign(cell("th", text), { scope: "col" })));
    const [{ run: { course: { parameters } } }] = this.runners;
    this.rows = parameters.map(({ label, unit }) => {
      const row = document.createElement("tr"), range = document.createElement("td"), place = document.createElement("span");
      place.className = "range";
      const [track, start] = ["i", "b"].map((tag) => document.createElement(tag));
      start.className = "start";
      const markers = this.runners.map(({ colour }) => {
        const marker = document.createElement("b");
        marker.style.background = this.several ? colour : "var(--accent)";
        return marker;
      });
      const [low, high] = ["small", "small"].map((tag) => document.createElement(tag));
      place.append(track, start, ...markers);
      range.append(low, place, high);
      range.className = "bounds";
      const cells = names.map(() => cell("td", ""));
      row.append(Object.assign(cell("th", label), { scope: "row" }), range, ...cells, cell("td", unit));
      return { row, place, low, high, start, markers, cells };
    });
    $("phi").tBodies[0].replaceChildren(...this.rows.map(({ row }) => row));
  }

  writeTable() {
    const [first] = this.runners;
    $("phi-of").textContent = this.several ? "" : first.row ? `of iteration ${first.iteration}` : "at the start";
    this.rows.forEach(({ place, low, high, start, markers, cells }, i) => {
      const { factor, digits, unit } = first.course.parameters[i];
      const now = this.runners.map((runner) => runner.parameter(i)), [here] = now;
      const share = (value) => `${(100 * Math.min(1, Math.max(0, (value - here.lo) / (here.hi - here.lo)))).toFixed(1)}%`;
      const text = (value) => (value * factor).toFixed(digits).replace("-", "−");
      low.textContent = text(here.lo);
      high.textContent = text(here.hi);
      start.style.left = share(here.initial);
      markers.forEach((marker, k) => { marker.style.left = share(now[k].value); });
      place.title = `${text(here.lo)} to ${text(here.hi)} ${unit} are allowed; box: initial value`;
      const written = this.several ? now.map(({ value }) => text(value)) : [text(here.value), text(here.initial)];
      cells.forEach((cell, k) => { cell.textContent = written[k]; });
    });
  }
}

/** Return what makes the best evaluation of a run better than that of another one. */
function merit({ course: { best, evaluations } }) {
  return evaluations.sampled[lastUpTo(evaluations.iterations, best)] ?? -1;
}

function connect(evolution) {
  const press = {
    evolve: () => evolution.evolve(),
    episode: () => evolution.playEpisode(),
    best: () => evolution.best(),
    home: () => evolution.stage?.home(),
  };
  for (const [id, act] of Object.entries(press)) $(id).addEventListener("click", act);
  $("episode").disabled = !evolution.runners.some(({ episode }) => episode);
  $("best").disabled = !evolution.runners.some(({ course }) => course.best !== null);
  $("place").addEventListener("input", () => evolution.seek($("place").valueAsNumber));
  $("axis").addEventListener("change", () => evolution.change($("axis").value));
  $("ghost").addEventListener("change", () => evolution.haunt($("ghost").checked));
  $("theme").addEventListener("click", () => evolution.stage?.paint()); // after the page has changed
  const pace = () => { $("pace").selectedIndex = ($("pace").selectedIndex + 1) % $("pace").options.length; };
  const keys = {
    " ": press.evolve, e: press.episode, b: press.best, h: press.home, s: pace,
    g: () => $("ghost").click(), t: () => $("theme").click(),
    Home: () => evolution.seek(evolution.span[0]), End: () => evolution.seek(evolution.span[1]),
    "[": () => evolution.leap(-1), "]": () => evolution.leap(1),
    ArrowLeft: (event) => evolution.step(event.shiftKey ? -10 : -1), ArrowRight: (event) => evolution.step(event.shiftKey ? 10 : 1),
  };
  document.addEventListener("keydown", (event) => {
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key], { target } = event;
    if (!act || event.ctrlKey || event.metaKey || event.altKey || target.closest?.("select, summary, pre, .wide")) return;
    if (event.key === " " && target.closest?.('button, input[type="checkbox"]')) return;
    event.preventDefault();
    act(event);
  });
}

const STAYS = "The pictures are those of the best designs; the traces, the slider and the table work.";

/** Say why no body is seen in 3-D; pictures, traces and table stay. */
function withoutBodies(sentence, missing) {
  document.body.dataset.state = "still";
  say(`${sentence} ${STAYS} ${missing}`.trim());
}

async function begin() {
  connectPage();
  const carried = unpacked("evolution"), drawn = graphics();
  const evolution = new Evolution(unpackDocument(await carried));
  connect(evolution);
  say(evolution.missing);
  if (!drawn.there) withoutBodies("This browser has no WebGL, so that no body moves here.", evolution.missing);
  else if (evolution.runners.every(({ run }) => !run.designs)) document.body.dataset.state = "still";
  else {
    document.body.dataset.state = "live";
    evolution.perform($("stage"), drawn);
    watchGraphics(evolution.stage, STAYS, evolution.missing);
  }
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) evolution.evolve();
  await new Promise((resolve) => {
    const frame = (ms) => {
      evolution.frame(ms);
      evolution.firstFrame ??= performance.now();
      resolve();
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  });
  return evolution;
}

// What tests ask: the page when its first picture is drawn.
globalThis.show = { ready: begin().catch((error) => withoutBodies(`The page could not begin here: ${error.message ?? error}.`, "")) };
